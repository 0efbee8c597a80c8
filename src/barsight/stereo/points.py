"""Disparity to points: triangulation with the noise and the shared part of the uncertainty apart."""

from __future__ import annotations

import numpy as np

from barsight.core.types import Disparity, RectifiedPair, StereoPoints

_LEAST_NOISE_PX = 0.02


def triangulate(
    pair: RectifiedPair,
    disparity: Disparity,
    shared_sigma_px: float,
    max_depth_m: float = float("inf"),
    max_sigma_m: float = float("inf"),
) -> StereoPoints:
    """Points in `rect0` of all pixels that have a disparity.

    depth = f b / (d + doffs); along the ray its sigma is depth^2 / (f b) * sigma_d * |ray|.
    shared_sigma_px is the disparity error that the calibration may cause, the same in every view; the
    method's own bias joins it. Pixels deeper than max_depth_m or less sure than max_sigma_m are left out.
    """
    camera = pair.camera
    shift = disparity.disparity_px + np.float32(camera.doffs_px)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.float32(camera.focal_px * camera.baseline_m) / shift
        usable = (shift > 0) & (depth <= max_depth_m)
        per_px = depth * depth / np.float32(camera.focal_px * camera.baseline_m)
        usable &= per_px * disparity.sigma_px <= max_sigma_m
    rows, columns = np.nonzero(usable)
    depth, per_px = depth[usable], per_px[usable]
    ray_x = ((columns - camera.cx_px) / camera.focal_px).astype(np.float32)
    ray_y = ((rows - camera.cy_px) / camera.focal_px).astype(np.float32)
    along_ray = (per_px * np.sqrt(1 + ray_x * ray_x + ray_y * ray_y)).astype(np.float32)
    variance_px = disparity.sigma_px[usable] ** 2 - np.float32(disparity.bias_sigma_px**2)
    noise_px = np.sqrt(np.maximum(variance_px, np.float32(_LEAST_NOISE_PX**2)))
    return StereoPoints(
        stamp_ns=pair.stamp_ns,
        xyz_m=np.column_stack([ray_x * depth, ray_y * depth, depth]),
        range_sigma_m=along_ray * noise_px,
        shared_sigma_m=along_ray * np.float32(np.hypot(shared_sigma_px, disparity.bias_sigma_px)),
        intensity=pair.left[usable],
    )
