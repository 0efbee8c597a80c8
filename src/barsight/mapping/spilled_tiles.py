"""Store the tiles of a map: a few in memory, the others on disk."""

from __future__ import annotations

import tempfile
from collections import OrderedDict
from collections.abc import Iterator, MutableMapping
from pathlib import Path
from threading import Lock
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

Tile = NDArray[Any]
TileKey = tuple[int, int]
"""Column and row number."""


class SpilledTiles(MutableMapping[TileKey, Tile]):
    """Tiles of a map, one array each. At most `resident` stay in memory; the least recently used one is
    written to a file in its own folder inside `folder` and read back when needed, so that memory doesn't grow
    with the yard.

    A tile may be modified until another one is fetched. Several threads may read.
    """

    def __init__(self, folder: Path, resident: int = 16) -> None:
        self._folder, self._resident = Path(tempfile.mkdtemp(prefix="tiles_", dir=folder)), resident
        self._held: OrderedDict[TileKey, Tile] = OrderedDict()
        self._known: set[TileKey] = set()
        self._lock = Lock()

    def __getitem__(self, key: TileKey) -> Tile:
        """Return a tile, reading its file if it isn't in memory."""
        with self._lock:
            if key not in self._known:
                raise KeyError(key)
            tile = self._held.pop(key, None)
            if tile is None:
                self._write_oldest(self._resident - 1)
                tile = self._load(key)
            self._held[key] = tile
            return tile

    def __setitem__(self, key: TileKey, tile: Tile) -> None:
        """Add or replace a tile."""
        with self._lock:
            self._held.pop(key, None)
            self._write_oldest(self._resident - 1)
            self._known.add(key)
            self._held[key] = tile

    def peek(self, key: TileKey) -> Tile:
        """Return a known tile for reading only; a tile that was on disk isn't kept in memory."""
        with self._lock:
            tile = self._held.get(key)
            return self._load(key) if tile is None else tile

    def hold(self, max_tiles: int) -> None:
        """Write the least recently used tiles to disk until at most max_tiles are in memory."""
        with self._lock:
            self._write_oldest(max_tiles)

    def __delitem__(self, key: TileKey) -> None:
        """Delete a tile."""
        with self._lock:
            self._known.remove(key)
            self._held.pop(key, None)
            self._file(key).unlink(missing_ok=True)

    def clear(self) -> None:
        """Delete all tiles."""
        with self._lock:
            for key in self._known:
                self._file(key).unlink(missing_ok=True)
            self._known.clear()
            self._held.clear()

    def __iter__(self) -> Iterator[TileKey]:
        """Iterate over the keys in a fixed order."""
        return iter(sorted(self._known))

    def __len__(self) -> int:
        """Count the tiles."""
        return len(self._known)

    def __contains__(self, key: object) -> bool:
        """Check for a tile without fetching it."""
        return key in self._known

    def _write_oldest(self, max_tiles: int) -> None:
        while len(self._held) > max_tiles:
            oldest, evicted = self._held.popitem(last=False)
            np.save(self._file(oldest), evicted)

    def _load(self, key: TileKey) -> Tile:
        return cast(Tile, np.load(self._file(key)))

    def _file(self, key: TileKey) -> Path:
        return self._folder / f"{key[0]}_{key[1]}.npy"
