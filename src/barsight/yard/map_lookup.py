"""Look up the map's cells at given places in the yard, and along lines of sight."""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np

from barsight.core.arrays import Bool, Float32, Float64, Int64, UInt8, kernel
from barsight.core.records.heights import HeightSource
from barsight.yard.types import HeightMap

SATURATED_LEVEL = 245.0
"""Gray level from which steel is saturated, so that neither white paper nor a bar shows on it."""
_UNKNOWN, _FILLED = HeightSource.UNKNOWN, HeightSource.FILLED


class CellGrid(NamedTuple):
    """Heights (rows, columns) of cells, NaN where unknown, the place of the first cell, and the highest of
    all heights, -inf where none is known.
    """

    x0_m: float
    y0_m: float
    cell_m: float
    z_m: Float32
    highest_m: float

    @classmethod
    def of(cls, heights: HeightMap) -> CellGrid:
        """Take a map's cells."""
        z = np.ascontiguousarray(heights.z_m, np.float32)
        highest = float(np.fmax.reduce(z, axis=None, initial=-np.inf))
        return cls(heights.x0_m, heights.y0_m, heights.cell_m, z, highest)


def nearest_cells(heights: HeightMap, x: Float64, y: Float64) -> tuple[Int64, Int64, Bool]:
    """Find columns and rows of the nearest cells, and whether they lie in the map; (0, 0) if not."""
    column = np.floor((x - heights.x0_m) / heights.cell_m + 0.5).astype(np.int64)
    row = np.floor((y - heights.y0_m) / heights.cell_m + 0.5).astype(np.int64)
    rows, columns = heights.z_m.shape
    inside = (row >= 0) & (column >= 0) & (row < rows) & (column < columns)
    return np.where(inside, column, 0), np.where(inside, row, 0), inside


def sample_levels(heights: HeightMap, levels: UInt8, x: Float64, y: Float64) -> Float32:
    """Interpolate gray levels (V, U) between the four cells around places x and y, m; NaN where one of these
    wasn't seen. levels: (rows, columns) of the map, 0 where unseen.
    """
    column, row = (
        np.asarray((at - first) / heights.cell_m, np.float32)
        for at, first in ((x, heights.x0_m), (y, heights.y0_m))
    )
    top, left = (max(math.floor(float(at.min())), 0) for at in (row, column))
    end, right = (max(math.ceil(float(at.max())) + 1, 0) for at in (row, column))
    part = levels[top:end, left:right]
    if part.size == 0:
        return np.full(column.shape, np.nan, np.float32)
    seen = np.where(part > 0, part, np.nan).astype(np.float32)
    return np.asarray(
        cv2.remap(seen, column - left, row - top, cv2.INTER_LINEAR, borderValue=np.nan), np.float32
    )


def lookup_heights(heights: HeightMap, x: Float64, y: Float64) -> Float64:
    """Look up the heights of the nearest cells; NaN where they weren't seen."""
    x, y = np.broadcast_arrays(x, y)
    z = _lookup(
        heights.z_m, heights.source, heights.x0_m, heights.y0_m, heights.cell_m,
        np.ravel(x).astype(np.float64), np.ravel(y).astype(np.float64),
    )  # fmt: skip
    return z.reshape(x.shape)


@kernel()
def _lookup(z: Float32, source: UInt8, x0: float, y0: float, cell: float, x: Float64, y: Float64) -> Float64:
    """Look up the heights (N,) of the cells nearest to places x and y (N,), m; NaN where unseen."""
    found = np.full(x.size, np.nan)
    for k in range(x.size):
        column = int(np.floor((x[k] - x0) / cell + 0.5))
        row = int(np.floor((y[k] - y0) / cell + 0.5))
        if row < 0 or column < 0 or row >= z.shape[0] or column >= z.shape[1]:
            continue
        if source[row, column] != _UNKNOWN and source[row, column] != _FILLED:
            found[k] = z[row, column]
    return found


@kernel()
def cell_spans(places: Float64, first: float, cell_m: float, step_m: float) -> Int64:
    """List the cells whose centres lie within half a step of each place (N,), m, or else the nearest one:
    (N, 3) first, nearest, and one past the last. first: place of the first cell.
    """
    spans, half = np.empty((places.size, 3), np.int64), step_m / 2 / cell_m
    for k in range(places.size):
        at = (places[k] - first) / cell_m
        nearest = int(np.floor(at + 0.5))
        spans[k, 0] = min(int(np.ceil(at - half - 1e-6)), nearest)
        spans[k, 1] = nearest
        spans[k, 2] = max(int(np.ceil(at + half - 1e-6)), nearest + 1)
    return spans


@kernel()
def highest_seen(z: Float32, source: UInt8, low: int, top: int, left: int, right: int) -> float:
    """Return the height of the highest cell seen in rows low to top and columns left to right, without the
    last of each; NaN where none is. z, source: maps (rows, columns).
    """
    highest = np.nan
    for row in range(max(low, 0), min(top, z.shape[0])):
        for column in range(max(left, 0), min(right, z.shape[1])):
            seen = source[row, column] != _UNKNOWN and source[row, column] != _FILLED
            if seen and not highest >= z[row, column]:
                highest = float(z[row, column])
    return highest


@kernel()
def interpolate_height(z: Float32, source: UInt8, column: float, row: float) -> float:
    """Interpolate the height between the four cells around a place given in cells; NaN where less than half
    of the weight was seen. z, source: maps (rows, columns).
    """
    left, low = int(np.floor(column)), int(np.floor(row))
    total, weight = 0.0, 0.0
    for c, share_c in ((left, 1 - (column - left)), (left + 1, column - left)):
        for r, share_r in ((low, 1 - (row - low)), (low + 1, row - low)):
            if r < 0 or c < 0 or r >= z.shape[0] or c >= z.shape[1]:
                continue
            if source[r, c] == _UNKNOWN or source[r, c] == _FILLED or np.isnan(z[r, c]):
                continue
            total += share_c * share_r * z[r, c]
            weight += share_c * share_r
    return total / weight if weight >= 0.5 else np.nan


@kernel()
def is_blocked(grid: CellGrid, place: tuple[float, float, float], eye: Float64, over_m: float) -> bool:
    """Check whether a surface rises more than over_m above the line of sight from a place to an eye (3,): in
    the place's own cell, and on in steps of at most a cell.
    """
    x, y, z = place
    steps = max(int(np.ceil(np.sqrt((eye[0] - x) ** 2 + (eye[1] - y) ** 2) / grid.cell_m)), 1)
    for step in range(steps):
        part = step / steps
        level = z + part * (eye[2] - z) + over_m
        if level >= grid.highest_m:
            return False
        column = int(np.floor((x + part * (eye[0] - x) - grid.x0_m) / grid.cell_m + 0.5))
        row = int(np.floor((y + part * (eye[1] - y) - grid.y0_m) / grid.cell_m + 0.5))
        is_inside = 0 <= row < grid.z_m.shape[0] and 0 <= column < grid.z_m.shape[1]
        if is_inside and grid.z_m[row, column] > level:
            return True
    return False


@kernel()
def are_blocked(grid: CellGrid, places: Float64, eye: Float64, over_m: float) -> Bool:
    """Check for places (N, 3) whether a surface rises more than over_m above their lines of sight to an eye
    (3,); (N,).
    """
    blocked = np.empty(len(places), np.bool_)
    for n in range(len(places)):
        blocked[n] = is_blocked(grid, (places[n, 0], places[n, 1], places[n, 2]), eye, over_m)
    return blocked
