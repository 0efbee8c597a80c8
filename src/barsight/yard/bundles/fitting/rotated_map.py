"""Resample the height map along a heading, measured heights only, so that the bars run along the v axis."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from barsight.core.arrays import Float32, Float64, UInt8, kernel
from barsight.core.records.heights import HeightSource
from barsight.yard.types import HeightMap

_VISION, _LASER = HeightSource.VISION, HeightSource.LASER


@dataclass(frozen=True, eq=False)
class AlignedMap:
    """Measured heights [v, u] in a frame turned by heading_rad from the map's, counter-clockwise about Z.

    Cell (row, column) has its centre at u = u0_m + column * cell_m across, v = v0_m + row * cell_m along.
    z_m, sigma_m: float32, NaN where not measured; filled cells don't count as measured. views: float32, how
    many tell a height; inf where that isn't known: by the laser, and in a map of several passes. Heights up
    to stock_over_m are floor.
    """

    heading_rad: float
    u0_m: float
    v0_m: float
    cell_m: float
    z_m: Float32
    sigma_m: Float32
    views: Float32
    stock_over_m: float

    def to_map(self, uv_m: Float64) -> Float64:
        """Convert positions u, v (N, 2) to x, y of the map."""
        c, s = np.cos(self.heading_rad), np.sin(self.heading_rad)
        turned: Float64 = uv_m @ np.array([[c, s], [-s, c]])
        return turned

    def from_map(self, xy_m: Float64) -> Float64:
        """Convert positions x, y of the map (N, 2) to u, v."""
        c, s = np.cos(self.heading_rad), np.sin(self.heading_rad)
        turned: Float64 = xy_m @ np.array([[c, -s], [s, c]])
        return turned


def align_map(height_map: HeightMap, heading_rad: float, stock_over_m: float = -np.inf) -> AlignedMap:
    """Rotate measured heights by nearest cells into a frame whose v axis is (-sin heading, cos heading)."""
    cell = height_map.cell_m
    is_counted = (height_map.source == _VISION) & (height_map.passes is None)
    views = np.where(is_counted, height_map.views, np.float32(np.inf))
    told = height_map.z_m, height_map.sigma_m, views
    if heading_rad == 0.0:
        measured = HeightSource.measured(height_map.source)
        z, sigma, views = (np.where(measured, one, np.float32(np.nan)) for one in told)
        return AlignedMap(0.0, height_map.x0_m, height_map.y0_m, cell, z, sigma, views, stock_over_m)
    rows, columns = height_map.z_m.shape
    c, s = np.cos(heading_rad), np.sin(heading_rad)
    x = height_map.x0_m + cell * np.array([0, columns - 1, 0, columns - 1])
    y = height_map.y0_m + cell * np.array([0, 0, rows - 1, rows - 1])
    u, v = c * x + s * y, -s * x + c * y
    width, height = (round(float(np.ptp(a)) / cell) + 1 for a in (u, v))
    maps = np.full((3, height, width), np.nan, np.float32)
    # Convert cell (row, column) of the grid to that of the map, relative to the first cell of each.
    first_x, first_y = c * u.min() - s * v.min(), s * u.min() + c * v.min()
    first = np.array([(first_x - height_map.x0_m) / cell, (first_y - height_map.y0_m) / cell])
    _turned(told, height_map.source, first, (float(c), float(s)), maps)
    return AlignedMap(
        heading_rad, float(u.min()), float(v.min()), cell, maps[0], maps[1], maps[2], stock_over_m
    )


@kernel()
def _turned(
    told: tuple[Float32, Float32, Float32],
    source: UInt8,
    first: Float64,
    turn: tuple[float, float],
    maps: Float32,
) -> None:
    """Fill in the measured cells one by one: whole arrays of positions would take ten times the map's memory.

    told: maps (rows, columns) of heights, sigmas and views; source: (rows, columns). first: (2,) column and
    row, in their cells, of the first cell to be filled. turn: cosine and sine. Fills maps (3, V, U).
    """
    (z, sigma, views), (cosine, sine) = told, turn
    for i in range(maps.shape[1]):
        for j in range(maps.shape[2]):
            column = int(np.rint(first[0] + cosine * j - sine * i))
            row = int(np.rint(first[1] + sine * j + cosine * i))
            inside = 0 <= row < z.shape[0] and 0 <= column < z.shape[1]
            if inside and (source[row, column] == _VISION or source[row, column] == _LASER):
                maps[0, i, j], maps[1, i, j] = z[row, column], sigma[row, column]
                maps[2, i, j] = views[row, column]
