"""Store the height surface: finished tiles on disk, and windows of it read back as layers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from functools import lru_cache
from pathlib import Path

import numpy as np

from barsight.core.arrays import Float32, Int8, UInt8, kernel
from barsight.core.records.heights import HeightSource
from barsight.mapping.fusion import height_sigma
from barsight.mapping.spilled_tiles import TileKey
from barsight.mapping.surface.cloud import CloudPart, read_part
from barsight.mapping.surface.hole_filling import bridge_gaps
from barsight.mapping.tiles import FIELDS, GRAY, VIEWS, Z, covering_tiles, tile_overlap


@dataclass(frozen=True, eq=False)
class Layers:
    """A rectangle of the surface, [y, x] with y rising: z_m, sigma_m (NaN where unknown), views, source.

    intensity: mean gray level of the views that contribute to the height, NaN where no view does.
    """

    z_m: Float32
    sigma_m: Float32
    views: Float32
    source: UInt8
    intensity: Float32

    @classmethod
    def unknown(cls, rows: int, columns: int) -> Layers:
        """Create a rectangle in which everything is unknown."""
        nan = np.full((rows, columns), np.nan, np.float32)
        none = np.zeros((rows, columns), np.float32)
        return cls(nan, nan.copy(), none, none.astype(np.uint8), nan.copy())

    def part(self, rows: slice, columns: slice) -> Layers:
        """Copy a rectangle, by cells from start to stop."""
        return Layers(*(getattr(self, field.name)[rows, columns].copy() for field in fields(Layers)))


def gray_levels(intensity: Float32) -> UInt8:
    """Round to gray levels from 1; 0 where no view saw the cell."""
    return np.where(np.isfinite(intensity), np.rint(intensity).clip(1, 255), 0).astype(np.uint8)


@dataclass(frozen=True)
class Surface:
    """A finished height surface whose tiles are stored in `folder`.

    Cell (column, row) has its centre at (column * cell_m, row * cell_m). columns, rows: first known cell and
    one past the last. seen, filled: numbers of cells by source.
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
        """Return (rows, columns) of the rectangle that contains all known cells."""
        return self.rows[1] - self.rows[0], self.columns[1] - self.columns[0]

    def window(self, column: int, row: int, columns: int, rows: int) -> Layers:
        """Read the rectangle that starts at cell (column, row); it is unknown where there is no tile."""
        layers = Layers.unknown(rows, columns)
        for key in covering_tiles(column, row, (rows, columns)):
            if key in self.tiles:
                paste(read_tile(self.folder, key), key, layers, column, row)
        return layers

    def cloud(self) -> Iterator[CloudPart]:
        """Yield every height with enough views, including sides and lower surfaces, tile by tile; those
        that are the surface have its final values. A snapshot has no cloud.
        """
        for key in sorted(self.tiles):
            yield self.cloud_of(key)

    def cloud_of(self, key: TileKey) -> CloudPart:
        """Read the points of one tile."""
        return read_part(self.folder, key)


def elected_layers(tile: Float32, winner: Int8) -> Layers:
    """Extract the heights of a tile that `elect_surface` chose."""
    won = _winners(tile, winner)
    source = np.where(winner >= 0, HeightSource.VISION, HeightSource.UNKNOWN).astype(np.uint8)
    return Layers(won[Z], height_sigma(np.moveaxis(won, 0, -1)), won[VIEWS], source, won[GRAY])


@kernel()
def _winners(tile: Float32, winner: Int8) -> Float32:
    """Gather the fields (FIELDS, rows, columns) of each cell's winner; NaN and no views where there is none.

    tile: (rows, columns, SLOTS, FIELDS). winner: (rows, columns) its slot, -1 where there is none.
    """
    rows, columns = winner.shape
    won = np.full((FIELDS, rows, columns), np.nan, np.float32)
    for i in range(rows):
        for j in range(columns):
            if winner[i, j] < 0:
                won[VIEWS, i, j] = 0
                continue
            for field in range(FIELDS):
                won[field, i, j] = tile[i, j, winner[i, j], field]
    return won


def fill_gaps(layers: Layers, reach: int) -> None:
    """Fill, in place, unknown cells that have seen ones within `reach` on opposite sides, along x or along y.

    The height is interpolated between the two (the nearer pair wins), its sigma is at least half their
    difference, and its source is FILLED.
    """
    filled = bridge_gaps(layers.z_m, layers.sigma_m, layers.source == HeightSource.VISION, reach)
    layers.source[filled] = HeightSource.FILLED


def tile_file(folder: Path, key: TileKey) -> Path:
    """Return the path of a tile's layers."""
    return folder / f"surface_{key[0]}_{key[1]}.npy"


def write_tile(folder: Path, key: TileKey, layers: Layers) -> None:
    """Write a tile's layers as a new file, so that links to an older one keep its content."""
    stacked = np.stack([getattr(layers, field.name) for field in fields(Layers)], dtype=np.float32)
    path = tile_file(folder, key)
    path.unlink(missing_ok=True)
    np.save(path, stacked)


@lru_cache(maxsize=48)
def read_tile(folder: Path, key: TileKey) -> Layers:
    """Read a tile's layers, which must not be modified."""
    z, sigma, views, source, intensity = np.load(tile_file(folder, key))
    return Layers(z, sigma, views, source.astype(np.uint8), intensity)


def paste(tile: Layers, key: TileKey, into: Layers, column: int, row: int) -> None:
    """Copy the part of the tile that overlaps the rectangle whose first cell is (column, row)."""
    ours, theirs = tile_overlap(key, column, row, into.z_m.shape)
    for field in fields(Layers):
        getattr(into, field.name)[theirs] = getattr(tile, field.name)[ours]
