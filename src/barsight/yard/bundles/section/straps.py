"""Find the straps of a bundle in the orthophoto: they hold its bars together, and show where it ends.

A strap is a line across the bars, darker or brighter than the steel before and after it. Bars side by side
that share their straps belong to one bundle; between two bundles the lines break off or are elsewhere.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from barsight.core.arrays import Bool, Float32, Float64, Int64, kernel
from barsight.core.linalg.robust import known_median
from barsight.yard.bundles.fitting.outline_fit import ABOVE, BELOW, MIXED, SLOPE_U, Fit, U
from barsight.yard.bundles.fitting.rotated_map import AlignedMap
from barsight.yard.bundles.section.strap_lines import (
    faint_lines,
    find_cliffs,
    find_gullies,
    level_along,
    line_contrast,
    pooled_contrast,
    split_columns,
    split_faint,
)
from barsight.yard.map_lookup import lookup_heights, sample_levels
from barsight.yard.types import HeightMap

REACH_M = 0.55
"""Distance (m) to either side of a bundle's axis within which its and its neighbours' straps are sought."""
_NARROWEST_M = 0.07
"""Minimum width (m) of a part that straps may hold."""
_EDGE = 1.0
"""Minimum contrast of a strap, beyond _NOISE, at the edge of its bundle."""
_FAINT_EDGE = 2.0
"""Minimum contrast over noise of an averaged faint line at the edge of its bundle."""
_MEET_M, _PART_M = 0.02, 0.04
"""Overlap (m) from which two spans are one, and difference in width (m) from which the narrower span is a
part of the wider one.
"""
_BREAK_M = 0.08
"""Maximum length (m) of a gap in a strap, where it is as bright as the bars."""
_CLOSE_M = 0.05
"""Distance (m) from objects over the outline within which rows aren't used: the objects cast shadows."""
DENSE_M = 0.45
"""Minimum mean spacing (m) of straps along a bundle."""
MIN_STRAPS, MIN_ROWS = 2, 20
"""Minimum number of straps that hold a bundle, and of rows of the map for its mean section."""
_LINE_M, _END_M = 0.05, 0.08
"""Half the length (m) along the bars over which a strap's place is averaged; width (m) of either end."""
APART_M = 0.3
"""Minimum spacing (m) of two straps: lines closer together along the bars are one strap."""

_BARE, _SHOWN, _STRAP, _SURE_STRAPS = 0.35, 0.5, 1.0, 3
"""Maximum contrast of a strap, in its median over its bundle, where it isn't seen, and minimum one where it
is; minimum median in units of the noise, and number of straps that reach it.
"""
_MAX_BARE, _MAX_OPPOSITE_RATIO = 2, 0.125
"""Maximum number of stretches without straps, and maximum share of places with the opposite contrast: with
more, what shows may be noise. Covered bundles of measured yards have up to 2 and 0.1, free ones whose
straps hardly show 2 and 0.17, or 3.
"""
_INSIDE_M, _BESIDE_M = 0.02, 0.04
"""Minimum distance (m) from the straps' ends of a crest without straps, and maximum distance (m) beside it
within which they show again.
"""


@dataclass(frozen=True)
class StrapSpan:
    """The part that straps hold together, from low_m to high_m beside a bundle's axis.

    rows_m: where along it each strap lies at its low and at its high end; spread_m: how far the straps
    disagree on an end.
    """

    low_m: float
    high_m: float
    rows_m: tuple[tuple[float, float], ...]
    spread_m: float

    @property
    def width_m(self) -> float:
        """Return the width that the straps span."""
        return self.high_m - self.low_m


def strap_spans(height_map: HeightMap, grid: AlignedMap, fit: Fit, level_m: Float64) -> tuple[StrapSpan, ...]:
    """Find the parts that straps hold together within REACH_M of a bundle's axis, from low to high.

    height_map: one with an orthophoto. level_m: mean heights over the axis at the same places.
    """
    beside, gray, tops, stock = _around(height_map, grid, fit)
    near = 2 * round(_CLOSE_M / grid.cell_m) + 1
    other = np.isin(fit.state[fit.first : fit.last + 1], (ABOVE, BELOW, MIXED))
    stock &= ~ndimage.binary_dilation(other, np.ones(near, bool))[:, None]
    narrowest = max(round(_NARROWEST_M / grid.cell_m), 3)
    gullies, cliffs = find_gullies(level_m, grid.cell_m), find_cliffs(level_m)
    contrast = line_contrast(gray, grid.cell_m)
    contrast[~stock] = 0.0
    clear = [
        _span(contrast, one, beside, narrowest) for one in split_columns(contrast, narrowest, gullies, cliffs)
    ]
    level, variance = faint_lines(tops, stock, grid.cell_m)
    pooled = pooled_contrast(level, variance, grid.cell_m)
    faint = [
        _span(pooled, one, beside, narrowest, is_faint=True)
        for one in split_faint(level, variance, narrowest, gullies, cliffs)
    ]
    return _merged([span for span in clear if span], [span for span in faint if span])


