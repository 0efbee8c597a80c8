"""Rectification: raw pairs to pairs whose matches lie on the same row.

Both cameras are turned about their centres so that their x axes run along the baseline and their rows agree
[Fusiello 2000]; the lens distortion is taken off in the same interpolation. The rectified pictures hold all
that both cameras can see, and neither rows nor columns that no match can be in.
"""

from __future__ import annotations

from math import ceil, floor

import cv2
import numpy as np

from barsight.calibration.camera import Camera, Distortion
from barsight.calibration.rig import StereoRig
from barsight.calibration.warp import Warp
from barsight.core.arrays import Bool, Float64
from barsight.core.errors import Failed
from barsight.core.pose import Pose
from barsight.core.types import RectifiedCamera, RectifiedPair, StereoFrame

_MOST_GROWTH = 1.1
"""A rectified side over the raw one, at most: a strong lens's corners show little for their cost."""
_GRID = 65


class Rectifier:
    """Rectifies a rig's pairs. Maps are made once; a pair that is rectified already passes untouched.

    camera: geometry of the rectified pair. body_from_rect0: where the rectified left camera sits.
    valid: (H, W) bool of left and right, see `RectifiedPair`.
    """

    def __init__(self, rig: StereoRig) -> None:
        self._size = (rig.cam0.height, rig.cam0.width)
        self._right_size = (rig.cam1.height, rig.cam1.width)
        rotation = _rectified_axes(rig)
        self.body_from_rect0 = rig.body_from_cam0 @ Pose("cam0", "rect0", rotation, np.zeros(3))
        right_rotation = right_from_rectified(rig)
        self._lenses, self._rotations = (rig.cam0, rig.cam1), (rotation, right_rotation)
        self._warps: tuple[Warp, Warp] | None = None
        if _is_rectified(rig):
            self.camera = RectifiedCamera(
                rig.cam0.fx_px, rig.cam0.cx_px, rig.cam0.cy_px, rig.baseline_m,
                rig.cam1.cx_px - rig.cam0.cx_px, rig.cam0.width, rig.cam0.height,
            )  # fmt: skip
            everywhere = np.ones(self._size, dtype=np.bool_)
            self.valid: tuple[Bool, Bool] = everywhere, everywhere
            return
        focal = (rig.cam0.fx_px + rig.cam0.fy_px + rig.cam1.fx_px + rig.cam1.fy_px) / 4
        low, high, centre = _extent(rig.cam0, rotation, focal)
        right_low, right_high, right_centre = _extent(rig.cam1, right_rotation, focal)
        # What is far lies alike in both pictures, what is near further left in the right one.
        first, last = max(low[0], right_low[0]), min(high[0], right_high[0])
        top, bottom = max(low[1], right_low[1]), min(high[1], right_high[1])
        # Whole pixels: in the middle the pictures' own pixels are read, hardly any between them.
        cx, right_cx = centre[0] - floor(centre[0] + first), right_centre[0]
        right_cx -= floor(right_cx + right_low[0])
        cy = (centre[1] + right_centre[1]) / 2
        cy -= floor(cy + top)
        columns, rows = max(cx + high[0], right_cx + last, rig.cam0.width / 2), cy + bottom
        width, height = ceil(columns) + 1, ceil(max(rows, rig.cam0.height / 2)) + 1
        self.camera = RectifiedCamera(focal, cx, cy, rig.baseline_m, right_cx - cx, width, height)
        left = _warp(rig.cam0, rotation, (focal, cx, cy), (height, width))
        right = _warp(rig.cam1, right_rotation, (focal, right_cx, cy), (height, width))
        self._warps = (left, right)
        self.valid = left.valid, right.valid

    def __call__(self, frame: StereoFrame) -> RectifiedPair | Failed:
        """The rectified pair; Failed `wrong-size` where the images don't have the calibration's size."""
        for name, image, size in (
            ("left", frame.left, self._size),
            ("right", frame.right, self._right_size),
        ):
            if image.shape != size:
                return Failed(
                    "wrong-size",
                    f"the {name} image is {image.shape[1]}x{image.shape[0]}, "
                    f"the calibration is for {size[1]}x{size[0]}",
                )
        left, right = frame.left, frame.right
        if self._warps is not None:
            left, right = self._warps[0](left), self._warps[1](right)
        return RectifiedPair(frame.stamp_ns, left, right, *self.valid, self.camera)

    def places(self, left: Float64, right: Float64) -> tuple[Float64, Float64]:
        """Where raw pixels (N, 2) of cam0 and cam1 come to lie in the rectified pair, (N, 2) each."""
        camera = self.camera
        placed = []
        for lens, rotation, pixels, cx in zip(
            self._lenses, self._rotations, (left, right), (camera.cx_px, camera.cx_px + camera.doffs_px),
            strict=True,
        ):  # fmt: skip
            ray = lens.rays(pixels) @ rotation
            placed.append(camera.focal_px * ray[:, :2] / ray[:, 2:] + (cx, camera.cy_px))
        return placed[0], placed[1]


