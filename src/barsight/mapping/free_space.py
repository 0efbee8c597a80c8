"""Carve free space: each line of sight to a measured height proves that nothing stands in its way.

Each cell stores the lowest height at which lines of sight of two views have passed over it: nothing there is
higher, whether or not the cell itself was seen.
"""

from __future__ import annotations

from collections.abc import Callable, MutableMapping
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from barsight.core.arrays import Bool, Float32, Float64, Int32, Int64, kernel
from barsight.mapping.observation import CellObservations
from barsight.mapping.spilled_tiles import TileKey

COARSE_CELLS = 2
"""Side of a free-space cell, in cells of the map."""
TILE = 256
OVER_END_M = 0.02
"""Margin added to the height of a line of sight when it lowers a cell's bound."""
REACH_M = 1.5
"""Height above its end up to which a line of sight is traced; free space matters only near what is to be
lifted.
"""
LEVEL_CELLS, LEVEL_M = 5, 0.05
"""Window side (cells) and maximum height difference within it for a line of sight to count: around its
end, the view must see only heights this close. At edges, matching mixes foreground and background.
"""
UNPROVEN = np.float32(np.inf)
_STEPS = 64
"""Number of steps along a ray that are computed at once, as vectors."""


@dataclass(eq=False)
class FreeSpace:
    """Upper bounds (m) of the height of anything in each cell, from the two views with the lowest bounds.

    cell_m: side of the map's cells; free-space cells are COARSE_CELLS times as wide. tiles: (2, TILE, TILE)
    each, the lowest bound and the second lowest; 0.5 MiB per 5 m square at cells of 10 mm.
    """

    cell_m: float
    tiles: MutableMapping[TileKey, Float32] = field(default_factory=dict)

    @property
    def _cell_m(self) -> float:
        return self.cell_m * COARSE_CELLS

    def carve(self, cells: CellObservations, eyes_m: Float64) -> None:
        """Carve with the lines of sight of one view. eyes_m: (E, 3) positions of its cameras, reference
        frame.
        """
        if cells.x.size == 0:
            return
        x, y, z = _level(cells)
        if x.size == 0:
            return
        margin = int(np.ceil(2 * REACH_M / self._cell_m))
        column, row = int(x.min()) - margin, int(y.min()) - margin
        bound = np.full((int(y.max()) - row + margin + 1, int(x.max()) - column + margin + 1), UNPROVEN)
        for eye in eyes_m:
            carve_rays(
                x - column,
                y - row,
                z,
                eye - (column * self._cell_m, row * self._cell_m, 0),
                self._cell_m,
                bound,
            )
        for key in covering_tiles(column, row, bound.shape):
            self._merge(key, column, row, bound)

    def window(self, column: int, row: int, columns: int, rows: int) -> Float32:
        """Return bounds (rows, columns) on the map's own cells, starting at cell (column, row); inf where
        no bound is proven.
        """
        low_x, low_y = column // COARSE_CELLS, row // COARSE_CELLS
        shape = (
            (row + rows - 1) // COARSE_CELLS - low_y + 1,
            (column + columns - 1) // COARSE_CELLS - low_x + 1,
        )
        out = np.full(shape, UNPROVEN)
        for key in covering_tiles(low_x, low_y, shape):
            tile = self.tiles.get(key)
            if tile is not None:
                ours, theirs = tile_overlap(key, low_x, low_y, shape)
                out[theirs] = tile[1][ours]
        at_y = np.arange(row, row + rows) // COARSE_CELLS - low_y
        at_x = np.arange(column, column + columns) // COARSE_CELLS - low_x
        return out[at_y[:, None], at_x]

    def rise(self, rise_m: float) -> None:
        """Move all bounds up."""
        for key in self.tiles:
            self.tiles[key] += np.float32(rise_m)

    def join(
        self, newer: FreeSpace, rise_m: float, forgotten: Callable[[NDArray[Any], NDArray[Any]], Bool]
    ) -> None:
        """Merge the bounds of a newer pass, raised by rise_m. forgotten: marks the places, by x and y (m)
        of a grid, that have changed since, where only the newer pass's bounds remain valid.
        """
        cells = np.arange(TILE) * self._cell_m
        for key in sorted({*self.tiles, *newer.tiles}):
            x, y = (cells + at * TILE * self._cell_m for at in key)
            mine = self.tiles.setdefault(key, np.full((2, TILE, TILE), UNPROVEN))
            mine[:, forgotten(x, y)] = UNPROVEN
            if key in newer.tiles:
                np.minimum(mine, newer.tiles[key] + np.float32(rise_m), out=mine)

    def _merge(self, key: TileKey, column: int, row: int, bound: Float32) -> None:
        ours, theirs = tile_overlap(key, column, row, bound.shape)
        new = bound[theirs]
        if not np.isfinite(new).any():
            return
        tile = self.tiles.setdefault(key, np.full((2, TILE, TILE), UNPROVEN))
        first, second = tile[0][ours], tile[1][ours]
        tile[1][ours] = np.minimum(second, np.maximum(first, new))
        tile[0][ours] = np.minimum(first, new)