def _merged(clear: list[StrapSpan], faint: list[StrapSpan]) -> tuple[StrapSpan, ...]:
    """Select among the spans of both kinds, from low to high: a clear one shows more precisely where it ends,
    but may be a part of what a faint one spans.
    """
    kept = list(clear)
    for one in faint:
        met = [own for own in kept if min(own.high_m, one.high_m) - max(own.low_m, one.low_m) > _MEET_M]
        parts = [own for own in met if one.low_m - _MEET_M < own.low_m and own.high_m < one.high_m + _MEET_M]
        if not met or (len(met) == len(parts) == 1 and one.width_m - met[0].width_m > _PART_M):
            kept = [own for own in kept if own not in met] + [one]
    return tuple(sorted(kept, key=lambda span: span.low_m))


def _span(
    contrast: Float64, stretch: tuple[int, int, Int64], beside_m: Float64, narrowest: int, *,
    is_faint: bool = False,
) -> StrapSpan | None:  # fmt: skip
    """Measure the extent over which straps hold a stretch (first, one past the last place, rows of lines);
    None where the straps are too few or too many, or hold less than the narrowest part. Averaged faint lines
    end where they are half as strong as over their strongest quarter.
    """
    first, last, teeth = stretch
    cell_m = float(beside_m[1] - beside_m[0])
    rows = strongest_lines(contrast[teeth, first:last].mean(axis=1), teeth, round(APART_M / cell_m))
    strong = contrast[rows, first:last]
    least = np.full(rows.size, _EDGE)
    if is_faint:
        least = np.maximum(np.percentile(strong, 75, axis=1) / 2, _FAINT_EDGE)
    ends = _ends(strong > least[:, None], round(_BREAK_M / cell_m) | 1)
    if ends is None or not MIN_STRAPS <= rows.size <= max(len(contrast) * cell_m / DENSE_M, 2):
        return None
    low, high = np.median(ends, axis=0)
    if high - low < narrowest:
        return None
    across = beside_m[0] + cell_m * (first - 0.5 + np.array([low, high]))
    own = contrast[:, first + round(low) : first + round(high)]
    along = tuple(_row_at_ends(own, row, cell_m) for row in np.sort(rows).tolist())
    spread = float(np.median(np.abs(ends - (low, high)), axis=0).max())
    return StrapSpan(float(across[0]), float(across[1]), along, cell_m * spread)


def bare_rise(height_map: HeightMap, grid: AlignedMap, fit: Fit, span: StrapSpan, level_m: Float64) -> float:
    """Measure the rise (m) of the highest crest that straps don't cross, though they show on both sides of
    it, over the surface there: a bar that lies along on them. 0 where there is none.

    level_m: mean heights over the axis, at the places within REACH_M.
    """
    shown, own = _shown_shares(height_map, grid, fit, span)
    height = np.where(np.isfinite(level_m), level_m, np.nan)[own]
    inside, beside = (round(reach / grid.cell_m) for reach in (_INSIDE_M, _BESIDE_M))
    edges = np.flatnonzero(np.diff(np.concatenate([[False], shown < _BARE, [False]]).astype(int)))
    if edges.size > 2 * _MAX_BARE or (shown < -_BARE).mean() > _MAX_OPPOSITE_RATIO:
        return 0.0
    highest = 0.0
    for first, end in edges.reshape(-1, 2):
        if first < inside or end > own.size - inside:
            continue
        low, high = height[max(first - beside, 0) : first], height[end : end + beside]
        low = low[shown[max(first - beside, 0) : first] > _SHOWN][-1:]
        high = high[shown[end : end + beside] > _SHOWN][:1]
        if low.size and high.size:
            rise = float(np.nan_to_num(height[first:end], nan=-np.inf).max() - max(low[0], high[0]))
            highest = max(highest, rise)
    return highest


