"""Fuse laser profiles into the map of vision."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from barsight.core.arrays import Bool, Float64, Int64
from barsight.core.records.heights import HeightSource
from barsight.core.records.sensor_samples import LaserProfile
from barsight.mapping.agreement import JUMP_M
from barsight.mapping.settings import MapSettings
from barsight.mapping.spilled_tiles import TileKey
from barsight.mapping.surface.cloud import cloud_file
from barsight.mapping.surface.surface import Layers, Surface, read_tile, tile_file, write_tile
from barsight.mapping.surface.tile_figures import gather_surface, tile_figures
from barsight.mapping.tiles import TILE_CELLS

CARRIED_M = 0.12
"""Distance along Y over which the correlation of vision's error falls to 1/e: heights are averaged that
far along a bar.
"""
_REACH = 2
"""Number of cells along x within which an edge of the map may explain a laser's height."""


@dataclass(frozen=True, eq=False)
class _Points:
    """Laser heights at cells' centres: column, row (M,) of the map's cells, z_m, sigma_m (M,)."""

    column: Int64
    row: Int64
    z_m: Float64
    sigma_m: Float64


def fuse_laser(
    surface: Surface, laser: Sequence[LaserProfile], settings: MapSettings, folder: Path
) -> Surface:
    """Fuse accepted profiles into a new surface in `folder`, which must be empty; tiles that no profile meets
    are shared with the old surface. The cloud stays vision's.

    In the rows next to a profile: where both agree, the cell takes the mean weighted by their sigmas; where
    the map has the laser's height within two cells (an edge), it takes the laser's height. Elsewhere the
    higher one counts, with a sigma of at least half their difference. Cells that vision left unknown or
    filled take the laser's height. Further along Y, on the same surface, vision's error is taken to be
    correlated by exp(-distance / CARRIED_M): where it is within min_gate_m, that share of it is subtracted,
    and the source remains vision.
    """
    points = [_at_cells(profile, surface.cell_m, settings) for profile in laser]
    carry = round(3 * CARRIED_M / surface.cell_m)
    touched = {key for one in points for key in _tiles_of(one, carry)}
    figures = {}
    for key in surface.tiles:
        os.link(cloud_file(surface.folder, key), cloud_file(folder, key))
        layers = read_tile(surface.folder, key)
        if key in touched:
            layers = _fused_tile(surface, key, points, carry, settings)
            write_tile(folder, key, layers)
        else:
            os.link(tile_file(surface.folder, key), tile_file(folder, key))
        figures[key] = tile_figures(key, layers)
    return gather_surface(folder, surface.cell_m, figures)


