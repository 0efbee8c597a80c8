"""Find the straps of a bundle in the orthophoto: where its bars are held together, it begins and ends.

A strap is a line across the bars, darker or brighter than the steel before and after it. Bars side by side
that share their straps belong to one bundle; between two bundles the lines break off or lie elsewhere.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from scipy import ndimage

from barsight.core.arrays import Bool, Float32, Float64, Int64
from barsight.core.types import HeightSource
from barsight.yard.bundles.fitting.outline_fit import ABOVE, BELOW, MIXED, SLOPE_U, Fit, U
from barsight.yard.bundles.fitting.rotated_map import AlignedMap
from barsight.yard.bundles.section.strap_lines import find_cliffs, find_gullies, line_contrast, split_columns
from barsight.yard.types import HeightMap

REACH_M = 0.55
"""Search reach to either side of a bundle's axis, its neighbours' straps included."""
_NARROWEST_M = 0.07
"""Width of the narrowest place that straps may hold."""
_EDGE = 1.0
"""Median contrast of the straps, beyond _NOISE, where a bundle's are still seen."""
_BREAK_M = 0.08
"""A strap may be as bright as the bars over so much of its length."""
_CLOSE_M = 0.05
"""Rows nearer to what lies over the outline tell nothing: it throws shade."""
_DENSE_M = 0.45
"""Straps are no nearer to each other than this, on average over a bundle's length."""
MIN_STRAPS, MIN_ROWS = 2, 20
"""Fewest straps that hold a bundle, and rows of the map that tell its mean section."""
_LINE_M, _END_M = 0.05, 0.08
"""Half the length along the bars over which a strap's place is averaged, and the width of either end."""
_APART_M = 0.3
"""Lines nearer to each other along the bars are one strap."""


@dataclass(frozen=True)
class StrapSpan:
    """Place that straps hold together: from low_m to high_m beside a bundle's axis. rows_m: where along it
    each strap lies at its low and at its high end; spread_m: how far the straps disagree on an end.
    """

    low_m: float
    high_m: float
    rows_m: tuple[tuple[float, float], ...]
    spread_m: float

    @property
    def width_m(self) -> float:
        """Return the width that the straps span."""
        return self.high_m - self.low_m


def strap_spans(
    height_map: HeightMap, sheet: AlignedMap, fit: Fit, level_m: Float64
) -> tuple[StrapSpan, ...]:
    """Find what straps hold together within REACH_M of a bundle's axis, from low to high.

    height_map: one with an orthophoto. level_m: mean heights over the axis at the same places.
    """
    beside, gray, stock = _around(height_map, sheet, fit)
    contrast = line_contrast(gray, sheet.cell_m)
    near = 2 * round(_CLOSE_M / sheet.cell_m) + 1
    other = np.isin(fit.state[fit.first : fit.last + 1], (ABOVE, BELOW, MIXED))
    contrast[~stock] = 0.0
    contrast[ndimage.binary_dilation(other, np.ones(near, bool))] = 0.0
    narrowest = max(round(_NARROWEST_M / sheet.cell_m), 3)
    spans = []
    for first, last, teeth in split_columns(
        contrast, narrowest, find_gullies(level_m, sheet.cell_m), find_cliffs(level_m)
    ):
        rows = _strongest(contrast[teeth, first:last].mean(axis=1), teeth, round(_APART_M / sheet.cell_m))
        ends = _ends(contrast[rows, first:last], round(_BREAK_M / sheet.cell_m) | 1)
        if ends is None or not MIN_STRAPS <= rows.size <= max(len(contrast) * sheet.cell_m / _DENSE_M, 2):
            continue
        low, high = np.median(ends, axis=0)
        spread = float(np.median(np.abs(ends - (low, high)), axis=0).max())
        if high - low >= narrowest:
            across = beside[0] + sheet.cell_m * (first - 0.5 + np.array([low, high]))
            own = contrast[:, first + round(low) : first + round(high)]
            along = tuple(_row_at_ends(own, row, sheet.cell_m) for row in np.sort(rows).tolist())
            spans.append(StrapSpan(float(across[0]), float(across[1]), along, sheet.cell_m * spread))
    return tuple(spans)


