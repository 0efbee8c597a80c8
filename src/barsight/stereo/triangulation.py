"""Triangulate disparity, with the noise and the shared part of the uncertainty kept separate."""

from __future__ import annotations

from itertools import product
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from barsight.core.arrays import Bool, Float32, Float64, UInt8, kernel
from barsight.core.records.disparity import Disparity, StereoPoints
from barsight.core.records.pairs import RectifiedPair

_MIN_NOISE_PX = 0.02
_JUMP_PX = 1.0


def triangulate_disparity(
    pair: RectifiedPair,
    disparity: Disparity,
    shared_sigma_px: float,
    max_depth_m: float = float("inf"),
    max_sigma_m: float = float("inf"),
    per_pixel: int = 1,
) -> StereoPoints:
    """Triangulate points in `rect0` of all pixels that have a disparity.

    depth = f b / (d + doffs); along the ray its sigma is depth^2 / (f b) * sigma_d * |ray|. shared_sigma_px
    is the disparity error due to the calibration, the same in every view; the method's own bias is added to
    it. Pixels deeper than max_depth_m, or with a depth sigma over max_sigma_m, are left out. per_pixel:
    points per pixel along each axis, for maps whose cells are finer than the pixels.
    """
    camera = pair.camera
    shift = refine_grid(disparity.disparity_px, per_pixel) + np.float32(camera.doffs_px)
    lens = np.array([camera.focal_px, camera.cx_px, camera.cy_px, camera.baseline_m])
    shared_px = float(np.hypot(shared_sigma_px, disparity.bias_sigma_px))
    points = _points(
        shift, disparity.sigma_px, pair.left, per_pixel, lens, disparity.bias_sigma_px, shared_px,
        max_depth_m, max_sigma_m,
    )  # fmt: skip
    return StereoPoints(pair.stamp_ns, *points)


@kernel()
def _points(
    shift: Float32,
    sigma_px: Float32,
    left: UInt8,
    per_pixel: int,
    lens: Float64,
    bias_px: float,
    shared_px: float,
    max_depth_m: float,
    max_sigma_m: float,
) -> tuple[Float32, Float32, Float32, UInt8]:
    """Compute points, noise and shared sigma along the ray, and gray levels, row by row.

    shift: (H per_pixel, W per_pixel) disparity + doffs, px; sigma_px, left: (H, W). lens: (4,) focal px, cx,
    cy, baseline m. Returns (N, 3) m in `rect0`, (N,) m, (N,) m and (N,).
    """
    focal, strength = lens[0], lens[0] * lens[3]
    xyz = np.empty((shift.size, 3), np.float32)
    noise, shared = np.empty(shift.size, np.float32), np.empty(shift.size, np.float32)
    intensity = np.empty(shift.size, np.uint8)
    n = 0
    for i in range(shift.shape[0]):
        ray_y = ((i + 0.5) / per_pixel - 0.5 - lens[2]) / focal
        for j in range(shift.shape[1]):
            if not shift[i, j] > 0:
                continue
            depth = strength / shift[i, j]
            per_px = depth * depth / strength
            sigma = sigma_px[i // per_pixel, j // per_pixel]
            if not (depth <= max_depth_m and per_px * sigma <= max_sigma_m):
                continue
            ray_x = ((j + 0.5) / per_pixel - 0.5 - lens[1]) / focal
            along_ray = per_px * np.sqrt(1 + ray_x * ray_x + ray_y * ray_y)
            xyz[n, 0], xyz[n, 1], xyz[n, 2] = ray_x * depth, ray_y * depth, depth
            noise[n] = along_ray * np.sqrt(max(sigma * sigma - bias_px * bias_px, _MIN_NOISE_PX**2))
            shared[n] = along_ray * shared_px
            intensity[n] = left[i // per_pixel, j // per_pixel]
            n += 1
    return xyz[:n], noise[:n], shared[:n], intensity[:n]


def refine_grid(disparity: Float32, per_pixel: int) -> Float32:
    """Upsample (H, W) to (H * per_pixel, W * per_pixel), bilinear within a surface and nearest at jumps
    and gaps.
    """
    if per_pixel == 1:
        return disparity
    nearest = _repeat(disparity, per_pixel)
    height, width = nearest.shape
    smooth = cv2.resize(disparity, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.where(_repeat(_is_smooth(disparity), per_pixel), smooth, nearest)


def _is_smooth(disparity: Float32) -> Bool:
    """Check (H, W) that no neighbour, diagonal ones included, is unknown or beyond a jump."""
    around = np.pad(disparity, 1, mode="edge")
    height, width = disparity.shape
    smooth = np.ones(disparity.shape, dtype=np.bool_)
    for i, j in product(range(3), range(3)):
        smooth &= np.abs(around[i : i + height, j : j + width] - disparity) <= _JUMP_PX
    return smooth


def _repeat(values: NDArray[Any], per_pixel: int) -> NDArray[Any]:
    return values if per_pixel == 1 else values.repeat(per_pixel, axis=0).repeat(per_pixel, axis=1)
