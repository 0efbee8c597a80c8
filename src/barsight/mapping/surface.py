"""The height surface: views in, finished tiles out, windows of it read back as layers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from barsight.core.arrays import Bool, Float32, Int8, UInt8
from barsight.core.parallel import ordered_map
from barsight.core.types import Source
from barsight.mapping.cloud import CloudPart, read_part
from barsight.mapping.election import Sights, elect, first_heights
from barsight.mapping.filling import bridged
from barsight.mapping.fusion import height_sigma
from barsight.mapping.lengthways import blur_sigma, lengthways, sharpened, valleys
from barsight.mapping.settings import MapSettings
from barsight.mapping.tiles import GREY, TILE_CELLS, VIEWS, TileKey, TileStore, Z

_HALO = 19
"""Cells around a tile that it depends on: 12 along a bar, as far as six cells beside it, one for the bend."""


@dataclass(frozen=True, eq=False)
class Layers:
    """A rectangle of the surface, [y, x] with y rising: z_m, sigma_m (NaN where unknown), views, source.

    intensity: mean grey level of the views that make the height, NaN where no view does.
    """

    z_m: Float32
    sigma_m: Float32
    views: Float32
    source: UInt8
    intensity: Float32

    @classmethod
    def unknown(cls, rows: int, columns: int) -> Layers:
        """A rectangle of which nothing is known."""
        nan = np.full((rows, columns), np.nan, np.float32)
        none = np.zeros((rows, columns), np.float32)
        return cls(nan, nan.copy(), none, none.astype(np.uint8), nan.copy())


def grey_levels(intensity: Float32) -> UInt8:
    """Whole grey levels from 1, 0 where no view saw the cell."""
    return np.where(np.isfinite(intensity), np.rint(intensity).clip(1, 255), 0).astype(np.uint8)


@dataclass(frozen=True)
class Surface:
    """A finished height surface whose tiles lie in `folder`.

    Cell (column, row) has its centre at (column * cell_m, row * cell_m). columns, rows: first and one past
    the last cell that is known. Counts are cells by source.
    """

    folder: Path
    cell_m: float
    columns: tuple[int, int]
    rows: tuple[int, int]
    seen: int
    filled: int
    median_sigma_m: float
    tiles: frozenset[TileKey]

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns) of the rectangle that holds everything known."""
        return self.rows[1] - self.rows[0], self.columns[1] - self.columns[0]

    def window(self, column: int, row: int, columns: int, rows: int) -> Layers:
        """The rectangle from cell (column, row) on; unknown where there is no tile."""
        layers = Layers.unknown(rows, columns)
        for tile_row in range(row // TILE_CELLS, (row + rows - 1) // TILE_CELLS + 1):
            for tile_column in range(column // TILE_CELLS, (column + columns - 1) // TILE_CELLS + 1):
                if (tile_column, tile_row) in self.tiles:
                    tile = _read_tile(self.folder, (tile_column, tile_row))
                    _paste(tile, (tile_column, tile_row), layers, column, row)
        return layers

    def cloud(self) -> Iterator[CloudPart]:
        """Every height that enough views support, sides and lower surfaces included, tile by tile; those
        that are the surface are as it has them."""
        for key in sorted(self.tiles):
            yield read_part(self.folder, key)


def finish(
    store: TileStore, folder: Path, cell_m: float, min_views: int, settings: MapSettings, sights: Sights
) -> Surface:
    """Elect each tile's surface, fill narrow gaps across tile borders, and write the tiles into `folder`."""
    _read_tile.cache_clear()
    _read_first.cache_clear()
    keys = store.keys()
    known = frozenset(keys)

    def tiles() -> Iterator[tuple[TileKey, Float32]]:
        return ((key, store.read(key)) for key in keys)

    def look(item: tuple[TileKey, Float32]) -> None:
        key, tile = item
        np.save(_tile_file(folder, key, "first"), first_heights(tile, min_views, settings.top_share))

    def elect_tile(item: tuple[TileKey, Float32]) -> tuple[TileKey, int]:
        key, tile = item
        around = _first_around(folder, key, known)
        winner = elect(tile, key, around, sights, cell_m, min_views, settings)
        elected = _layers(tile, winner)
        _write_tile(folder, key, elected, "elected")
        CloudPart.of(tile, winner, key, cell_m, min_views).write(folder, key)
        return key, int((elected.source == Source.VISION).sum())

    def finish_tile(key: TileKey) -> tuple[TileKey, Layers]:
        layers, blur = _filled(folder, key, known, cell_m, settings, sights)
        _write_tile(folder, key, layers, "surface")
        read_part(folder, key).finished(layers.z_m, layers.sigma_m, blur).write(folder, key)
        return key, layers

    for _ in ordered_map(look, tiles()):
        pass
    seen = 0
    for key, count in ordered_map(elect_tile, tiles()):
        seen += count
        store.drop(key)
    filled, sigmas = 0, []
    columns, rows = [], []
    for key, layers in ordered_map(finish_tile, keys):
        there = layers.source != Source.UNKNOWN
        filled += int((layers.source == Source.FILLED).sum())
        if there.any():
            sigmas.append(layers.sigma_m[layers.source == Source.VISION][::17])
            columns += [key[0] * TILE_CELLS + int(c) for c in _span(there.any(axis=0))]
            rows += [key[1] * TILE_CELLS + int(r) for r in _span(there.any(axis=1))]
    for key in keys:
        for kind in ("first", "elected"):
            _tile_file(folder, key, kind).unlink()
    all_sigmas = np.concatenate(sigmas) if sigmas else np.empty(0, np.float32)
    return Surface(
        folder=folder,
        cell_m=cell_m,
        columns=(min(columns), max(columns) + 1) if columns else (0, 0),
        rows=(min(rows), max(rows) + 1) if rows else (0, 0),
        seen=seen,
        filled=filled,
        median_sigma_m=float(np.median(all_sigmas)) if all_sigmas.size else float("nan"),
        tiles=frozenset(keys),
    )


def _first_around(folder: Path, key: TileKey, keys: frozenset[TileKey]) -> Float32:
    """The first heights of a tile and its eight neighbours, (3 * TILE_CELLS, 3 * TILE_CELLS)."""
    around = np.full((3 * TILE_CELLS, 3 * TILE_CELLS), np.nan, np.float32)
    for i in range(3):
        for j in range(3):
            neighbour = (key[0] + j - 1, key[1] + i - 1)
            if neighbour in keys:
                rows = slice(i * TILE_CELLS, (i + 1) * TILE_CELLS)
                around[rows, j * TILE_CELLS : (j + 1) * TILE_CELLS] = _read_first(folder, neighbour)
    return around


@lru_cache(maxsize=64)
def _read_first(folder: Path, key: TileKey) -> Float32:
    heights: Float32 = np.load(_tile_file(folder, key, "first"))
    return heights


def _layers(tile: Float32, winner: Int8) -> Layers:
    layers = Layers.unknown(TILE_CELLS, TILE_CELLS)
    row, column = np.nonzero(winner >= 0)
    won = tile[row, column, winner[row, column]]
    layers.z_m[row, column] = won[:, Z]
    layers.sigma_m[row, column] = height_sigma(won)
    layers.views[row, column] = won[:, VIEWS]
    layers.source[row, column] = Source.VISION
    layers.intensity[row, column] = won[:, GREY]
    return layers


def _filled(
    folder: Path, key: TileKey, keys: frozenset[TileKey], cell_m: float, settings: MapSettings, sights: Sights
) -> tuple[Layers, Float32]:
    """The tile averaged lengthways, sharpened, its narrow gaps filled, looking at most the halo around it;
    and what blur and gloss leave on bars, 1 sigma."""
    along, reach = (min(round(way_m / cell_m), _HALO) for way_m in (settings.along_m, settings.fill_m))
    side = TILE_CELLS + 2 * _HALO
    around = Layers.unknown(side, side)
    column, row = key[0] * TILE_CELLS - _HALO, key[1] * TILE_CELLS - _HALO
    for i in (-1, 0, 1):
        for j in (-1, 0, 1):
            neighbour = (key[0] + i, key[1] + j)
            if neighbour in keys:
                _paste(_read_tile(folder, neighbour, "elected"), neighbour, around, column, row)
    blur = np.zeros((side, side), np.float32)
    if along > 0:
        weight = np.nan_to_num(around.sigma_m**-2)
        z, direction = lengthways(around.z_m, weight, settings.least_gate_m, along)
        sharp = sharpened(z, direction, settings.sharpen_px * sights.pixel_m(z) / cell_m)
        blur = blur_sigma(sharp - z, valleys(sharp, direction))
        around = replace(around, z_m=sharp, sigma_m=np.hypot(around.sigma_m, blur))
    if reach > 0:
        fill_gaps(around, reach)
    inner = slice(_HALO, _HALO + TILE_CELLS)
    layers = Layers(*(getattr(around, field.name)[inner, inner] for field in fields(Layers)))
    return layers, blur[inner, inner]


def fill_gaps(layers: Layers, reach: int) -> None:
    """Fill, in place, unknown cells that have seen ones within `reach` on opposite sides, along x or along y.

    The height is interpolated between the two (the nearer pair wins), its sigma is half their difference at
    the least, and its source says FILLED.
    """
    filled = bridged(layers.z_m, layers.sigma_m, layers.source == Source.VISION, reach)
    layers.source[filled] = Source.FILLED


def _span(occupied: Bool) -> tuple[int, int]:
    index = np.flatnonzero(occupied)
    return int(index[0]), int(index[-1])


def _tile_file(folder: Path, key: TileKey, kind: str) -> Path:
    return folder / f"{kind}_{key[0]}_{key[1]}.npy"


def _write_tile(folder: Path, key: TileKey, layers: Layers, kind: str) -> None:
    stacked = np.stack([getattr(layers, field.name).astype(np.float32) for field in fields(Layers)])
    np.save(_tile_file(folder, key, kind), stacked)


@lru_cache(maxsize=48)
def _read_tile(folder: Path, key: TileKey, kind: str = "surface") -> Layers:
    z, sigma, views, source, intensity = np.load(_tile_file(folder, key, kind))
    return Layers(z, sigma, views, source.astype(np.uint8), intensity)


def _paste(tile: Layers, key: TileKey, into: Layers, column: int, row: int) -> None:
    """Copy the part of the tile that overlaps the rectangle whose first cell is (column, row)."""
    rows, columns = into.z_m.shape
    left, top = key[0] * TILE_CELLS - column, key[1] * TILE_CELLS - row
    target = (
        slice(max(top, 0), min(top + TILE_CELLS, rows)),
        slice(max(left, 0), min(left + TILE_CELLS, columns)),
    )
    source = (
        slice(target[0].start - top, target[0].stop - top),
        slice(target[1].start - left, target[1].stop - left),
    )
    for field in fields(Layers):
        getattr(into, field.name)[target] = getattr(tile, field.name)[source]
