"""How round a disparity is across the axis of its tile."""

from __future__ import annotations

import numpy as np
from numba import prange

from barsight.core.arrays import Float32, kernel
from barsight.stereo.supports import TILE_COLUMNS, TILE_ROWS

_REACH_PX = 5
_STEEPEST_PX = 2.5
_ROUNDEST_PX = 0.75


def curvature_across(disparity: Float32, axes: Float32) -> Float32:
    """(H, W) second derivative (1 / px) across each tile's axis, out of points 5 px to both sides; 0 beside
    jumps, where it says nothing. No NaN in."""
    curvature = np.empty_like(disparity)
    _curvature_across(disparity, axes, curvature)
    return curvature


@kernel(parallel=True)
def _curvature_across(disparity: Float32, axes: Float32, curvature: Float32) -> None:
    height, width = disparity.shape
    scale = np.float32(1.0 / _REACH_PX**2)
    for tile_y in prange(axes.shape[0]):
        for tile_x in range(axes.shape[1]):
            down = round(-_REACH_PX * axes[tile_y, tile_x, 0])
            right = round(_REACH_PX * axes[tile_y, tile_x, 1])
            for y in range(tile_y * TILE_ROWS, min(height, tile_y * TILE_ROWS + TILE_ROWS)):
                after = disparity[min(max(y + down, 0), height - 1)]
                before = disparity[min(max(y - down, 0), height - 1)]
                for x in range(tile_x * TILE_COLUMNS, min(width, tile_x * TILE_COLUMNS + TILE_COLUMNS)):
                    here = disparity[y, x]
                    forth = after[min(max(x + right, 0), width - 1)] - here
                    back = before[min(max(x - right, 0), width - 1)] - here
                    smooth = max(abs(forth), abs(back)) < _STEEPEST_PX and abs(forth + back) < _ROUNDEST_PX
                    curvature[y, x] = scale * (forth + back) if smooth else np.float32(0)
