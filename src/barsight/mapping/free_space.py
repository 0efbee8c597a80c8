"""Carve free space: each line of sight to a measured height proves that nothing stands in its way.

Each cell stores the lowest height at which lines of sight of two views have passed over it: nothing there is
higher, whether or not the cell itself was seen.
"""

from __future__ import annotations

import math
from collections.abc import Callable, MutableMapping
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from barsight.core.arrays import Bool, Float32, Float64, Int32, UInt8, kernel
from barsight.mapping.observation import CellObservations
from barsight.mapping.spilled_tiles import TileKey
from barsight.mapping.tiles import TILE_CELLS, covering_tiles, tile_overlap, tile_places

OVER_END_M = 0.02
"""Margin added to the height of a line of sight when it lowers a cell's bound."""
MARGIN_M = 0.5
"""Distance around a view's heights within which cells are bounded."""
LEVEL_CELLS, LEVEL_REACH_M, LEVEL_M = 2, 0.02, 0.05
"""Distance, minimum in cells and in m, and maximum height difference within it for a line of sight to count:
around its end, the view must see only heights this close. At edges, matching mixes foreground and background.
"""
BESIDE_M = 0.02
"""Maximum distance of a hole beside an end, rounded up to whole cells, for which its line of sight doesn't
count.
"""
UNPROVEN = np.float32(np.inf)
NO_END = np.float32(-np.inf)
_NEAREST_CELLS = 2
"""Number of steps from the eye's own place at which a sweep ends."""
_DIAGONAL_CELLS = math.sqrt(2.0)


@dataclass(eq=False)
class FreeSpace:
    """Upper bounds (m) of the height of anything in each cell, from the two views with the lowest bounds.

    cell_m: side of the map's cells. tiles: (2, TILE_CELLS, TILE_CELLS) each, the lowest bound and the second
    lowest; 2 MiB per 5 m square at cells of 10 mm.
    """

    cell_m: float
    tiles: MutableMapping[TileKey, Float32] = field(default_factory=dict)

    def carve(self, cells: CellObservations, eyes_m: Float64) -> None:
        """Carve with the lines of sight of one view. eyes_m: (E, 3) positions of its cameras, reference
        frame.
        """
        if cells.x.size == 0:
            return
        margin = math.ceil(MARGIN_M / self.cell_m)
        column, row = int(cells.x.min()) - margin, int(cells.y.min()) - margin
        shape = int(cells.y.max()) - row + margin + 1, int(cells.x.max()) - column + margin + 1
        ends, holes = level_heights(cells, (column, row), shape, self.cell_m)
        bound = np.full(shape, UNPROVEN)
        for eye in eyes_m:
            sweep_rays(ends, holes, eye - (column * self.cell_m, row * self.cell_m, 0), self.cell_m, bound)
        for key in covering_tiles(column, row, shape):
            self._merge(key, column, row, bound)

    def window(self, column: int, row: int, columns: int, rows: int) -> Float32:
        """Return bounds (rows, columns) starting at cell (column, row); inf where no bound is proven."""
        out = np.full((rows, columns), UNPROVEN)
        for key in covering_tiles(column, row, out.shape):
            tile = self.tiles.get(key)
            if tile is not None:
                ours, theirs = tile_overlap(key, column, row, out.shape)
                out[theirs] = tile[1][ours]
        return out

    def lower(self, column: int, row: int, bound: Float32) -> None:
        """Lower the bounds of the cells from column and row on to `bound` (rows, columns), where that is
        lower.
        """
        for key in covering_tiles(column, row, bound.shape):
            if key in self.tiles:
                ours, theirs = tile_overlap(key, column, row, bound.shape)
                tile = self.tiles[key]
                tile[(slice(None), *ours)] = np.minimum(tile[(slice(None), *ours)], bound[theirs])

    def rise(self, rise_m: float) -> None:
        """Move all bounds up."""
        for key in self.tiles:
            self.tiles[key] += np.float32(rise_m)

    def forget(self, forgotten: Callable[[NDArray[Any], NDArray[Any]], Bool]) -> None:
        """Discard bounds. forgotten: marks the places, by x and y (m) of a grid."""
        for key in sorted(self.tiles):
            self.tiles[key][:, forgotten(*tile_places(key, self.cell_m))] = UNPROVEN

    def join(
        self, newer: FreeSpace, rise_m: float, forgotten: Callable[[NDArray[Any], NDArray[Any]], Bool]
    ) -> None:
        """Merge the bounds of a newer pass, raised by rise_m. forgotten: marks the places, by x and y (m)
        of a grid, that have changed since, where only the newer pass's bounds remain valid.
        """
        for key in sorted({*self.tiles, *newer.tiles}):
            mine = self.tiles.setdefault(key, np.full((2, TILE_CELLS, TILE_CELLS), UNPROVEN))
            mine[:, forgotten(*tile_places(key, self.cell_m))] = UNPROVEN
            if key in newer.tiles:
                np.minimum(mine, newer.tiles[key] + np.float32(rise_m), out=mine)

    def _merge(self, key: TileKey, column: int, row: int, bound: Float32) -> None:
        ours, theirs = tile_overlap(key, column, row, bound.shape)
        new = bound[theirs]
        if not np.isfinite(new).any():
            return
        tile = self.tiles.setdefault(key, np.full((2, TILE_CELLS, TILE_CELLS), UNPROVEN))
        first, second = tile[0][ours], tile[1][ours]
        tile[1][ours] = np.minimum(second, np.maximum(first, new))
        tile[0][ours] = np.minimum(first, new)