def _shown_shares(
    height_map: HeightMap, grid: AlignedMap, fit: Fit, span: StrapSpan
) -> tuple[Float64, Int64]:
    """Compute how clearly straps show at each place that they span (N,), the median over the straps of their
    contrast in their own medians; 0 where there are too few. Also return the places' indices.
    """
    beside, gray, _, stock = _around(height_map, grid, fit)
    own = np.flatnonzero((beside >= span.low_m) & (beside <= span.high_m))
    level = ndimage.uniform_filter1d(level_along(gray, grid.cell_m), 3, axis=0)
    level[~stock] = np.nan
    shares = []
    for low, high in span.rows_m:
        rows = np.rint(np.linspace(low, high, own.size) / grid.cell_m).astype(np.int64)
        lines = np.array([level[(rows + k).clip(0, len(level) - 1), own] for k in (-1, 0, 1)])
        middles = np.nan_to_num(known_median(lines.T)[0])
        best = int(np.abs(middles).argmax())
        if abs(middles[best]) > _STRAP:
            shares.append(lines[best] / middles[best])
    if len(shares) < _SURE_STRAPS:
        return np.zeros(own.size), own
    return known_median(np.array(shares))[0], own


def _around(height_map: HeightMap, grid: AlignedMap, fit: Fit) -> tuple[Float64, Float32, Float32, Bool]:
    """Resample the pictures along a bundle's axis. Return the lateral places (m); the orthophoto's gray
    levels (rows, places), NaN where unseen; the same of the pictures at the height of the tops, where there
    are any; and which places lie over the floor.
    """
    half = round(REACH_M / grid.cell_m)
    beside = np.asarray(grid.cell_m * np.arange(-half, half + 1), np.float64)
    v = grid.v0_m + grid.cell_m * np.arange(fit.first, fit.last + 1)
    u = fit.values[U] + fit.values[SLOPE_U] * (v - fit.v_m)[:, None] + beside
    c, s = math.cos(grid.heading_rad), math.sin(grid.heading_rad)
    x, y = c * u - s * v[:, None], s * u + c * v[:, None]
    assert height_map.gray is not None
    gray = tops = sample_levels(height_map, height_map.gray, x, y)
    if height_map.tops is not None:
        sharper = sample_levels(height_map, height_map.tops, x, y)
        tops = np.where(np.isfinite(sharper), sharper, gray)
    stock: Bool = np.isfinite(gray) & (lookup_heights(height_map, x, y) > grid.stock_over_m)
    return beside, gray, tops, stock


def strongest_lines(strength: Float64, teeth: Int64, apart: int) -> Int64:
    """Keep the strongest of the lines that are closer together than `apart` rows: (S,) rows of straps."""
    kept: list[int] = []
    for k in np.argsort(-strength, kind="stable"):
        if all(abs(teeth[k] - row) >= apart for row in kept):
            kept.append(int(teeth[k]))
    return np.array(kept, np.int64)


def _row_at_ends(contrast: Float64, row: int, cell_m: float) -> tuple[float, float]:
    """Compute where along the axis (m) a strap's contrast has its centroid, at its low and high end."""
    reach, end = round(_LINE_M / cell_m), max(round(_END_M / cell_m), 1)
    first = max(row - reach, 0)
    near = np.maximum(contrast[first : row + reach + 1], 0.0)
    low, high = (
        float(np.average(np.arange(len(near)), weights=part)) if part.any() else float(row - first)
        for part in (near[:, :end].sum(axis=1), near[:, -end:].sum(axis=1))
    )
    return cell_m * (first + low), cell_m * (first + high)


def _ends(lines: Bool, bridged: int) -> Float64 | None:
    """Find where each strap (rows) begins and ends (S, 2), one past the last place; None where too few are
    seen.

    A strap is its longest run, with gaps of less than `bridged` places closed. lines: (rows, places).
    """
    ends = longest_runs(lines, bridged)
    ends = ends[ends[:, 1] > 0]
    return ends.astype(np.float64) if len(ends) >= MIN_STRAPS else None


@kernel()
def longest_runs(lines: Bool, bridged: int) -> Int64:
    """Find the longest run in each row (rows, 2): its first place and one past its last, both 0 where nothing
    is set. Runs less than `bridged` places apart are one; of equally long ones the first counts.

    lines: (rows, places).
    """
    found = np.zeros((lines.shape[0], 2), np.int64)
    for k in range(lines.shape[0]):
        first, last = -1, -1
        for place in range(lines.shape[1]):
            if not lines[k, place]:
                continue
            if first < 0 or place - last > bridged:
                first = place
            last = place
            if last + 1 - first > found[k, 1] - found[k, 0]:
                found[k, 0], found[k, 1] = first, last + 1
    return found
