"""Sample the pictures' shades across a bundle, over short ways along it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy import ndimage

from barsight.bundle_pictures.sharpness import is_sharp
from barsight.core.arrays import Bool, Float64, UInt8
from barsight.core.pose import Pose
from barsight.core.types import RefusedFrame
from barsight.labels.placing import PlacedCamera, heights_at
from barsight.recording.rectified_pairs import RectifiedPairs
from barsight.yard.sections import part_about
from barsight.yard.types import Bundle, HeightMap, YardMap

STEP_M = 0.0015
"""Way between two places across a bundle: a fifth of a pixel."""
_ROW_M, WINDOW_M = 0.02, 0.3
"""Way between two rows along a bundle, and length of the rows whose median is a profile: bars turn by less
than a pixel over it."""
_MAX_WINDOWS = 5
"""Windows along a bundle, each sampled in both pictures of one frame: the same bars lie all along it, so that
sixteen in two frames tell no more."""
_BESIDE_ENDS_M, _TRIM_M = 0.1, 0.01
_SMOOTH_M = 0.015
_AROUND_M = 0.4
"""The map is read so far beside a bundle's flanks: what stands there may hide it."""
_OVER_M, _MAX_RISE_M, _HIDDEN_RATIO = 0.05, 1.0, 0.05
"""A line of sight is followed up to so high, in such steps; the share of a window's middle line that may be
hidden."""
_TRIED = 10
"""Frames, the nearest ones, that are tried for a window."""
_DARKEST = 8.0
"""Gray levels that are added before the logarithm: noise of dark ones counts less."""


@dataclass(frozen=True, eq=False)
class PitchProfile:
    """Logarithm of the gray levels (N,) across a bundle, STEP_M apart, in one picture.

    pixel_m: size of the picture's pixels there.
    """

    levels: Float64
    pixel_m: float


@dataclass(frozen=True, eq=False)
class _BundleWindow:
    """Lines across a bundle: places (N, 3) of the middle one and the others' ways from it (R, 3). number: the
    bundle's place in its list.
    """

    number: int
    middle_m: Float64
    rows_m: Float64

    @property
    def corners_m(self) -> Float64:
        """Return its corners (4, 3)."""
        return (self.middle_m[[0, -1]] + self.rows_m[[0, -1], None]).reshape(4, 3)


def pitch_profiles(
    pairs: RectifiedPairs, poses: Mapping[int, Pose], heights: YardMap, bundles: Sequence[Bundle]
) -> list[list[PitchProfile]]:
    """Sample profiles across each bundle in the frames nearest over windows along it.

    poses: reference_from_body by stamp. What stands higher may hide a window; it gives no profile then, nor
    does a frame that can't be decoded or isn't sharp.
    """
    rectifier, out = pairs.rectifier, [list[PitchProfile]() for _ in bundles]
    size_px = rectifier.camera.width, rectifier.camera.height
    stamps = list(poses)
    views = [PlacedCamera.of_pair(poses[s] @ rectifier.body_from_rect0, rectifier.camera) for s in stamps]
    eyes = np.array([left.map_from_rect.translation for left, _ in views]).reshape(-1, 3)
    wanted = dict[int, list[_BundleWindow]]()
    for number, bundle in enumerate(bundles):
        for part, window in _windows(number, bundle, heights):
            k = _nearest(window, views, eyes, size_px)
            if k is not None and not _is_hidden(part, window.middle_m, eyes[k]):
                wanted.setdefault(stamps[k], []).append(window)
    for pair in pairs(wanted) if wanted else ():
        if isinstance(pair, RefusedFrame):
            continue
        cameras = views[stamps.index(pair.stamp_ns)]
        for picture, valid, camera in zip(
            (pair.left, pair.right), (pair.left_valid, pair.right_valid), cameras, strict=True
        ):
            for window in wanted[pair.stamp_ns] if is_sharp(picture) else ():
                profile = _profile(picture, valid, camera, window)
                if profile is not None:
                    out[window.number].append(profile)
    return out