def _tiles_of(points: _Points, carry: int) -> set[TileKey]:
    rows = np.concatenate([points.row - carry, points.row, points.row + carry])
    keys = np.unique(np.stack([np.tile(points.column, 3), rows], axis=1) // TILE_CELLS, axis=0)
    return {(int(column), int(row)) for column, row in keys}


def _at_cells(laser: LaserProfile, cell_m: float, settings: MapSettings) -> _Points:
    """Interpolate a profile's points at the centres of the cells in the rows next to it.

    Along x, heights are interpolated between points up to two cells apart; at a step, the nearest point
    counts if it is within a quarter of a cell.
    """
    sigma = max(settings.laser_sigma_m, np.nan_to_num(laser.range_std_m))
    first, last = np.ceil(laser.x_m[0] / cell_m - 0.25), np.floor(laser.x_m[-1] / cell_m + 0.25)
    column = np.arange(first, last + 1).astype(np.int64)
    x = column * cell_m
    after = np.clip(np.searchsorted(laser.x_m, x), 1, laser.x_m.size - 1)
    before = after - 1
    gap = laser.x_m[after] - laser.x_m[before]
    share = np.clip((x - laser.x_m[before]) / np.maximum(gap, 1e-9), 0, 1)
    step = laser.z_m[after] - laser.z_m[before]
    nearest = np.where(share > 0.5, after, before)
    near = np.abs(laser.x_m[nearest] - x) <= 0.25 * cell_m
    even = (gap <= 2 * cell_m) & (np.abs(step) <= JUMP_M)
    z = np.where(even, laser.z_m[before] + share * step, laser.z_m[nearest])
    y = np.where(even, (1 - share) * laser.y_m[before] + share * laser.y_m[after], laser.y_m[nearest])
    kept = even | near
    rows = [np.floor(y / cell_m + 1e-6), np.ceil(y / cell_m - 1e-6)]
    parts = [(column[kept], row[kept].astype(np.int64), z[kept]) for row in rows]
    columns, lines, heights = (np.concatenate(part) for part in zip(*parts, strict=True))
    _, once = np.unique(np.stack([columns, lines]), axis=1, return_index=True)
    return _Points(columns[once], lines[once], heights[once], np.full(once.size, sigma))


def _fused_tile(
    surface: Surface, key: TileKey, points: Sequence[_Points], carry: int, settings: MapSettings
) -> Layers:
    """Fuse all profiles' points into a tile, including those up to `carry` rows around it."""
    first, row = key[0] * TILE_CELLS - _REACH, key[1] * TILE_CELLS - carry
    rows, columns = TILE_CELLS + 2 * carry, TILE_CELLS + 2 * _REACH
    around = surface.window(first, row, columns, rows)
    share, shift, gain = np.zeros((3, rows, columns))
    fused = around.part(slice(None), slice(None))
    for one in points:
        i, j = one.row - row, one.column - first
        here = (i >= 0) & (i < rows) & (j >= _REACH) & (j < columns - _REACH)
        i, j, z, sigma = i[here], j[here], one.z_m[here], one.sigma_m[here]
        agrees = _fuse_points(around, fused, i, j, z, sigma, settings)
        agrees &= np.abs(z - np.nan_to_num(around.z_m[i, j])) <= settings.min_gate_m
        i, j, z, sigma = i[agrees], j[agrees], z[agrees], sigma[agrees]
        own = around.sigma_m[i, j].astype(np.float64) ** 2
        carried = (z - around.z_m[i, j], own / (own + sigma**2))
        for way in (-1, 1):
            _carry(
                around, i, j, carried, way, carry, surface.cell_m, settings.min_gate_m, (share, shift, gain)
            )
    beside = (share > 0) & (fused.source == HeightSource.VISION)
    fused.z_m[beside] += (share * gain * shift)[beside].astype(np.float32)
    fused.sigma_m[beside] *= np.sqrt(1 - share**2 * gain)[beside].astype(np.float32)
    return fused.part(slice(carry, carry + TILE_CELLS), slice(_REACH, _REACH + TILE_CELLS))


def _fuse_points(
    around: Layers, fused: Layers, i: Int64, j: Int64, z: Float64, sigma: Float64, settings: MapSettings
) -> Bool:
    """Fuse points (M,) into the cells at rows i, columns j of `fused`, in place; return which agree with
    vision.
    """
    own_z, own_sigma = around.z_m[i, j].astype(np.float64), around.sigma_m[i, j].astype(np.float64)
    seen = around.source[i, j] == HeightSource.VISION
    beside = np.stack([around.z_m[i, j + way] for way in range(-_REACH, _REACH + 1)])
    gate = np.maximum(settings.gate_sigma * np.hypot(own_sigma, sigma), settings.min_gate_m)
    with np.errstate(invalid="ignore"):
        agrees: Bool = seen & (np.abs(z - own_z) <= gate)
        edge = (z >= np.fmin.reduce(beside) - gate) & (z <= np.fmax.reduce(beside) + gate)
    apart = np.where(seen & ~agrees & ~edge, np.abs(z - own_z) / 2, 0.0)
    lower = seen & ~agrees & ~edge & (z < own_z)
    weight = np.where(agrees, 1 / own_sigma**2, 0.0)
    total = weight + 1 / sigma**2
    mean = (np.where(agrees, own_z, 0) * weight + z / sigma**2) / total
    fused.z_m[i, j] = np.where(lower, own_z, mean)
    fused.sigma_m[i, j] = np.hypot(np.where(lower, own_sigma, 1 / np.sqrt(total)), apart)
    fused.source[i, j] = np.where(lower, HeightSource.VISION, HeightSource.LASER)
    return agrees


def _carry(
    around: Layers, i: Int64, j: Int64, carried: tuple[Float64, Float64], way: int, reach: int, cell_m: float,
    gate_m: float, into: tuple[Float64, Float64, Float64],
) -> None:  # fmt: skip
    """Carry vision's error at cells (M,) along Y, up to `reach` rows in direction `way`, until vision has no
    measurement or a step of more than gate_m.

    carried: laser minus vision (m), and vision's share of both variances (M,). into: per cell the correlation
    of the error, laser minus vision, and vision's share, overwritten where this point is nearer.
    """
    shift, gain = carried
    for step in range(1, reach + 1):
        at = i + way * step
        inside = (at >= 0) & (at < around.z_m.shape[0])
        i, j, at, shift, gain = (part[inside] for part in (i, j, at, shift, gain))
        with np.errstate(invalid="ignore"):
            same = np.abs(around.z_m[at, j] - around.z_m[at - way, j]) <= gate_m
        same &= around.source[at, j] == HeightSource.VISION
        i, j, at, shift, gain = (part[same] for part in (i, j, at, shift, gain))
        share = float(np.exp(-step * cell_m / CARRIED_M))
        nearer = share > into[0][at, j]
        for target, values in zip(into, (np.full(at.size, share), shift, gain), strict=True):
            target[at[nearer], j[nearer]] = values[nearer]
