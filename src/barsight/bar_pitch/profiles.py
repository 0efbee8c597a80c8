"""Sample the pictures' shades across a bundle, over short ways along it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy import ndimage

from barsight.core.arrays import Bool, Float64, UInt8
from barsight.core.pose import Pose
from barsight.core.types import RefusedFrame
from barsight.labels.placing import PlacedCamera
from barsight.recording.rectified_pairs import RectifiedPairs
from barsight.yard.sections import part_about
from barsight.yard.types import Bundle, HeightMap, YardMap

STEP_M = 0.0015
"""Way between two places across a bundle: a fifth of a pixel."""
_ROW_M, _WINDOW_M = 0.02, 0.3
"""Way between two rows along a bundle, and length of the rows whose median is a profile: bars turn by less
than a pixel over it."""
_MAX_WINDOWS = 5
"""Windows along a bundle, each sampled in both pictures of one frame: the same bars lie all along it, so that
sixteen in two frames tell no more."""
_BESIDE_ENDS_M, _TRIM_M = 0.1, 0.01
_SMOOTH_M = 0.015
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
    """Places (R, N, 3) on a bundle. number: the bundle's place in its list."""

    number: int
    places_m: Float64


def pitch_profiles(
    pairs: RectifiedPairs, poses: Mapping[int, Pose], heights: YardMap, bundles: Sequence[Bundle]
) -> list[list[PitchProfile]]:
    """Sample profiles across each bundle in the frames nearest to windows along it.

    poses: reference_from_body by stamp. A frame that can't be decoded gives none.
    """
    rectifier, out = pairs.rectifier, [list[PitchProfile]() for _ in bundles]
    views = {stamp: PlacedCamera.of_pair(pose @ rectifier.body_from_rect0, rectifier.camera)
             for stamp, pose in poses.items()}  # fmt: skip
    wanted = dict[int, list[_BundleWindow]]()
    for number, bundle in enumerate(bundles):
        for window in _windows(number, bundle, heights):
            stamp = _nearest(window, views, (rectifier.camera.width, rectifier.camera.height))
            if stamp is not None:
                wanted.setdefault(stamp, []).append(window)
    for pair in pairs(wanted) if wanted else ():
        if isinstance(pair, RefusedFrame):
            continue
        pictures = zip((pair.left, pair.right), (pair.left_valid, pair.right_valid), views[pair.stamp_ns],
                       strict=True)  # fmt: skip
        for picture, valid, camera in pictures:
            for window in wanted[pair.stamp_ns]:
                profile = _profile(picture, valid, camera, window.places_m)
                if profile is not None:
                    out[window.number].append(profile)
    return out


def _windows(number: int, bundle: Bundle, heights: YardMap) -> Iterator[_BundleWindow]:
    """Divide what is inside a bundle's ends and flanks into windows, at the map's heights."""
    half, reach = bundle.width_m / 2 - _TRIM_M, bundle.length_m / 2 - _BESIDE_ENDS_M
    count = min(int(2 * reach / _WINDOW_M), _MAX_WINDOWS)
    if half <= 0 or count < 1:
        return
    along = bundle.direction / np.linalg.norm(bundle.direction[:2])
    across = np.array([along[1], -along[0], 0.0])
    beside = np.arange(-half, half, STEP_M)
    rows = np.arange(-_WINDOW_M / 2, _WINDOW_M / 2 + _ROW_M / 2, _ROW_M)
    middle = bundle.centre_m + (bundle.top_z_m - bundle.centre_m[2]) * np.array([0.0, 0.0, 1.0])
    edges = np.linspace(-reach, reach, count + 1)
    corners = middle + edges[[0, 0, -1, -1], None] * along + beside[[0, -1, 0, -1], None] * across
    part = part_about(heights, corners[:, 0], corners[:, 1])
    for at in (edges[1:] + edges[:-1]) / 2:
        places = middle + (at + rows)[:, None, None] * along + beside[:, None] * across
        places[..., 2] = _surface(part, places)
        yield _BundleWindow(number, places)


def _surface(part: HeightMap, places: Float64) -> Float64:
    """Take the median height along each line of places (R, N, 3), smoothed across; theirs where unknown."""
    rows, columns = part.shape
    row = np.rint((places[..., 1] - part.y0_m) / part.cell_m).astype(np.int64).clip(0, rows - 1)
    column = np.rint((places[..., 0] - part.x0_m) / part.cell_m).astype(np.int64).clip(0, columns - 1)
    z = np.where(np.isfinite(part.z_m[row, column]), part.z_m[row, column], places[..., 2])
    line = ndimage.gaussian_filter1d(np.median(z, axis=0), _SMOOTH_M / STEP_M, mode="nearest")
    return np.broadcast_to(line, z.shape)


def _nearest(
    window: _BundleWindow, views: Mapping[int, tuple[PlacedCamera, PlacedCamera]], size_px: tuple[int, int]
) -> int | None:
    """Find the frame nearest over a window whose left picture has it whole; None where none has."""
    middle = window.places_m[len(window.places_m) // 2, window.places_m.shape[1] // 2, :2]
    corners = window.places_m[[0, 0, -1, -1], [0, -1, 0, -1]]
    stamps = list(views)
    eyes = np.array([views[stamp][0].map_from_rect.translation[:2] for stamp in stamps]).reshape(-1, 2)
    for k in np.argsort(np.hypot(*(eyes - middle).T), kind="stable"):
        stamp = stamps[int(k)]
        at, _ = _project(views[stamp][0], corners)
        if bool(((at >= 1) & (at <= np.array(size_px) - 2)).all()):
            return stamp
    return None


def _project(camera: PlacedCamera, places_m: Float64) -> tuple[Float64, Float64]:
    """Project places (..., 3) into a rectified picture: px (..., 2) and depth (...) m."""
    seen = (places_m - camera.map_from_rect.translation) @ camera.map_from_rect.rotation
    depth = np.maximum(seen[..., 2], 1e-3)
    return camera.focal_px * seen[..., :2] / depth[..., None] + np.array(camera.principal_px), depth


def _profile(picture: UInt8, valid: Bool, camera: PlacedCamera, places_m: Float64) -> PitchProfile | None:
    """Sample one picture; None where it doesn't see all of the places."""
    at, depth = _project(camera, places_m)
    x, y = at[..., 0].astype(np.float32), at[..., 1].astype(np.float32)
    inside = cv2.remap(valid.astype(np.uint8), x, y, cv2.INTER_NEAREST, borderValue=0)
    if not inside.all():
        return None
    gray = cv2.remap(picture, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    levels = np.log(np.median(gray, axis=0) + _DARKEST)
    return PitchProfile(levels, float(np.median(depth)) / camera.focal_px)
