"""The height map as one heading sees it: measured heights only, the bars running along the rows' axis."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from barsight.core.arrays import Float32, Float64
from barsight.core.types import Source
from barsight.yard.types import HeightMap


@dataclass(frozen=True, eq=False)
class Sheet:
    """Measured heights [v, u] in a frame turned by heading_rad from the map's, counter-clockwise about Z.

    Cell (row, column) has its centre at u = u0_m + column * cell_m across, v = v0_m + row * cell_m along.
    z_m, sigma_m: float32, NaN where not measured (filled cells are none). Heights up to stock_over_m are
    floor.
    """

    heading_rad: float
    u0_m: float
    v0_m: float
    cell_m: float
    z_m: Float32
    sigma_m: Float32
    stock_over_m: float

    def to_map(self, uv_m: Float64) -> Float64:
        """(N, 2) places u, v to x, y of the map."""
        c, s = np.cos(self.heading_rad), np.sin(self.heading_rad)
        turned: Float64 = uv_m @ np.array([[c, s], [-s, c]])
        return turned


def turn(height_map: HeightMap, heading_rad: float, stock_over_m: float = -np.inf) -> Sheet:
    """The map's measured heights in a frame whose v axis is (-sin heading, cos heading); nearest cells."""
    measured = height_map.source == Source.VISION
    z = np.where(measured, height_map.z_m, np.float32(np.nan)).astype(np.float32)
    sigma = np.where(measured, height_map.sigma_m, np.float32(np.nan)).astype(np.float32)
    cell = height_map.cell_m
    if heading_rad == 0.0:
        return Sheet(0.0, height_map.x0_m, height_map.y0_m, cell, z, sigma, stock_over_m)
    rows, columns = z.shape
    c, s = np.cos(heading_rad), np.sin(heading_rad)
    x = height_map.x0_m + cell * np.array([0, columns - 1, 0, columns - 1])
    y = height_map.y0_m + cell * np.array([0, 0, rows - 1, rows - 1])
    u, v = c * x + s * y, -s * x + c * y
    width, height = (round(float(np.ptp(a)) / cell) + 1 for a in (u, v))
    uu, vv = np.meshgrid(u.min() + cell * np.arange(width), v.min() + cell * np.arange(height))
    column = np.rint((c * uu - s * vv - height_map.x0_m) / cell).astype(np.int32)
    row = np.rint((s * uu + c * vv - height_map.y0_m) / cell).astype(np.int32)
    inside = (column >= 0) & (row >= 0) & (column < columns) & (row < rows)
    column, row = column * inside, row * inside
    nan = np.float32(np.nan)
    return Sheet(
        heading_rad, float(u.min()), float(v.min()), cell,
        np.where(inside, z[row, column], nan), np.where(inside, sigma[row, column], nan), stock_over_m,
    )  # fmt: skip
