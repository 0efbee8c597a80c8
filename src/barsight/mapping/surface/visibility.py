"""Trace lines of sight: check that a point is in the frustum, isn't occluded and has nothing unseen above
it.
"""

from __future__ import annotations

import numpy as np

from barsight.core.arrays import Float32, Float64, kernel
from barsight.mapping.tiles import TILE_CELLS

_CUT_CELLS = 30
_CUT_MARGIN_CELLS = 3
_OVERHANG_CELLS = 10.0
STRIDE = 4
"""Number of cells that a line of sight skips at once where everything around lies below it."""


@kernel(borrows=True)
def point_density(way: tuple[float, float, float], one_point_m: float) -> float:
    """Compute the number of points that a view has in a level cell, at most 1.

    way: from the cell to the eye, m. one_point_m: range at which the spacing of points equals that of cells.
    """
    x, y, z = way
    squared = x * x + y * y + z * z
    return float(min(one_point_m * one_point_m * abs(z) / (squared * np.sqrt(squared)), 1.0))


@kernel(borrows=True)
def is_pictured(x_m: float, y_m: float, z_m: float, planes: Float64, view: int) -> bool:
    """Check that a point lies inside both pictures of a view.

    planes: (6, 4, K), see `ViewFrusta.planes`. view: its number among the K.
    """
    for p in range(planes.shape[0]):
        over = planes[p, 0, view] * x_m + planes[p, 1, view] * y_m + planes[p, 2, view] * z_m
        if over + planes[p, 3, view] < 0:
            return False
    return True


@kernel(borrows=True)
def may_be_occluded(
    point: tuple[float, float, float],
    row: int,
    column: int,
    around: Float32,
    ceiling: float,
    planes: Float64,
    cell_m: float,
    min_views: float,
) -> bool:
    """Check for possible occlusion: within `_CUT_CELLS` along x or y, a much higher surface ends at a place
    where fewer than min_views views could see it continue towards the point, because their pictures end
    there.

    point: m. around: (rows, columns) heights of the tile and its eight neighbours, m; row, column: the
    point's, in the tile. planes: of all views, as for `has_enough_views`.
    """
    x_m, y_m = point[0], point[1]
    if has_enough_views(x_m, y_m, ceiling, planes, min_views):
        return False
    for direction in range(4):
        di, dj = (0, 0, 1, -1)[direction], (1, -1, 0, 0)[direction]
        for n in range(1, _CUT_CELLS + 1):
            height = float(around[row + TILE_CELLS + n * di, column + TILE_CELLS + n * dj])
            if height > point[2] + _OVERHANG_CELLS * cell_m:
                outward = max(n - _CUT_MARGIN_CELLS, 0) * cell_m
                x_there, y_there = x_m + dj * outward, y_m + di * outward
                if not has_enough_views(x_there, y_there, height, planes, min_views):
                    return True
                break
    return False


@kernel(borrows=True)
def has_enough_views(x_m: float, y_m: float, z_m: float, planes: Float64, min_views: float) -> bool:
    """Check that at least min_views views have the point in both pictures.

    planes: (6, 4, K), see `ViewFrusta.planes`.
    """
    having = 0
    for view in range(planes.shape[2]):
        if having >= min_views:
            break
        having += is_pictured(x_m, y_m, z_m, planes, view)
    return bool(having >= min_views)


@kernel(inline=True)
def is_unoccluded(
    z_m: float,
    row: int,
    column: int,
    way: tuple[float, float, float],
    around: Float32,
    roof: Float32,
    ceiling: float,
    cell_m: float,
) -> bool:
    """Check that no cell in between rises above the line from a point at z_m, in a cell of the middle tile,
    to an eye above it. way: from the point to the eye, m.

    roof: the highest within a stride, of `highest_about`; a rising line that is over the roof skips a stride
    at once. around: (3 TILE_CELLS, 3 TILE_CELLS) heights of the tile and its neighbours, m; ceiling: the
    highest of them.
    """
    x, y, z = way
    length = max(abs(x), abs(y)) / cell_m
    if length < 2:
        return True
    scale = 1 / (length * cell_m)
    step_x, step_y, step_z = x * scale, y * scale, z * scale * cell_m
    n = 2
    while n < int(length):
        height = z_m + n * step_z
        if height > ceiling:
            return True
        i, j = int(np.rint(row + TILE_CELLS + n * step_y)), int(np.rint(column + TILE_CELLS + n * step_x))
        if i < 0 or j < 0 or i >= around.shape[0] or j >= around.shape[1]:
            return True
        if step_z >= 0 and roof[i // STRIDE, j // STRIDE] <= height + cell_m:
            n += STRIDE
            continue
        if around[i, j] > height + cell_m:
            return False
        n += 1
    return True
