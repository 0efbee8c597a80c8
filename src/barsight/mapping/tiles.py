"""Store square tiles of the map: a few in memory, the others on disk."""

from __future__ import annotations

from collections import OrderedDict
from pathlib import Path

import numpy as np

from barsight.core.arrays import Float32

TILE_CELLS = 256
SLOTS = 4
"""Heights kept per cell."""
FIELDS = 7
"""Of each height: mean z, weight (sum of 1 / variance), weighted squares about the mean, views, shared sigma,
gray level, views that see it in the cell's middle."""
Z, WEIGHT, SQUARES, VIEWS, SHARED, GRAY, CENTRAL = range(FIELDS)

TileKey = tuple[int, int]


class TileStore:
    """Tiles by (column, row) number: (TILE_CELLS, TILE_CELLS, SLOTS, fields) float32, [y, x].

    At most `resident` tiles are held; the one untouched for longest goes to a file in `scratch` and comes
    back when it is needed, so memory doesn't grow with the yard. A fresh tile holds `fill`.
    """

    def __init__(self, scratch: Path, resident: int, fields: int = FIELDS, fill: float = 0.0) -> None:
        self._scratch = scratch
        self._resident = resident
        self._shape, self._fill = (TILE_CELLS, TILE_CELLS, SLOTS, fields), fill
        self._held: OrderedDict[TileKey, Float32] = OrderedDict()
        self._versions: dict[TileKey, int] = {}

    def keys(self) -> list[TileKey]:
        """Return all tiles that hold anything, in a fixed order."""
        return sorted(self._versions)

    def take(self, key: TileKey) -> Float32:
        """Fetch the tile to read and write; a fresh one where there is none yet."""
        tile = self._held.pop(key, None)
        if tile is None:
            self.hold(self._resident - 1)
            if key in self._versions:
                tile = np.load(self._file(key))
            else:
                tile = np.zeros(self._shape, np.float32)
                if self._fill:
                    tile.fill(self._fill)
        self._held[key] = tile
        self._versions[key] = self._versions.get(key, 0) + 1
        return tile

    def hold(self, max_tiles: int) -> None:
        """Write those that are untouched for longest to disk until so many are held."""
        while len(self._held) > max_tiles:
            oldest, evicted = self._held.popitem(last=False)
            np.save(self._file(oldest), evicted)

    def read(self, key: TileKey) -> Float32:
        """Read a tile that holds something, not to be written to: it isn't kept if it lay on disk."""
        tile = self._held.get(key)
        return np.load(self._file(key)) if tile is None else tile

    def version(self, key: TileKey) -> int:
        """Count how often a tile was taken; 0 where there is none."""
        return self._versions.get(key, 0)

    def clear(self) -> None:
        """Forget all tiles."""
        for key in self._versions:
            self._file(key).unlink(missing_ok=True)
        self._held.clear()
        self._versions.clear()

    def _file(self, key: TileKey) -> Path:
        return self._scratch / f"slots_{key[0]}_{key[1]}.npy"
