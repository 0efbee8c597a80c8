"""Store the heights that tiles elect by votes alone (their first heights), and assemble them around a
tile.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np

from barsight.core.arrays import Float32
from barsight.mapping.spilled_tiles import TileKey
from barsight.mapping.tiles import TILE_CELLS, tiles_around


def first_around(folder: Path, key: TileKey, keys: frozenset[TileKey]) -> Float32:
    """Assemble the first heights of a tile and its eight neighbours, (3 * TILE_CELLS, 3 * TILE_CELLS)."""
    around = np.full((3 * TILE_CELLS, 3 * TILE_CELLS), np.nan, np.float32)
    for neighbour in tiles_around(key):
        if neighbour in keys:
            row, column = ((neighbour[i] - key[i] + 1) * TILE_CELLS for i in (1, 0))
            around[row : row + TILE_CELLS, column : column + TILE_CELLS] = read_first(folder, neighbour)
    return around


@lru_cache(maxsize=64)
def read_first(folder: Path, key: TileKey) -> Float32:
    """Read a tile's first heights, (TILE_CELLS, TILE_CELLS); those of a few tiles are cached."""
    heights: Float32 = np.load(first_file(folder, key))
    return heights


def first_file(folder: Path, key: TileKey) -> Path:
    """Return the path of a tile's first heights."""
    return folder / f"first_{key[0]}_{key[1]}.npy"
