"""Sample the orthophoto's gray levels across a bundle."""

from __future__ import annotations

import numpy as np

from barsight.core.arrays import Float64, UInt8
from barsight.yard.bundles.fitting.outline_fit import AGREES, SLOPE_U, Fit, ShadeProfile, U
from barsight.yard.bundles.fitting.rotated_map import AlignedMap
from barsight.yard.types import HeightMap

_BIN_M = 0.002
_MIN_CELLS = 8
"""Minimum number of cells along a bundle for the median at one place across it."""
_MIN_PLACES = 10
_INSIDE = 0.46


def shade_profile(
    height_map: HeightMap, grid: AlignedMap, fit: Fit, between_m: tuple[float, float] | None = None
) -> ShadeProfile | None:
    """Sample the orthophoto's gray levels over the rows that agree with the fit, across its inside or between
    two places beside its axis; None where too little was seen.
    """
    if height_map.gray is None:
        return None
    rows = np.flatnonzero(fit.state == AGREES)
    rows = rows[(rows >= fit.first) & (rows <= fit.last)]
    cell, half = height_map.cell_m, _INSIDE * fit.width_m
    first, last = between_m or (-half, half)
    ends = grid.v0_m + cell * np.array([fit.first, fit.last])
    middle = fit.values[U] + fit.values[SLOPE_U] * (ends - fit.v_m)
    corners = grid.to_map(
        np.stack([np.concatenate([middle + first, middle + last]), np.concatenate([ends, ends])], axis=1)
    )
    place = (corners - (height_map.x0_m, height_map.y0_m)) / cell
    low = np.floor(place.min(axis=0)).astype(int).clip(0, None)
    high = np.ceil(place.max(axis=0)).astype(int) + 1
    gray = height_map.gray[low[1] : high[1], low[0] : high[0]]
    row, column = np.nonzero(gray)
    x = height_map.x0_m + cell * (column + low[0])
    y = height_map.y0_m + cell * (row + low[1])
    c, s = np.cos(grid.heading_rad), np.sin(grid.heading_rad)
    v = c * y - s * x
    beside = (c * x + s * y - fit.values[U] - fit.values[SLOPE_U] * (v - fit.v_m)) / np.hypot(
        1, fit.values[SLOPE_U]
    )
    number = np.rint((v - grid.v0_m) / cell).astype(int).clip(0, fit.state.size - 1)
    agrees = np.zeros(fit.state.size, bool)
    agrees[rows] = True
    wanted = agrees[number] & (beside > first) & (beside < last)
    places, levels = _medians(beside[wanted], gray[row[wanted], column[wanted]])
    return ShadeProfile(places, levels) if places.size >= _MIN_PLACES else None


def _medians(beside: Float64, gray: UInt8) -> tuple[Float64, Float64]:
    """Compute the mean place and the log median gray level of each bin of 2 mm that has enough cells."""
    number = np.floor(beside / _BIN_M).astype(np.int64)
    order = np.lexsort((gray, number))
    first = np.flatnonzero(np.diff(number[order], prepend=np.iinfo(np.int64).min))
    count = np.diff(first, append=order.size)
    places = np.add.reduceat(beside[order], first) / count if order.size else np.empty(0)
    enough = count >= _MIN_CELLS
    middle = gray[order][(first + count // 2)[enough]].astype(np.float64)
    return places[enough], np.log(middle + 5.0)
