"""Store the heights of a map in square tiles."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from barsight.core.arrays import Float32, Float64
from barsight.mapping.spilled_tiles import SpilledTiles, TileKey

TILE_CELLS = 256
"""Side of a tile, in cells."""
SLOTS = 4
"""Maximum number of heights stored per cell."""
FIELDS = 7
"""Number of values stored per height: mean z, weight (sum of 1 / variance), weighted squares about the
mean, views, shared sigma, gray level, views that see it in the cell's middle.
"""
Z, WEIGHT, SQUARES, VIEWS, SHARED, GRAY, CENTRAL = range(FIELDS)


class TileStore:
    """Tiles by (column, row) number: (TILE_CELLS, TILE_CELLS, SLOTS, fields) float32, [y, x].

    At most `resident` tiles stay in memory; the others are stored in `scratch`. A new tile is filled with
    `fill`.
    """

    def __init__(self, scratch: Path, resident: int, fields: int = FIELDS, fill: float = 0.0) -> None:
        self._tiles = SpilledTiles(scratch, resident)
        self._shape, self._fill = (TILE_CELLS, TILE_CELLS, SLOTS, fields), fill
        self._versions: dict[TileKey, int] = {}

    def keys(self) -> list[TileKey]:
        """Return all tiles that hold anything, in a fixed order."""
        return list(self._tiles)

    def take(self, key: TileKey) -> Float32:
        """Fetch the tile for reading and writing; create it if it doesn't exist yet."""
        if key in self._tiles:
            tile = self._tiles[key]
        else:
            tile = np.zeros(self._shape, np.float32)
            if self._fill:
                tile.fill(self._fill)
            self._tiles[key] = tile
        self._versions[key] = self._versions.get(key, 0) + 1
        return tile

    def hold(self, max_tiles: int) -> None:
        """Write the least recently used tiles to disk until at most max_tiles are in memory."""
        self._tiles.hold(max_tiles)

    def read(self, key: TileKey) -> Float32:
        """Read an existing tile for reading only; a tile that was on disk isn't kept in memory."""
        return self._tiles.peek(key)

    def version(self, key: TileKey) -> int:
        """Return the number of times a tile was taken; 0 if it doesn't exist."""
        return self._versions.get(key, 0)

    def clear(self) -> None:
        """Delete all tiles."""
        self._tiles.clear()
        self._versions.clear()


def tiles_around(key: TileKey) -> list[TileKey]:
    """Return a tile and its eight neighbours, itself in the middle."""
    return [(key[0] + i, key[1] + j) for i in (-1, 0, 1) for j in (-1, 0, 1)]


def covering_tiles(column: int, row: int, shape: tuple[int, int]) -> list[TileKey]:
    """List the tiles that cover an array (rows, columns) whose first cell is (column, row)."""
    return [
        (i, j)
        for i in range(column // TILE_CELLS, (column + shape[1] - 1) // TILE_CELLS + 1)
        for j in range(row // TILE_CELLS, (row + shape[0] - 1) // TILE_CELLS + 1)
    ]


def tile_overlap(
    key: TileKey, column: int, row: int, shape: tuple[int, ...]
) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """Return the cells shared by the tile and an array whose first cell is (column, row), as slices [y, x]
    of each.
    """
    ours, theirs = [], []
    for tile, first, size in ((key[1], row, shape[0]), (key[0], column, shape[1])):
        low, high = max(tile * TILE_CELLS, first), min((tile + 1) * TILE_CELLS, first + size)
        ours.append(slice(low - tile * TILE_CELLS, high - tile * TILE_CELLS))
        theirs.append(slice(low - first, high - first))
    return (ours[0], ours[1]), (theirs[0], theirs[1])


def tile_places(key: TileKey, cell_m: float) -> tuple[Float64, Float64]:
    """Compute x and y (TILE_CELLS,) of the centres of a tile's columns and rows, m."""
    x_m, y_m = (cell_m * (TILE_CELLS * at + np.arange(TILE_CELLS, dtype=np.float64)) for at in key)
    return x_m, y_m
