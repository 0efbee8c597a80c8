"""Count the known cells of finished tiles, and describe the surface that the tiles form."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from barsight.core.arrays import Bool, Float32
from barsight.core.records.heights import HeightSource
from barsight.mapping.spilled_tiles import TileKey
from barsight.mapping.surface.surface import Layers, Surface
from barsight.mapping.tiles import TILE_CELLS


@dataclass(frozen=True, eq=False)
class TileFigures:
    """Figures of a finished tile. columns, rows: first and last known cell, in the map's numbers; None
    without any.
    """

    seen: int
    filled: int
    sigmas_m: Float32
    columns: tuple[int, int] | None
    rows: tuple[int, int] | None


def gather_surface(folder: Path, cell_m: float, tiles: dict[TileKey, TileFigures]) -> Surface:
    """Describe the surface whose finished tiles are stored in `folder`."""
    figures = list(tiles.values())
    columns = [column for one in figures if one.columns for column in one.columns]
    rows = [row for one in figures if one.rows for row in one.rows]
    sigmas = np.concatenate([one.sigmas_m for one in figures]) if figures else np.empty(0)
    return Surface(
        folder=folder,
        cell_m=cell_m,
        columns=(min(columns), max(columns) + 1) if columns else (0, 0),
        rows=(min(rows), max(rows) + 1) if rows else (0, 0),
        seen=sum(one.seen for one in figures),
        filled=sum(one.filled for one in figures),
        median_sigma_m=float(np.median(sigmas)) if sigmas.size else float("nan"),
        tiles=frozenset(tiles),
    )


def tile_figures(key: TileKey, layers: Layers) -> TileFigures:
    """Count the seen and filled cells of a finished tile."""
    there = layers.source != HeightSource.UNKNOWN
    measured = HeightSource.measured(layers.source)
    seen, filled = measured.sum(), (layers.source == HeightSource.FILLED).sum()
    sigmas = layers.sigma_m[measured][::17] if there.any() else np.empty(0, np.float32)
    spans = [_span(there.any(axis=axis), key[axis] * TILE_CELLS) for axis in (0, 1)]
    return TileFigures(int(seen), int(filled), sigmas, *spans)


def _span(occupied: Bool, first: int) -> tuple[int, int] | None:
    index = np.flatnonzero(occupied)
    return (first + int(index[0]), first + int(index[-1])) if index.size else None
