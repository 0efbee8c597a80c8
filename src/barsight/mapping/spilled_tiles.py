"""Hold tiles of what is known of free space and tops: a few in memory, the others on disk."""

from __future__ import annotations

import tempfile
from collections import OrderedDict
from collections.abc import Iterator, MutableMapping
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from barsight.mapping.tiles import TileKey

Tile = NDArray[Any]


class SpilledTiles(MutableMapping[TileKey, Tile]):
    """Tiles of a map, an array each. At most `resident` are held; the one unused for longest goes to a file
    in a folder of its own in `folder` and comes back when it is needed, so that memory doesn't grow with the
    yard.

    A tile may be changed until another one is taken. Several threads may read.
    """

    def __init__(self, folder: Path, resident: int = 16) -> None:
        self._folder, self._resident = Path(tempfile.mkdtemp(prefix="tiles_", dir=folder)), resident
        self._held: OrderedDict[TileKey, Tile] = OrderedDict()
        self._known: set[TileKey] = set()
        self._lock = Lock()

    def __getitem__(self, key: TileKey) -> Tile:
        """Return a tile, from its file where it isn't held."""
        with self._lock:
            tile = self._held.pop(key, None)
            if tile is None:
                if key not in self._known:
                    raise KeyError(key)
                tile = np.load(self._file(key))
            self._hold(key, tile)
            return tile

    def __setitem__(self, key: TileKey, tile: Tile) -> None:
        """Take a tile in."""
        with self._lock:
            self._held.pop(key, None)
            self._known.add(key)
            self._hold(key, tile)

    def __delitem__(self, key: TileKey) -> None:
        """Forget a tile."""
        with self._lock:
            self._known.remove(key)
            self._held.pop(key, None)
            self._file(key).unlink(missing_ok=True)

    def __iter__(self) -> Iterator[TileKey]:
        """Iterate over the keys in a fixed order."""
        return iter(sorted(self._known))

    def __len__(self) -> int:
        """Count the tiles."""
        return len(self._known)

    def __contains__(self, key: object) -> bool:
        """Check for a tile without taking it."""
        return key in self._known

    def _hold(self, key: TileKey, tile: Tile) -> None:
        self._held[key] = tile
        while len(self._held) > self._resident:
            oldest, evicted = self._held.popitem(last=False)
            np.save(self._file(oldest), evicted)

    def _file(self, key: TileKey) -> Path:
        return self._folder / f"{key[0]}_{key[1]}.npy"
