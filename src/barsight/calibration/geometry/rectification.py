"""Rectify raw pairs so that matches are on the same row.

Both cameras are rotated about their centres so that their x axes are parallel to the baseline and their rows
agree [Fusiello 2000]; lens distortion is removed in the same interpolation.
"""

from __future__ import annotations

import cv2
import numpy as np

from barsight.calibration.geometry.camera import Camera, Distortion
from barsight.calibration.geometry.remap import Warp
from barsight.calibration.geometry.rig import StereoRig
from barsight.core.arrays import Float64, UInt8
from barsight.core.errors import Failed
from barsight.core.pose import Pose
from barsight.core.records.pairs import RectifiedCamera, RectifiedPair, StereoFrame


class Rectifier:
    """Rectifies the pairs of a rig. The maps are computed once; a pair that is already rectified passes
    unchanged.

    camera: geometry of the rectified pair. body_from_rect0: mounting of the rectified left camera.
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
            self._left_valid = self._right_valid = np.ones(self._size, dtype=np.bool_)
            return
        focal = (rig.cam0.fx_px + rig.cam0.fy_px + rig.cam1.fx_px + rig.cam1.fy_px) / 4
        left_centre = _principal_point(rig.cam0, rotation, focal)
        right_centre = _principal_point(rig.cam1, right_rotation, focal)
        cy = (left_centre[1] + right_centre[1]) / 2
        self.camera = RectifiedCamera(
            focal, left_centre[0], cy, rig.baseline_m,
            right_centre[0] - left_centre[0], rig.cam0.width, rig.cam0.height,
        )  # fmt: skip
        left = _warp(rig.cam0, rotation, (focal, left_centre[0], cy), self._size)
        right = _warp(rig.cam1, right_rotation, (focal, right_centre[0], cy), self._size)
        self._warps = (left, right)
        self._left_valid, self._right_valid = left.valid, right.valid

    def __call__(self, frame: StereoFrame) -> RectifiedPair | Failed:
        """Rectify a pair; Failed `wrong-size` where the images differ in size from the calibration."""
        wrong = self.wrong_size(frame)
        if wrong is not None:
            return wrong
        right = frame.right if self._warps is None else self._warps[1](frame.right)
        return self.pair(frame.stamp_ns, self.left(frame.left), right)

    def wrong_size(self, frame: StereoFrame) -> Failed | None:
        """Return Failed `wrong-size` where the images differ in size from the calibration, otherwise None."""
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
        return None

    def pair(self, stamp_ns: int, left: UInt8, right: UInt8) -> RectifiedPair:
        """Combine two pictures that this rectifier has rectified into a pair with its geometry."""
        return RectifiedPair(stamp_ns, left, right, self._left_valid, self._right_valid, self.camera)

    def left(self, image: UInt8) -> UInt8:
        """Rectify the left image alone; it must have the calibration's size."""
        return image if self._warps is None else self._warps[0](image)

    def places(self, left: Float64, right: Float64) -> tuple[Float64, Float64]:
        """Rectify raw pixels (N, 2) of cam0 and of cam1; returns both, (N, 2) each."""
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
    """Compute cam0_from_rect0 (3, 3): x along the baseline, z as close as possible to the mean optical
    axis.
    """
    if _is_rectified(rig):
        return np.eye(3)
    cam0_from_cam1 = rig.cam0_from_cam1
    x = cam0_from_cam1.translation / rig.baseline_m
    mean_axis = np.array([0.0, 0.0, 1.0]) + cam0_from_cam1.rotation[:, 2]
    y = np.cross(mean_axis, x)
    y /= np.linalg.norm(y)
    return np.column_stack([x, y, np.cross(x, y)])


def right_from_rectified(rig: StereoRig) -> Float64:
    """Compute cam1_from_rect1 (3, 3): the rectified axes, which both cameras share, in the right camera."""
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


def _principal_point(camera: Camera, rotation: Float64, focal: float) -> tuple[float, float]:
    """Compute the principal point that keeps the middle of the raw image in the middle of the rectified
    one.
    """
    middle = np.array([[(camera.width - 1) / 2, (camera.height - 1) / 2]])
    ray = camera.rays(middle)[0] @ rotation
    x, y = middle[0] - focal * ray[:2] / ray[2]
    return float(x), float(y)


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
