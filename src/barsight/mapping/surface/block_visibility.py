"""Bound what a view sees of a whole block of cells, so that most cells needn't be tested one by one.

All bounds are conservative: what is returned for a block holds for every height in it, despite rounding.
"""

from __future__ import annotations

from functools import reduce

import cv2
import numpy as np

from barsight.core.arrays import Bool, Float32, Float64, Int8, kernel
from barsight.mapping.surface.visibility import STRIDE
from barsight.mapping.tiles import TILE_CELLS, VIEWS, Z

BLOCK = STRIDE
"""Side of a block in cells, equal to the stride of the line-of-sight test, so that both share the roof."""
NOWHERE, SOMEWHERE, EVERYWHERE = 0, 1, 2
"""Part of a block in which heights may be inside both pictures of a view."""
_SURE = 1e-6
"""Margin larger than the rounding error of any bound here, in the bound's own unit (m, or m px)."""


def highest_about(around: Float32) -> Float32:
    """Compute the highest height of each block and the blocks around it."""
    highest = reduce(np.maximum, (around[n::BLOCK] for n in range(BLOCK)))
    highest = reduce(np.maximum, (highest[:, n::BLOCK] for n in range(BLOCK)))
    return np.asarray(cv2.dilate(highest, np.ones((3, 3), np.uint8)), np.float32)


@kernel()
def bound_blocks(
    tile: Float32, corner: Float64, roof: Float32, ceiling: float, planes: Float64, eyes: Float64,
    cell_m: float, min_views: float, one_point_m: float, first: int,
) -> tuple[Int8, Bool, Float64, Bool]:  # fmt: skip
    """Bound what K views see of a tile's blocks (B, B).

    Returns where their heights are inside both pictures, (B, B, K); whether `point_density` is 1 everywhere,
    (B, B, K); the height from which `is_unoccluded` holds for either camera, (B, B, K, 2) m, inf if unknown;
    and whether min_views views see each of its cells at the ceiling, (B, B). roof: see `clear_height`. first:
    for views before it, only the first result is computed. A block without heights is in no picture. tile:
    (TILE_CELLS, TILE_CELLS, SLOTS, FIELDS); corner: (2,) column and row of its first cell. planes: (6, 4, K),
    see `ViewFrusta.planes`; eyes: (K, 2, 3) m.
    """
    blocks, views = TILE_CELLS // BLOCK, planes.shape[2]
    within, dense = np.zeros((blocks, blocks, views), np.int8), np.zeros((blocks, blocks, views), np.bool_)
    clear, is_open = np.full((blocks, blocks, views, 2), np.inf), np.zeros((blocks, blocks), np.bool_)
    middle, half, to_middle = np.empty(3), np.full(3, BLOCK / 2 * cell_m), (BLOCK - 1) / 2
    for i in range(blocks):
        for j in range(blocks):
            row, column = i * BLOCK, j * BLOCK
            low, high = supported_span(tile[row : row + BLOCK, column : column + BLOCK], min_views)
            if low > high:
                continue
            at = row + to_middle, column + to_middle
            middle[0], middle[1] = (corner[0] + at[1]) * cell_m, (corner[1] + at[0]) * cell_m
            middle[2], half[2] = ceiling, 0
            is_open[i, j] = (_margins(middle, half, planes)[0] >= 0).sum() >= min_views
            middle[2], half[2] = (low + high) / 2, (high - low) / 2 + _SURE
            least, most = _margins(middle, half, planes)
            for k in range(views):
                if most[k] < 0:
                    continue
                within[i, j, k] = EVERYWHERE if least[k] >= 0 else SOMEWHERE
                for e in range(2 if k >= first else 0):
                    way = eyes[k, e, 0] - middle[0], eyes[k, e, 1] - middle[1], eyes[k, e, 2] - middle[2]
                    clear[i, j, k, e] = clear_height((low, high), at, way, roof, ceiling, cell_m)
                    if e == 0:
                        dense[i, j, k] = _is_dense(way, half, one_point_m)
    return within, dense, clear, is_open


@kernel()
def supported_span(heights: Float32, min_views: float) -> tuple[float, float]:
    """Find the lowest and the highest height with at least min_views views, m; inf and -inf if there is none.

    heights: (rows, columns, SLOTS, FIELDS).
    """
    low, high = np.inf, -np.inf
    for i in range(heights.shape[0]):
        for j in range(heights.shape[1]):
            for s in range(heights.shape[2]):
                if heights[i, j, s, VIEWS] >= min_views:
                    low, high = min(low, heights[i, j, s, Z]), max(high, heights[i, j, s, Z])
    return low, high


@kernel()
def _margins(middle: Float64, half: Float64, planes: Float64) -> tuple[Float64, Float64]:
    """Compute lower and upper bounds (K,) of the margin by which a box's points are inside both pictures of a
    view.

    middle, half: (3,) m, centre of the box and half its sides. planes: (6, 4, K), see `ViewFrusta.planes`.
    """
    least, most = np.full(planes.shape[2], np.inf), np.full(planes.shape[2], np.inf)
    for p in range(planes.shape[0]):
        for k in range(planes.shape[2]):
            over, spread = planes[p, 3, k], _SURE
            for axis in range(3):
                over += planes[p, axis, k] * middle[axis]
                spread += abs(planes[p, axis, k]) * half[axis]
            least[k], most[k] = min(least[k], over - spread), min(most[k], over + spread)
    return least, most


@kernel()
def _is_dense(way: tuple[float, float, float], half: Float64, one_point_m: float) -> bool:
    """Check that `point_density` is 1 everywhere in a box. way: from its centre to the eye, m.

    half: (3,) half its sides, m.
    """
    x, y, z = abs(way[0]) + half[0], abs(way[1]) + half[1], abs(way[2])
    squared = x * x + y * y + (z + half[2]) ** 2
    return bool(one_point_m * one_point_m * (z - half[2]) > (1 + _SURE) * squared * np.sqrt(squared))


@kernel()
def clear_height(
    span: tuple[float, float],
    at: tuple[float, float],
    way: tuple[float, float, float],
    roof: Float32,
    ceiling: float,
    cell_m: float,
) -> float:
    """Compute an upper bound of the height from which `is_unoccluded` holds in each cell of a block; inf if
    unknown.

    span: its lowest and highest height, m. at: row and column of its centre in the middle tile. way: from the
    centre, at mid-height, to the eye, m. roof: (3 B, 3 B), of `highest_about`, B blocks to a tile; ceiling:
    the highest of all heights, m. The lines of sight of a block never diverge by more than its cells, so the
    roof covers all of them: half a block around the centre's line and half a block onward.
    """
    (low, high), (x, y, z) = span, way
    length, side, rise = max(abs(x), abs(y)) / cell_m, BLOCK / 2, z - (high - low) / 2 - _SURE
    if rise <= 0:
        return np.inf
    scale = 1 / (max(length, 1) * cell_m)
    step_x, step_y, step_z = x * scale, y * scale, rise / (length + side)
    last, clear, n = roof.shape[0] * BLOCK - 1, -np.inf, 2
    while low + n * step_z <= ceiling + _SURE and n < length + side:
        if n + BLOCK > length - side or clear > high:
            return np.inf
        i, j = int(at[0] + TILE_CELLS + (n + side) * step_y), int(at[1] + TILE_CELLS + (n + side) * step_x)
        i, j = min(max(i, 0), last), min(max(j, 0), last)
        clear = max(clear, roof[i // BLOCK, j // BLOCK] - cell_m - n * step_z + _SURE)
        n += BLOCK
    return clear
