"""Sample the pictures over bundles: each window in both pictures of the nearest frame over it."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np

from barsight.bundle_pictures.sharpness import is_sharp
from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.arrays import Float64, UInt8
from barsight.core.pose import Pose
from barsight.core.records.pairs import RefusedFrame
from barsight.labels.placing import PlacedCamera
from barsight.recording.rectified_pairs import RectifiedPairs
from barsight.yard.map_lookup import CellGrid, are_blocked
from barsight.yard.types import Bundle, HeightMap

_FROM_M, _OVER_M, _HIDDEN_RATIO = 0.05, 0.025, 0.05
"""Height over a bundle from which on lines of sight are followed, as single bars stand out of it; height over
them from which on a surface hides a point; share of a line's points that may be hidden.
"""
DARKEST = 8.0
"""Offset added to gray levels before their logarithm, so that noise in dark areas counts less."""
_MAX_LENGTH_M = 3.0
"""Maximum length of a window along a bundle, so that one picture shows all of it."""
_TRIED = 10
"""Number of nearest frames that are tried for a window."""


def bundle_axes(bundle: Bundle) -> tuple[Float64, Float64]:
    """Compute a bundle's direction (3,) per horizontal metre along it, and the horizontal unit vector (3,)
    across.
    """
    along = bundle.direction / np.linalg.norm(bundle.direction[:2])
    return along, np.array([along[1], -along[0], 0.0])


@dataclass(frozen=True, eq=False)
class BundleWindow:
    """Lines across a bundle: points (N, 3) of the middle line, and the offsets (R, 3) of all lines from it.

    number: index of the bundle in its list.
    """

    number: int
    middle_m: Float64
    rows_m: Float64

    @property
    def corners_m(self) -> Float64:
        """Return the window's corners (4, 3)."""
        return (self.middle_m[[0, -1]] + self.rows_m[[0, -1], None]).reshape(4, 3)


@dataclass(frozen=True, eq=False)
class WindowPicture:
    """Gray levels (R, N) of a window in one picture.

    pixel_m: size of the picture's pixels on the window. is_sharp: whether the picture is sharp.
    """

    gray: UInt8
    pixel_m: float
    is_sharp: bool


@dataclass(frozen=True, eq=False)
class PlacedFrames:
    """Frames by their stamps, with both cameras and the left camera's position (K, 3) in the map."""

    stamps_ns: tuple[int, ...]
    cameras: tuple[tuple[PlacedCamera, PlacedCamera], ...]
    eyes_m: Float64
    size_px: tuple[int, int]

    @classmethod
    def of(cls, rectifier: Rectifier, poses: Mapping[int, Pose]) -> PlacedFrames:
        """Place frames by their reference_from_body."""
        camera = rectifier.camera
        cameras = tuple(
            PlacedCamera.of_pair(pose @ rectifier.body_from_rect0, camera) for pose in poses.values()
        )
        eyes = np.array([left.map_from_rect.translation for left, _ in cameras]).reshape(-1, 3)
        return cls(tuple(poses), cameras, eyes, (camera.width, camera.height))

    def nearest(self, window: BundleWindow, preferred: Collection[int] = ()) -> int | None:
        """Find the index of the first of `all_nearest`; None if there is none."""
        return next(self.all_nearest(window, preferred), None)

    def all_nearest(self, window: BundleWindow, preferred: Collection[int] = ()) -> Iterator[int]:
        """List the indices of the frames whose left picture shows the whole window, the nearest first.

        Frames in `preferred` come first.
        """
        away = np.hypot(*(self.eyes_m - window.middle_m[len(window.middle_m) // 2])[:, :2].T)
        numbers = np.argsort(away, kind="stable").tolist()
        for k in [k for k in numbers if k in preferred][:_TRIED] + numbers[:_TRIED]:
            at, _ = self.cameras[k][0].project(window.corners_m)
            if bool(((at >= 1) & (at <= np.array(self.size_px) - 2)).all()):
                yield int(k)


def is_placed(bundle: Bundle) -> bool:
    """Check that a bundle's position, width and length are known."""
    return bool(np.isfinite(bundle.centre_m).all() and bundle.width_m > 0 and bundle.length_m > 0)


def windows_along(
    number: int, bundle: Bundle, beside_m: Float64, z_m: float, row_m: float
) -> Iterator[BundleWindow]:
    """Divide a bundle's length into windows of at most _MAX_LENGTH_M.

    beside_m: (N,) positions from its axis. z_m: height of the lines across. row_m: their spacing.
    """
    along, across = bundle_axes(bundle)
    middle = np.append(bundle.centre_m[:2], z_m) + beside_m[:, None] * across
    edges = np.linspace(-0.5, 0.5, int(bundle.length_m / _MAX_LENGTH_M) + 2) * bundle.length_m
    for low, high in pairwise(edges.tolist()):
        yield BundleWindow(number, middle, np.arange(low, high, row_m)[:, None] * along)


def sample_windows(
    pairs: RectifiedPairs, frames: PlacedFrames, windows: Sequence[tuple[int, BundleWindow]]
) -> Iterator[tuple[int, WindowPicture]]:
    """Sample windows in the frames with these indices; yield each picture with the window's index in the
    list.

    Pictures that don't show all of a window and frames that can't be decoded are left out.
    """
    wanted = dict[int, list[int]]()
    for place, (k, _) in enumerate(windows):
        wanted.setdefault(frames.stamps_ns[k], []).append(place)
    for pair in pairs(wanted) if wanted else ():
        if isinstance(pair, RefusedFrame):
            continue
        cameras = frames.cameras[frames.stamps_ns.index(pair.stamp_ns)]
        for picture, valid, camera in zip(
            (pair.left, pair.right), (pair.left_valid, pair.right_valid), cameras, strict=True
        ):
            sharp, seen = is_sharp(picture), valid.astype(np.uint8)
            for place in wanted[pair.stamp_ns]:
                sampled = _sample(picture, seen, camera, windows[place][1])
                if sampled is not None:
                    yield place, WindowPicture(*sampled, sharp)


def _sample(
    picture: UInt8, seen: UInt8, camera: PlacedCamera, window: BundleWindow
) -> tuple[UInt8, float] | None:  # fmt: skip
    x, y, depth = camera.project_sums(window.rows_m, window.middle_m)
    if depth.min() <= 0 or not cv2.remap(seen, x, y, cv2.INTER_NEAREST, borderValue=0).all():
        return None
    gray = cv2.remap(picture, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(gray, np.uint8), float(np.median(depth)) / camera.focal_px


def is_hidden(part: HeightMap, line_m: Float64, eye_m: Float64) -> bool:
    """Check whether the map blocks the view from a camera (3,) to a line of points (N, 3)."""
    eye = np.array(eye_m)  # which may be read-only: to the kernel that is another type, compiled anew
    way = (eye - line_m) / np.maximum(eye[2] - line_m[:, 2:], _FROM_M)
    blocked = are_blocked(CellGrid.of(part), line_m + _FROM_M * way, eye, _OVER_M)
    return bool(blocked.mean() > _HIDDEN_RATIO)
