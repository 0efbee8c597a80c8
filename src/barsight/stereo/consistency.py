"""What a match must pass before it is believed: the other image agrees, and it isn't an island."""

from __future__ import annotations

import cv2
import numpy as np

from barsight.core.arrays import Bool, Float32

_STEPS = 16
_NONE = -32768


def agrees(left_px: Float32, right_px: Float32, tolerance_px: float) -> Bool:
    """(H, W) bool: where the right image's disparity at the match is the same within the tolerance."""
    width = left_px.shape[1]
    landing = np.arange(width, dtype=np.float32)[None, :] - left_px
    column = np.rint(landing).astype(np.int32)
    inside = (column >= 0) & (column < width)
    there = np.take_along_axis(right_px, column.clip(0, width - 1), axis=1)
    same: Bool = inside & (np.abs(there - left_px) <= tolerance_px)
    return same


def without_islands(disparity: Float32, least_size_px: int, step_px: float) -> Float32:
    """NaN in place of connected patches smaller than least_size_px; neighbours within step_px connect."""
    known = np.isfinite(disparity)
    if not known.any() or least_size_px < 2:
        return disparity
    offset = np.float32(np.nanmean(disparity))
    fixed = np.where(known, np.rint((disparity - offset) * _STEPS).clip(-32000, 32000), _NONE).astype(
        np.int16
    )
    cv2.filterSpeckles(fixed, _NONE, least_size_px, step_px * _STEPS)
    return np.where(fixed == _NONE, np.float32(np.nan), disparity)
