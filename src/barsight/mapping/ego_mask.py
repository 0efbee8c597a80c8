"""Mask what travels with the crane, such as its magnet: it stays in place in the picture while the yard
moves.

A view's depth and pose predict where each pixel lies in the picture taken before or after it. If that picture
shows the same content not there but at the pixel's own place, the thing moved with the crane and is left out
of every map.
"""

from __future__ import annotations

import cv2
import numpy as np

from barsight.core.arrays import Bool, Float32, UInt8
from barsight.core.pose import Pose
from barsight.core.records.pairs import RectifiedCamera

_SHRINK = 4
_SWING = 2
"""Maximum distance, in downsampled pixels, by which a hanging thing may swing between two pictures."""
MIN_WAY_PX = 6.0 * _SHRINK
_WINDOW, _SMOOTH, _MIN_SIZE, _MARGIN = 9, 15, 5, 7
_ALIKE = 0.6
"""Maximum ratio of the difference without motion to the difference with it, for a pixel to count as
stationary.
"""
_MIN_DIFFERENCE = 2.0


def mask_carried(
    left: UInt8, disparity_px: Float32, camera: RectifiedCamera, neighbour: UInt8, neighbour_from_here: Pose
) -> Bool:
    """Detect stationary pixels (H, W) between the rectified left pictures `left` and `neighbour`, both (H,
    W).

    neighbour_from_here: transform between the two views' rect0. Nothing is detected where the yard itself
    moves by less than `MIN_WAY_PX`, nor where the picture has too little texture to decide.
    """
    here, there = _shrunk(left), _shrunk(neighbour)
    first = _SHRINK // 2
    shift = disparity_px[first::_SHRINK, first::_SHRINK][: here.shape[0], : here.shape[1]] + camera.doffs_px
    matched = np.isfinite(shift) & (shift > 0)
    depth = camera.focal_px * camera.baseline_m / np.where(matched, shift, np.inf).clip(1e-3, None)
    v, u = (
        np.float32(_SHRINK) * np.arange(size, dtype=np.float32) + (_SHRINK - 1) / 2 for size in here.shape
    )
    x, y = (u[None] - camera.cx_px) / camera.focal_px, (v[:, None] - camera.cy_px) / camera.focal_px
    turn, way_m = neighbour_from_here.rotation.astype(np.float32), neighbour_from_here.translation
    there_x, there_y, there_z = (
        (turn[k, 0] * x + turn[k, 1] * y + turn[k, 2]) * depth + np.float32(way_m[k]) for k in range(3)
    )
    ahead = matched & (there_z > 1e-3)
    scale = camera.focal_px / np.where(ahead, there_z, 1.0)
    at_x, at_y = scale * there_x + camera.cx_px, scale * there_y + camera.cy_px
    way = np.hypot(at_x - u[None], at_y - v[:, None])
    place_x, place_y = (((at + 0.5) / _SHRINK - 0.5).astype(np.float32) for at in (at_x, at_y))
    # Near the border, the local mean covers different content in the two pictures.
    known = np.full(here.shape, np.nan, np.float32)
    known[_SMOOTH // 2 : -(_SMOOTH // 2), _SMOOTH // 2 : -(_SMOOTH // 2)] = 0.0
    moved = cv2.remap(there + known, place_x, place_y, cv2.INTER_LINEAR, borderValue=float("nan"))
    by_motion = _difference(here, np.asarray(np.where(np.isnan(moved + known), here, moved), np.float32))
    still = np.full(here.shape, np.inf, np.float32)
    edge = cv2.copyMakeBorder(there, _SWING, _SWING, _SWING, _SWING, cv2.BORDER_REPLICATE)
    for i in range(2 * _SWING + 1):
        for j in range(2 * _SWING + 1):
            other = edge[i : i + here.shape[0], j : j + here.shape[1]]
            np.minimum(still, _difference(here, other), out=still)
    found = ahead & (way > MIN_WAY_PX) & (by_motion > _MIN_DIFFERENCE) & (still < _ALIKE * by_motion)
    least, margin = np.ones((_MIN_SIZE, _MIN_SIZE), np.uint8), np.ones((_MARGIN, _MARGIN), np.uint8)
    grown = cv2.dilate(cv2.morphologyEx(found.astype(np.uint8), cv2.MORPH_OPEN, least), margin)
    whole: Bool = cv2.resize(grown, left.shape[::-1], interpolation=cv2.INTER_NEAREST) > 0
    return whole


def _shrunk(image: UInt8) -> Float32:
    """Downsample by four and subtract the local mean."""
    size = (image.shape[1] // _SHRINK, image.shape[0] // _SHRINK)
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    return np.asarray(small - cv2.blur(small, (_SMOOTH, _SMOOTH)), np.float32)


def _difference(here: Float32, there: Float32) -> Float32:
    """Average the absolute difference over a square window."""
    return np.asarray(cv2.blur(cv2.absdiff(here, there), (_WINDOW, _WINDOW)), np.float32)
