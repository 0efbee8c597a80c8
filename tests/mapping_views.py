"""Views of a map made by hand, and the surface that comes of them."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from barsight.mapping.fusion import fuse
from barsight.mapping.observation import CellObservations
from barsight.mapping.settings import MapSettings
from barsight.mapping.surface import Surface, finish
from barsight.mapping.tiles import TileStore


def view(
    x: np.ndarray, y: np.ndarray, z: np.ndarray, sigma_m: float = 0.01, shared_m: float = 0.0
) -> CellObservations:
    """One height in each cell (x, y), all equally sure."""
    x, y, z = (np.ravel(a) for a in np.broadcast_arrays(x, y, z))
    same = np.ones(x.size, np.float32)
    return CellObservations(
        x.astype(np.int32),
        y.astype(np.int32),
        z.astype(np.float32),
        same * np.float32(sigma_m**2),
        same * np.float32(shared_m),
        same * 100,
    )


def fused(
    views: Iterable[CellObservations],
    folder: Path,
    settings: MapSettings | None = None,
    *,
    cell_m: float = 0.01,
    resident: int = 64,
) -> Surface:
    """The finished surface of some views."""
    settings = settings or MapSettings(min_views=1)
    folder.mkdir(parents=True, exist_ok=True)
    store = TileStore(folder, resident)
    for one in views:
        fuse(store, one, settings)
    return finish(store, folder, cell_m, settings.min_views, settings)


def block(columns: int, rows: int, column: int = 0, row: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """x and y (rows, columns) of a rectangle of cells."""
    x, y = np.meshgrid(np.arange(column, column + columns), np.arange(row, row + rows))
    return x, y
