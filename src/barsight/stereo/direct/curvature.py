"""Estimate the curvature of a disparity across the axis of its tile."""

from __future__ import annotations

import numpy as np

from barsight.core.arrays import Float32, kernel
from barsight.stereo.direct.support_regions import TILE_COLUMNS, TILE_ROWS

_REACH_PX = 5
_SCALE = np.float32(1 / _REACH_PX**2)
_STEEPEST_PX = np.float32(2.5)
_ROUNDEST_PX = np.float32(0.75)


@kernel()
def curvature_row(disparity: Float32, axes: Float32, y: int, curvature: Float32) -> None:
    """Compute the second derivative (W,) (1 / px) of row y across each tile's axis, from points 5 px to
    both sides; 0 beside jumps, where it is meaningless. disparity: (H, W), no NaN.
    """
    height, width = disparity.shape
    middle = disparity[y]
    for tile_x in range(axes.shape[1]):
        axis_x, axis_y = axes[y // TILE_ROWS, tile_x, 0], axes[y // TILE_ROWS, tile_x, 1]
        down, right = round(-_REACH_PX * axis_x), round(_REACH_PX * axis_y)
        after = disparity[min(max(y + down, 0), height - 1)]
        before = disparity[min(max(y - down, 0), height - 1)]
        start, end = tile_x * TILE_COLUMNS, min(width, tile_x * TILE_COLUMNS + TILE_COLUMNS)
        # Clamped columns, which only a tile beside the border needs, prevent vectorisation.
        if min(start + right, start - right) < 0 or max(end + right, end - right) > width:
            for x in range(start, end):
                forth = after[min(max(x + right, 0), width - 1)] - middle[x]
                back = before[min(max(x - right, 0), width - 1)] - middle[x]
                curvature[x] = _bend(forth, back)
        else:
            here, ahead, behind = middle[start:end], after[start + right :], before[start - right :]
            found = curvature[start:end]
            for x in range(end - start):
                found[x] = _bend(ahead[x] - here[x], behind[x] - here[x])


@kernel(inline=True)
def _bend(forth: np.float32, back: np.float32) -> np.float32:
    """Compute the second derivative (1 / px) from the differences to both sides.

    forth, back: disparity 5 px ahead and 5 px behind minus the one here, px. Returns 0 beside a jump: for at
    least 2.5 px in either, or 0.75 px in their sum.
    """
    smooth = (max(abs(forth), abs(back)) < _STEEPEST_PX) & (abs(forth + back) < _ROUNDEST_PX)
    return _SCALE * (forth + back) if smooth else np.float32(0)