def _rectified_axes(rig: StereoRig) -> Float64:
    """(3, 3) cam0_from_rect0: x along the baseline, z as near as can be to the mean of the optical axes."""
    if _is_rectified(rig):
        return np.eye(3)
    cam0_from_cam1 = rig.cam0_from_cam1
    x = cam0_from_cam1.translation / rig.baseline_m
    mean_axis = np.array([0.0, 0.0, 1.0]) + cam0_from_cam1.rotation[:, 2]
    y = np.cross(mean_axis, x)
    y /= np.linalg.norm(y)
    return np.column_stack([x, y, np.cross(x, y)])


def right_from_rectified(rig: StereoRig) -> Float64:
    """(3, 3) cam1_from_rect1: the rectified axes, which both cameras share, in the right camera."""
    right: Float64 = rig.cam0_from_cam1.rotation.T @ _rectified_axes(rig)
    return right


def _is_rectified(rig: StereoRig) -> bool:
    place = rig.cam0_from_cam1
    same_rows = (rig.cam0.fx_px, rig.cam0.fy_px, rig.cam0.cy_px) == (
        rig.cam1.fx_px,
        rig.cam1.fy_px,
        rig.cam1.cy_px,
    )
    aligned = np.allclose(place.rotation, np.eye(3), atol=1e-9)
    along_x = np.abs(place.translation[1:]).max() < 1e-9
    square = rig.cam0.fx_px == rig.cam0.fy_px
    same_size = (rig.cam0.width, rig.cam0.height) == (rig.cam1.width, rig.cam1.height)
    ideal = rig.cam0.is_ideal and rig.cam1.is_ideal
    return bool(same_rows and aligned and along_x and square and same_size and ideal)


def _extent(camera: Camera, rotation: Float64, focal: float) -> tuple[list[float], list[float], list[float]]:
    """Lowest and highest x, y that the raw picture's pixels get, px from the rectified principal point, and
    where that point lies if the raw picture's middle stays where it is.
    """
    size = np.array([camera.width, camera.height])
    pixels = np.stack(np.meshgrid(*(np.linspace(0, side - 1, _GRID) for side in size)), axis=-1)
    ray = camera.rays(pixels.reshape(-1, 2)) @ rotation
    places = focal * ray[:, :2] / ray[:, 2:]
    middle, reach = places[len(places) // 2], _MOST_GROWTH * size / 2
    low, high = (np.clip(end, middle - reach, middle + reach) for end in (places.min(0), places.max(0)))
    return low.tolist(), high.tolist(), ((size - 1) / 2 - middle).tolist()


def _warp(
    camera: Camera, rotation: Float64, intrinsics: tuple[float, float, float], size: tuple[int, int]
) -> Warp:
    focal, cx, cy = intrinsics
    new_matrix = np.array([[focal, 0, cx], [0, focal, cy], [0, 0, 1.0]])
    coefficients = np.array(camera.coefficients or (0.0,) * 4, dtype=np.float64)
    make_maps = (
        cv2.fisheye.initUndistortRectifyMap
        if camera.distortion is Distortion.EQUIDISTANT
        else cv2.initUndistortRectifyMap
    )
    map_x, map_y = make_maps(
        camera.matrix, coefficients, rotation.T, new_matrix, (size[1], size[0]), cv2.CV_32FC1
    )
    return Warp.of(map_x, map_y, (camera.height, camera.width))