def _level(cells: CellObservations) -> tuple[Int32, Int32, Float32]:
    """Choose the level heights of every COARSE_CELLSth cell along x and y: those close to all heights that
    the view sees around them. Returns their free-space cells along x and y (N,), and the heights (N,).
    """
    corner = int(cells.x.min()), int(cells.y.min())
    shape = int(cells.y.max()) - corner[1] + 1, int(cells.x.max()) - corner[0] + 1
    highest, lowest = np.full(shape, -np.inf, np.float32), np.full(shape, np.inf, np.float32)
    bound_heights(cells.x, cells.y, cells.z_m, corner, highest, lowest)
    about = np.ones((LEVEL_CELLS, LEVEL_CELLS), np.uint8)
    highest, lowest = cv2.dilate(highest, about), cv2.erode(lowest, about)
    chosen = _choose_level(cells.x, cells.y, cells.z_m, corner, highest, lowest)
    return cells.x[chosen] // COARSE_CELLS, cells.y[chosen] // COARSE_CELLS, cells.z_m[chosen]


def covering_tiles(column: int, row: int, shape: tuple[int, int]) -> list[TileKey]:
    """List the tiles that cover an array (rows, columns) whose first cell is (column, row)."""
    return [
        (i, j)
        for i in range(column // TILE, (column + shape[1] - 1) // TILE + 1)
        for j in range(row // TILE, (row + shape[0] - 1) // TILE + 1)
    ]


def tile_overlap(
    key: TileKey, column: int, row: int, shape: tuple[int, ...]
) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """Return the cells shared by the tile and an array whose first cell is (column, row), as slices [y, x]
    of each.
    """
    ours, theirs = [], []
    for tile, first, size in ((key[1], row, shape[0]), (key[0], column, shape[1])):
        low, high = max(tile * TILE, first), min((tile + 1) * TILE, first + size)
        ours.append(slice(low - tile * TILE, high - tile * TILE))
        theirs.append(slice(low - first, high - first))
    return (ours[0], ours[1]), (theirs[0], theirs[1])


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
def _choose_level(
    x: Int32, y: Int32, z: Float32, corner: tuple[int, int], highest: Float32, lowest: Float32
) -> Int64:
    """Choose those (M,) of the heights at x, y, z (N,) whose cell is a COARSE_CELLSth one along x and y,
    and that are within LEVEL_M of the highest and the lowest height around them, (H, W) starting at
    `corner`.
    """
    low_x, low_y = np.int32(corner[0]), np.int32(corner[1])
    chosen, n = np.empty(z.size, np.int64), 0
    for k in range(z.size):
        if x[k] % COARSE_CELLS or y[k] % COARSE_CELLS:
            continue
        i, j = np.uint32(y[k] - low_y), np.uint32(x[k] - low_x)
        if max(highest[i, j] - z[k], z[k] - lowest[i, j]) < np.float32(LEVEL_M):
            chosen[n] = k
            n += 1
    return chosen[:n]


@kernel()
def carve_rays(x: Int32, y: Int32, z: Float32, eye: Float64, cell_m: float, bound: Float32) -> None:
    """Lower the bounds (R, C) along the lines of sight from heights z (N,) to the eye (3,).

    x, y: (N,) cells of the heights. A cell's bound is the ray's height where it leaves the cell, plus
    OVER_END_M. The origin of all coordinates is the centre of the bounds' first cell.
    """
    over, column, row = np.empty(_STEPS, np.float32), np.empty(_STEPS, np.int32), np.empty(_STEPS, np.int32)
    for k in range(x.size):
        rise = eye[2] - z[k]
        if rise <= 0:
            continue
        run_x, run_y = (eye[0] - x[k] * cell_m) / rise, (eye[1] - y[k] * cell_m) / rise
        run = np.hypot(run_x, run_y)
        if run < 1e-6:
            continue
        step = cell_m / run
        count, first = int(REACH_M / step), 1
        begin_x, begin_y, begin_z = np.float64(x[k]), np.float64(y[k]), np.float64(z[k])
        while first < count and first * step < rise:
            many = min(_STEPS, count - first)
            for i in range(many):
                height = (first + i) * step
                column[i] = np.int32(np.floor(begin_x + height * run_x / cell_m + 0.5))
                row[i] = np.int32(np.floor(begin_y + height * run_y / cell_m + 0.5))
                over[i] = np.float32(begin_z + height + step + OVER_END_M)
            for i in range(many):
                at_x, at_y = column[i], row[i]
                if at_y < 0 or at_x < 0 or at_y >= bound.shape[0] or at_x >= bound.shape[1]:
                    count = 0
                    break
                if (first + i) * step >= rise:
                    break
                if over[i] < bound[np.uint32(at_y), np.uint32(at_x)]:
                    bound[np.uint32(at_y), np.uint32(at_x)] = over[i]
            first += many