def _around(height_map: HeightMap, sheet: AlignedMap, fit: Fit) -> tuple[Float64, Float32, Bool]:
    """Resample gray levels (rows, places), NaN where unseen, along a bundle's axis: its rows, and places (m)
    beside it; and which of them lie over the floor.
    """
    half = round(REACH_M / sheet.cell_m)
    beside = np.asarray(sheet.cell_m * np.arange(-half, half + 1), np.float64)
    v = sheet.v0_m + sheet.cell_m * np.arange(fit.first, fit.last + 1)
    u = fit.values[U] + fit.values[SLOPE_U] * (v - fit.v_m)[:, None] + beside
    c, s = math.cos(sheet.heading_rad), math.sin(sheet.heading_rad)
    x, y = c * u - s * v[:, None], s * u + c * v[:, None]
    column = np.asarray((x - height_map.x0_m) / height_map.cell_m, np.float32)
    row = np.asarray((y - height_map.y0_m) / height_map.cell_m, np.float32)
    assert height_map.gray is not None
    low = [max(int(a.min()) - 1, 0) for a in (row, column)]
    high = [int(a.max()) + 2 for a in (row, column)]
    part = height_map.gray[low[0] : high[0], low[1] : high[1]]
    heights = height_map.z_m[low[0] : high[0], low[1] : high[1]]
    sources = height_map.source[low[0] : high[0], low[1] : high[1]]
    if part.size == 0:
        nothing: Float32 = np.full(u.shape, np.nan, np.float32)
        return beside, nothing, np.zeros(u.shape, bool)
    seen = np.where(part > 0, part, np.nan).astype(np.float32)
    places = column - low[1], row - low[0]
    gray = cv2.remap(seen, *places, cv2.INTER_LINEAR, borderValue=np.nan)
    z = cv2.remap(
        np.where(HeightSource.measured(sources), heights, np.float32(np.nan)),
        *places,
        cv2.INTER_NEAREST,
        borderValue=np.nan,
    )
    stock: Bool = np.asarray(np.isfinite(gray) & (z > sheet.stock_over_m))
    return beside, np.asarray(gray, np.float32), stock


def _strongest(strength: Float64, teeth: Int64, apart: int) -> Int64:
    """Keep of lines nearer to each other than `apart` rows the strongest: (S,) rows of straps."""
    kept: list[int] = []
    for k in np.argsort(-strength):
        if all(abs(teeth[k] - row) >= apart for row in kept):
            kept.append(int(teeth[k]))
    return np.array(kept, np.int64)


def _row_at_ends(contrast: Float64, row: int, cell_m: float) -> tuple[float, float]:
    """Compute where along the axis, m, a strap lies at its low and its high end: its contrast's centre."""
    reach, end = round(_LINE_M / cell_m), max(round(_END_M / cell_m), 1)
    first = max(row - reach, 0)
    near = np.maximum(contrast[first : row + reach + 1], 0.0)
    low, high = (
        float(np.average(np.arange(len(near)), weights=part)) if part.any() else float(row - first)
        for part in (near[:, :end].sum(axis=1), near[:, -end:].sum(axis=1))
    )
    return cell_m * (first + low), cell_m * (first + high)


def _ends(contrast: Float64, bridged: int) -> Float64 | None:
    """Find where each strap (rows) begins and ends (S, 2), one past the last place; None where few are seen.

    A strap is its longest run over _EDGE, breaks of up to `bridged` places closed.
    """
    ends = []
    for own in contrast:
        seen = ndimage.binary_closing(np.pad(own > _EDGE, bridged), np.ones(bridged, bool))[bridged:-bridged]
        runs, count = ndimage.label(seen)
        if count:
            longest = np.flatnonzero(runs == 1 + int(np.bincount(runs)[1:].argmax()))
            ends.append((longest[0], longest[-1] + 1))
    return np.array(ends, np.float64) if len(ends) >= MIN_STRAPS else None
