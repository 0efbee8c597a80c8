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
    z_m, sigma_m: float32, NaN where not measured; filled cells don't count as measured. Heights up to
    stock_over_m are floor.
    """

    heading_rad: float
    u0_m: float
    v0_m: float
    cell_m: float
    z_m: Float32
    sigma_m: Float32
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
    if heading_rad == 0.0:
        measured = HeightSource.measured(height_map.source)
        z = np.where(measured, height_map.z_m, np.float32(np.nan))
        sigma = np.where(measured, height_map.sigma_m, np.float32(np.nan))
        return AlignedMap(0.0, height_map.x0_m, height_map.y0_m, cell, z, sigma, stock_over_m)
    rows, columns = height_map.z_m.shape
    c, s = np.cos(heading_rad), np.sin(heading_rad)
    x = height_map.x0_m + cell * np.array([0, columns - 1, 0, columns - 1])
    y = height_map.y0_m + cell * np.array([0, 0, rows - 1, rows - 1])
    u, v = c * x + s * y, -s * x + c * y
    width, height = (round(float(np.ptp(a)) / cell) + 1 for a in (u, v))
    z, sigma = np.full((2, height, width), np.nan, np.float32)
    # Convert cell (row, column) of the grid to that of the map, relative to the first cell of each.
    first_x, first_y = c * u.min() - s * v.min(), s * u.min() + c * v.min()
    first = np.array([(first_x - height_map.x0_m) / cell, (first_y - height_map.y0_m) / cell])
    _turned(height_map.z_m, height_map.sigma_m, height_map.source, first, float(c), float(s), z, sigma)
    return AlignedMap(heading_rad, float(u.min()), float(v.min()), cell, z, sigma, stock_over_m)


@kernel()
def _turned(
    z: Float32,
    sigma: Float32,
    source: UInt8,
    first: Float64,
    cosine: float,
    sine: float,
    z_turned: Float32,
    sigma_turned: Float32,
) -> None:
    """Fill in the measured cells one by one: whole arrays of positions would take ten times the map's memory.

    z, sigma, source: maps (rows, columns). first: (2,) column and row, in their cells, of the first cell to
    be filled. Fills z_turned and sigma_turned (V, U), m.
    """
    for i in range(z_turned.shape[0]):
        for j in range(z_turned.shape[1]):
            column = int(np.rint(first[0] + cosine * j - sine * i))
            row = int(np.rint(first[1] + sine * j + cosine * i))
            inside = 0 <= row < z.shape[0] and 0 <= column < z.shape[1]
            if inside and (source[row, column] == _VISION or source[row, column] == _LASER):
                z_turned[i, j], sigma_turned[i, j] = z[row, column], sigma[row, column]
