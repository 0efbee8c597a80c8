"""Check matches: enforce left-right consistency and remove islands (speckles)."""

from __future__ import annotations

import cv2
import numpy as np

from barsight.core.arrays import Bool, Float32, kernel

_STEPS, _NONE = 16, -32768
"""Number of steps per pixel in which disparities are searched for islands, and their value where unknown."""


def is_consistent(left_px: Float32, right_px: Float32, tolerance_px: float) -> Bool:
    """Check left-right consistency (H, W): the right image's disparity at the match must be the same within
    the tolerance.

    No NaN in left_px.
    """
    same = np.empty(left_px.shape, dtype=np.bool_)
    _agree(left_px, right_px, np.float32(tolerance_px), same)
    return same


def hits_valid(valid: Bool, disparity: Float32) -> Bool:
    """Check (H, W) that the match, clamped to the image, is valid in the right image. No NaN."""
    landed = np.empty(valid.shape, dtype=np.bool_)
    _land(valid, disparity, landed)
    return landed


@kernel()
def _agree(left_px: Float32, right_px: Float32, tolerance: np.float32, same: Bool) -> None:
    """Check left-right consistency at the nearest whole column.

    left_px (no NaN), right_px: (H, W) px; tolerance: px. Fills same (H, W); False where the match lies
    outside or the right image has no disparity (NaN).
    """
    height, width = left_px.shape
    for y in range(height):
        seen = right_px[y]
        for x in range(width):
            same[y, x] = agrees_with(seen, x, left_px[y, x], tolerance)


@kernel(inline=True)
def agrees_with(right_px: Float32, x: int, disparity: np.float32, tolerance: np.float32) -> bool:
    """Check that the right picture's disparity (W,) px at the match of column x is the same within the
    tolerance.
    """
    column = np.int32(np.rint(np.float32(x) - disparity))
    is_inside = (column >= 0) & (column < len(right_px))
    # No branch, which would be mispredicted as often as the pictures disagree.
    seen = right_px[np.uint64(column if is_inside else 0)]
    return bool(is_inside & (abs(seen - disparity) <= tolerance))


@kernel()
def _land(valid: Bool, disparity: Float32, landed: Bool) -> None:
    """Look up the right image's mask (H, W) at each match, its column clamped to the image.

    disparity: (H, W) px, no NaN. Fills landed (H, W).
    """
    height, width = valid.shape
    for y in range(height):
        for x in range(width):
            column = np.int32(np.rint(np.float32(x) - disparity[y, x]))
            landed[y, x] = valid[y, min(max(column, 0), width - 1)]


@kernel()
def drop_invalid(left_valid: Bool, right_valid: Bool, disparity: Float32) -> None:
    """Set disparities (H, W) px to NaN at invalid pixels and where the match isn't valid, in place."""
    height, width = disparity.shape
    for y in range(height):
        for x in range(width):
            here = disparity[y, x]
            if np.isnan(here):
                continue
            column = np.int32(np.rint(np.float32(x) - here))
            if not (left_valid[y, x] and right_valid[y, min(max(column, 0), width - 1)]):
                disparity[y, x] = np.float32(np.nan)


def remove_islands(disparity: Float32, min_size_px: int, step_px: float) -> Float32:
    """Remove connected patches smaller than min_size_px; neighbours that differ by at most step_px are
    connected.
    """
    known = np.isfinite(disparity)
    if not known.any() or min_size_px < 2:
        return disparity
    offset = cv2.mean(disparity, known.view(np.uint8))[0]
    fixed = cv2.addWeighted(disparity, _STEPS, disparity, 0, -_STEPS * offset, dtype=cv2.CV_16S)
    fixed[~known] = _NONE
    cv2.filterSpeckles(fixed, _NONE, min_size_px, step_px * _STEPS)
    return np.where(fixed == _NONE, np.float32(np.nan), disparity)