def _windows(number: int, bundle: Bundle, heights: YardMap) -> Iterator[tuple[HeightMap, _BundleWindow]]:
    """Divide what is inside a bundle's ends and flanks into windows, at the heights of the map around."""
    half, reach = bundle.width_m / 2 - _TRIM_M, bundle.length_m / 2 - _BESIDE_ENDS_M
    if not (half > STEP_M and 2 * reach >= WINDOW_M and np.isfinite(bundle.centre_m).all()):
        return
    count = min(int(2 * reach / WINDOW_M), _MAX_WINDOWS)
    along = bundle.direction / np.linalg.norm(bundle.direction[:2])
    across = np.array([along[1], -along[0], 0.0])
    beside = np.arange(-half, half, STEP_M)
    level = np.append(along[:2], 0.0)
    rows = np.arange(-WINDOW_M / 2, WINDOW_M / 2 + _ROW_M / 2, _ROW_M)[:, None] * level
    middle = np.append(bundle.centre_m[:2], bundle.top_z_m)
    edges = np.linspace(-reach, reach, count + 1)
    wide = np.array([-half - _AROUND_M, half + _AROUND_M])
    corners = middle + np.repeat(edges[[0, -1]], 2)[:, None] * along + np.tile(wide, 2)[:, None] * across
    part = part_about(heights, corners[:, 0], corners[:, 1])
    for at in (edges[1:] + edges[:-1]) / 2:
        line = middle + at * along + beside[:, None] * across
        z = heights_at(part, rows[:, None] + line)
        z = np.where(np.isfinite(z), z, line[:, 2])
        line[:, 2] = ndimage.gaussian_filter1d(np.median(z, axis=0), _SMOOTH_M / STEP_M, mode="nearest")
        yield part, _BundleWindow(number, line, rows)


def _is_hidden(part: HeightMap, line_m: Float64, eye_m: Float64) -> bool:
    """Check whether the map stands in the way from an eye to a line of places (N, 3)."""
    rise = np.arange(_OVER_M, _MAX_RISE_M, _OVER_M)[:, None]
    way = (eye_m - line_m)[:, :2] / np.maximum(eye_m[2] - line_m[:, 2:], _OVER_M)
    there = line_m[:, :2] + rise[..., None] * way
    blocked = heights_at(part, there) > line_m[:, 2] + rise + _OVER_M / 2
    return bool(blocked.any(axis=0).mean() > _HIDDEN_RATIO)


def _nearest(
    window: _BundleWindow, views: Sequence[tuple[PlacedCamera, PlacedCamera]], eyes_m: Float64,
    size_px: tuple[int, int],
) -> int | None:  # fmt: skip
    """Find the frame nearest over a window whose left picture has it whole; None where none has."""
    away = np.hypot(*(eyes_m - window.middle_m[len(window.middle_m) // 2])[:, :2].T)
    for k in np.argsort(away, kind="stable")[:_TRIED].tolist():
        at, _ = views[k][0].project(window.corners_m)
        if bool(((at >= 1) & (at <= np.array(size_px) - 2)).all()):
            return int(k)
    return None


def _profile(
    picture: UInt8, valid: Bool, camera: PlacedCamera, window: _BundleWindow
) -> PitchProfile | None:  # fmt: skip
    """Sample one picture; None where it doesn't see all of the places."""
    at, depth = camera.project(window.rows_m[:, None] + window.middle_m)
    x, y = at[..., 0].astype(np.float32), at[..., 1].astype(np.float32)
    inside = cv2.remap(valid.astype(np.uint8), x, y, cv2.INTER_NEAREST, borderValue=0)
    if not inside.all():
        return None
    gray = cv2.remap(picture, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    levels = np.log(np.median(gray, axis=0) + _DARKEST)
    return PitchProfile(levels, float(np.median(depth)) / camera.focal_px)
