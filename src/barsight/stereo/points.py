"""Disparity to points: triangulation with the noise and the shared part of the uncertainty apart."""

from __future__ import annotations

from itertools import product
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from barsight.core.arrays import Bool, Float32
from barsight.core.types import Disparity, RectifiedPair, StereoPoints

_LEAST_NOISE_PX = 0.02
_JUMP_PX = 1.0


def triangulate(
    pair: RectifiedPair,
    disparity: Disparity,
    shared_sigma_px: float,
    max_depth_m: float = float("inf"),
    max_sigma_m: float = float("inf"),
    per_pixel: int = 1,
) -> StereoPoints:
    """Points in `rect0` of all pixels that have a disparity.

    depth = f b / (d + doffs); along the ray its sigma is depth^2 / (f b) * sigma_d * |ray|.
    shared_sigma_px is the disparity error that the calibration may cause, the same in every view; the
    method's own bias joins it. Pixels deeper than max_depth_m or less sure than max_sigma_m are left out.
    per_pixel: points per pixel along each axis, for maps whose cells are finer than the pixels.
    """
    camera = pair.camera
    strength = np.float32(camera.focal_px * camera.baseline_m)
    shift = refine_grid(disparity.disparity_px, per_pixel) + np.float32(camera.doffs_px)
    sigma = _repeat(disparity.sigma_px, per_pixel)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = strength / shift
        per_px = depth * depth / strength
        usable = (shift > 0) & (depth <= max_depth_m) & (per_px * sigma <= max_sigma_m)
    rows, columns = np.nonzero(usable)
    depth, per_px, sigma = depth[usable], per_px[usable], sigma[usable]
    ray_x = (((columns + 0.5) / per_pixel - 0.5 - camera.cx_px) / camera.focal_px).astype(np.float32)
    ray_y = (((rows + 0.5) / per_pixel - 0.5 - camera.cy_px) / camera.focal_px).astype(np.float32)
    along_ray = (per_px * np.sqrt(1 + ray_x * ray_x + ray_y * ray_y)).astype(np.float32)
    noise_px = np.sqrt(np.maximum(sigma**2 - disparity.bias_sigma_px**2, _LEAST_NOISE_PX**2))
    return StereoPoints(
        stamp_ns=pair.stamp_ns,
        xyz_m=np.column_stack([ray_x * depth, ray_y * depth, depth]),
        range_sigma_m=(along_ray * noise_px).astype(np.float32),
        shared_sigma_m=along_ray * np.float32(np.hypot(shared_sigma_px, disparity.bias_sigma_px)),
        intensity=pair.left[rows // per_pixel, columns // per_pixel],
    )


def refine_grid(disparity: Float32, per_pixel: int) -> Float32:
    """(H, W) to (H * per_pixel, W * per_pixel), bilinear inside a surface, nearest at jumps and gaps."""
    if per_pixel == 1:
        return disparity
    nearest = _repeat(disparity, per_pixel)
    height, width = nearest.shape
    smooth = cv2.resize(disparity, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.where(_repeat(_is_smooth(disparity), per_pixel), smooth, nearest)


def _is_smooth(disparity: Float32) -> Bool:
    """(H, W): no neighbour, oblique ones included, is unknown or further than a jump away."""
    around = np.pad(disparity, 1, mode="edge")
    height, width = disparity.shape
    smooth = np.ones(disparity.shape, dtype=np.bool_)
    for i, j in product(range(3), range(3)):
        smooth &= np.abs(around[i : i + height, j : j + width] - disparity) <= _JUMP_PX
    return smooth


def _repeat(values: NDArray[Any], per_pixel: int) -> NDArray[Any]:
    return values if per_pixel == 1 else values.repeat(per_pixel, axis=0).repeat(per_pixel, axis=1)