def level_heights(
    cells: CellObservations, corner: tuple[int, int], shape: tuple[int, int], cell_m: float
) -> tuple[Float32, UInt8]:
    """Return the highest level height in each cell (H, W) of a grid that starts at `corner` (x, y), NO_END
    where there is none, and the view's holes: 1 where it sees nothing, other than in gaps a cell wide.

    A height is level if it is close to all heights that the view sees around it.
    """
    highest, lowest = np.full(shape, NO_END), np.full(shape, UNPROVEN)
    bound_heights(cells.x, cells.y, cells.z_m, corner, highest, lowest)
    seen = (highest > NO_END).astype(np.uint8)
    holes = 1 - cv2.morphologyEx(seen, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    reach = max(math.ceil(LEVEL_REACH_M / cell_m - 1e-6), LEVEL_CELLS)
    about = np.ones((2 * reach + 1,) * 2, np.uint8)
    highest, lowest = cv2.dilate(highest, about), cv2.erode(lowest, about)
    level = np.full(shape, NO_END)
    _mark_level(cells.x, cells.y, cells.z_m, corner, highest, lowest, level)
    return level, holes


@kernel()
def bound_heights(
    x: Int32, y: Int32, z: Float32, corner: tuple[int, int], highest: Float32, lowest: Float32
) -> None:
    """Bound the heights z (N,) of each cell x, y (N,), in place: raise `highest` and lower `lowest` (H,
    W), whose first cell is `corner` (x, y).
    """
    low_x, low_y = np.int32(corner[0]), np.int32(corner[1])
    for k in range(z.size):
        i, j = np.uint32(y[k] - low_y), np.uint32(x[k] - low_x)
        highest[i, j] = max(highest[i, j], z[k])
        lowest[i, j] = min(lowest[i, j], z[k])


@kernel()
def _mark_level(
    x: Int32, y: Int32, z: Float32, corner: tuple[int, int], highest: Float32, lowest: Float32, level: Float32
) -> None:
    """Raise `level` (H, W), which starts at `corner`, to those of the heights z (N,) of the cells x, y (N,)
    that are within LEVEL_M of the highest and the lowest height around them (H, W).
    """
    low_x, low_y = np.int32(corner[0]), np.int32(corner[1])
    for k in range(z.size):
        i, j = np.uint32(y[k] - low_y), np.uint32(x[k] - low_x)
        if max(highest[i, j] - z[k], z[k] - lowest[i, j]) < np.float32(LEVEL_M):
            level[i, j] = max(level[i, j], z[k])


@kernel()
def sweep_rays(ends: Float32, holes: UInt8, eye: Float64, cell_m: float, bound: Float32) -> None:
    """Lower the bounds (R, C) along the lines of sight from the eye (3,) to the heights `ends` (R, C), which
    are NO_END where no line of sight ends. holes: (R, C), 1 where the view sees nothing.

    Vertical planes through the eye and each cell of the border are swept inwards. Of all lines of sight that
    end farther out than a cell at the horizontal distance d, the steepest is the lowest there:
    z_eye - d max((z_eye - z_end) / d_end). A cell's bound is its height where it leaves the cell, plus
    OVER_END_M. The origin is the centre of the first cell.
    """
    rows, columns = bound.shape
    x0, y0 = eye[0] / cell_m, eye[1] / cell_m
    beside_cells = int(np.ceil(BESIDE_M / cell_m - 1e-6))
    steepness = _steepness(ends, holes, x0, y0, eye[2], beside_cells)
    over_eye = np.float32(eye[2] + OVER_END_M)
    for n in range(2 * (rows + columns)):
        side, place = (n // columns, n % columns) if n < 2 * columns else divmod(n - 2 * columns, rows)
        if n < 2 * columns:
            first_x, first_y = float(place), float(side * (rows - 1))
        else:
            first_x, first_y = float(side * (columns - 1)), float(place)
        # One column or one row on with each step.
        steps = max(abs(x0 - first_x), abs(y0 - first_y))
        step_x, step_y = (x0 - first_x) / max(steps, 1.0), (y0 - first_y) / max(steps, 1.0)
        step = np.sqrt(step_x**2 + step_y**2)
        steepest, next_steepest = -np.float32(np.inf), -np.float32(np.inf)
        for k in range(int(steps) - _NEAREST_CELLS + 1):
            x, y = first_x + k * step_x + 0.5, first_y + k * step_y + 0.5
            if not (0 <= x < columns and 0 <= y < rows):
                break
            row, column = np.uint32(y), np.uint32(x)
            steepest = max(steepest, next_steepest)
            over = over_eye - np.float32((steps - k) * step - _DIAGONAL_CELLS) * steepest
            if over < bound[row, column]:
                bound[row, column] = over
            next_steepest = steepness[row, column]


@kernel()
def _steepness(ends: Float32, holes: UInt8, x0: float, y0: float, z_m: float, beside_cells: int) -> Float32:
    """Compute the drop per cell (R, C) of the lines of sight from the height z_m over the place x0, y0
    (cells) to the ends (R, C); -inf where there is no end below the eye, or one of the holes (R, C) is within
    beside_cells of it across the line of sight: there the background may have been matched in place of
    something that stands.
    """
    steepness = np.full(ends.shape, -np.float32(np.inf), np.float32)
    for i in range(ends.shape[0]):
        across = np.float32((i - y0) ** 2)
        for j in range(ends.shape[1]):
            drop = np.float32(z_m) - ends[i, j]
            if 0 < drop < np.inf:
                away = np.sqrt(across + np.float32(j - x0) ** 2)
                aside_x, aside_y = (y0 - i) / away, (j - x0) / away
                if not _is_beside_hole(holes, i, j, aside_x, aside_y, beside_cells):
                    steepness[i, j] = drop / away
    return steepness


@kernel()
def _is_beside_hole(holes: UInt8, i: int, j: int, aside_x: float, aside_y: float, beside_cells: int) -> bool:
    """Check whether a cell i, j has one of the holes (R, C) within beside_cells to either side."""
    for aside in range(-beside_cells, beside_cells + 1):
        y, x = i + aside * aside_y + 0.5, j + aside * aside_x + 0.5
        if 0 <= x < holes.shape[1] and 0 <= y < holes.shape[0] and holes[int(y), int(x)]:
            return True
    return False
