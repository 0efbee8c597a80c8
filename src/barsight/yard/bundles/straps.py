"""Find the straps of a bundle in the orthophoto: where its bars are held together, it begins and ends.

A strap is a line across the bars, darker or brighter than the steel before and after it. Bars side by side
that share their straps belong to one bundle; between two bundles the lines break off or lie elsewhere.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy import ndimage

from barsight.core.arrays import Bool, Float32, Float64, Int64
from barsight.core.linalg.robust import mad_sigma, running_median
from barsight.core.types import HeightSource
from barsight.yard.bundles.bar_pitch import bar_diameter, find_minima
from barsight.yard.bundles.fitting.outline_fit import ABOVE, BELOW, MIXED, SLOPE_U, Fit, U
from barsight.yard.bundles.fitting.rotated_map import AlignedMap
from barsight.yard.bundles.seen_section import agreeing_rows, is_overhung, mean_section
from barsight.yard.types import HeightMap

REACH_M = 0.55
"""Search reach to either side of a bundle's axis, its neighbours' straps included."""
_AROUND_M = 0.2
"""Length along the bars over which the steel's own gray level is taken."""
_MIN_SIGMA_LOG = 0.05
_CLIPPED, _NOISE = 6.0, 2.0
"""Contrasts over noise: from where more counts no more, and what a line must have more of."""
_TOOTH = 0.6
"""Mean of the contrast over noise, beyond _NOISE, that a strap has over a bundle's width."""
_PRICE, _GULLY_PRICE = 60.0, 10.0
"""Contrast that a bundle's straps must have in all, so that chance doesn't part one bundle into two; less is
asked where the surface does."""
_GULLY_M, _GULLY_SIDE_M = 0.03, 0.08
"""Least depth of a gully that may part bundles, and the reach of its two sides."""
_CLIFF_M, _CLIFF_CELLS = 0.12, 2
"""No straps hold bars on both sides of a step of this height, within so many places."""
_FLOOR_M = 1e3
"""Depth that stands for the floor and for what is not seen."""
_NARROWEST_M = 0.07
_EDGE = 1.0
"""Median contrast of the straps, beyond _NOISE, where a bundle's are still seen."""
_BREAK_M = 0.08
"""A strap may be as bright as the bars over so much of its length."""
_CLOSE_M = 0.05
"""Rows nearer to what lies over the outline tell nothing: it throws shade."""
_DENSE_M = 0.45
"""Straps are no nearer to each other than this, on average over a bundle's length."""
MIN_STRAPS, MIN_ROWS = 2, 20
_OWN_RATIO = 0.5
"""Of the narrower one's width: what straps and a fit must have in common."""
_FLANK_RATIO, _FLANK_DEPTH_M, _FLANK_M = 0.6, 0.15, 0.15
"""Depth of a flank under the top, of the straps' width and at least; how far from them it is looked for."""
_HIDDEN_CELLS = 12
"""A flank may be hidden over so many places before the surface is seen to have fallen away."""
_STEP_M, _DEEP_CELLS = 0.05, 2
"""What follows deep below by steps under this is the bundle's lowest bars; over so many places that are seen
deep below nothing hangs."""
_NEAR_M, _FAR_M = 0.08, 0.25
"""Where another bundle's straps begin this near, the lowest place between parts both; up to the further
distance a single gully does."""
_HIDDEN_DEPTH_M, _TWIN_M = 0.03, 0.012
"""How much deeper places out of sight count, and how far the surface must rise between two gullies."""
_STEEP_RATIO = 0.3
"""Of the width: a flank that is seen to fall so far before it is out of sight hides little of the bundle."""
_DIP_RATIO = 0.12
"""Of a span's width: a deeper dip in it may part two bundles whose straps lie in line."""
_SPREAD_M = 0.03
"""Straps that disagree on an end by more (median) leave it open."""
_IN_LINE_M, _BESIDE_M = 0.025, 0.09
"""Along the bars: how far the two halves of one strap may lie apart; a strap that is nearer than the second,
but not in line, makes it doubtful that any are of one bundle."""
_BEYOND_M = 0.03
"""Straps that go on so far beyond an outline, or others that reach so far into it, speak against it."""
_BEHIND_CELLS = 16
"""Places behind a flank where a neighbour that stands over it would begin."""
_RISES_M = 0.01
"""Behind its flank a surface that rises by this is a neighbour's."""
_APART_M = 0.3
"""Lines nearer to each other along the bars are one strap."""


@dataclass(frozen=True)
class StrapSpan:
    """Place that straps hold together: from low_m to high_m beside a bundle's axis. rows_m: where along it;
    spread_m: how far the straps disagree on an end.
    """

    low_m: float
    high_m: float
    rows_m: tuple[float, ...]
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
            along = tuple(float(row) for row in sheet.cell_m * np.sort(rows))
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
        np.where(sources == HeightSource.VISION, heights, np.float32(np.nan)),
        *places,
        cv2.INTER_NEAREST,
        borderValue=np.nan,
    )
    stock: Bool = np.asarray(np.isfinite(gray) & (z > sheet.stock_over_m))
    return beside, np.asarray(gray, np.float32), stock


def line_contrast(gray: Float32, cell_m: float) -> Float64:
    """Compute contrasts (rows, places) of lines across the bars over noise, beyond _NOISE.

    The logarithm of a gray level less its median along the bar, over the bar's own scatter; NaN counts as
    the bar's median. Lines may lie a cell off from bar to bar.
    """
    level = np.log(gray + 2.0)
    known = np.isfinite(level).sum(axis=0)
    # NaN sorts last.
    middle = np.take_along_axis(np.sort(level, axis=0), np.maximum(known - 1, 0)[None] // 2, axis=0)
    level = np.where(np.isfinite(level), level, np.nan_to_num(middle))
    around = 2 * round(_AROUND_M / cell_m / 2) + 1
    off = np.abs(level - running_median(level, around))
    sigma = np.maximum(mad_sigma(off, axis=0), _MIN_SIGMA_LOG)
    beyond = np.minimum(off / sigma, _CLIPPED) - _NOISE
    lines: Float64 = ndimage.maximum_filter1d(ndimage.uniform_filter1d(beyond, 3, axis=0), 3, axis=0)
    return lines


def split_columns(
    contrast: Float64, narrowest: int, gullies: Bool, cliffs: Bool
) -> list[tuple[int, int, Int64]]:
    """Split places into stretches that share their straps: (first, one past the last, rows of its straps).

    Dynamic programme over places: a stretch gains, of each row whose mean contrast is over _TOOTH, its sum,
    and costs _PRICE, or _GULLY_PRICE where it ends in a gully; none reaches over a cliff.
    contrast: (rows, places); gullies, cliffs: (places,).
    """
    rows, places = contrast.shape
    sums = np.concatenate([np.zeros((rows, 1)), np.cumsum(contrast, axis=1)], axis=1)[1::2]
    best, before = np.zeros(places + 1), np.zeros(places + 1, int)
    for last in range(1, places + 1):
        begin = int(np.flatnonzero(cliffs[: last - 1])[-1]) + 1 if cliffs[: last - 1].any() else 0
        width = last - np.arange(begin, last)
        own = sums[:, last : last + 1] - sums[:, begin:last]
        gain = np.where(own > _TOOTH * width, own, 0.0).sum(axis=0)
        price = _GULLY_PRICE if last == places or gullies[last] or gullies[last - 1] else _PRICE
        total = best[begin:last] + np.where(width >= narrowest, gain, 0.0) - price
        before[last] = begin + int(total.argmax())
        best[last] = total.max()
    found, last = [], places
    while last > 0:
        first = int(before[last])
        own = sums[:, last] - sums[:, first]
        peak = (own == ndimage.maximum_filter1d(own, 5)) & (own > _TOOTH * (last - first))
        if last - first >= narrowest and peak.any():
            found.append((first, last, 2 * np.flatnonzero(peak) + 1))
        last = first
    return found[::-1]


def find_gullies(level_m: Float64, cell_m: float) -> Bool:
    """Check at which places (N,) the surface sinks by _GULLY_M between two sides, or isn't seen."""
    seen = np.nan_to_num(level_m, nan=-_FLOOR_M, neginf=-_FLOOR_M)
    reach = round(_GULLY_SIDE_M / cell_m)
    before = np.array([seen[max(k - reach, 0) : k + 1].max() for k in range(len(seen))])
    behind = np.array([seen[k : k + reach + 1].max() for k in range(len(seen))])
    return np.asarray(np.minimum(before, behind) - seen > _GULLY_M)


def find_cliffs(level_m: Float64) -> Bool:
    """Check at which places (N,) the surface steps by _CLIFF_M, seen or behind what is not seen."""
    last_seen = np.maximum.accumulate(np.where(np.isnan(level_m), 0, np.arange(len(level_m))))
    filled = np.nan_to_num(level_m[last_seen], nan=-_FLOOR_M, neginf=-_FLOOR_M)
    step = np.zeros(len(filled), bool)
    step[:-_CLIFF_CELLS] = np.abs(filled[_CLIFF_CELLS:] - filled[:-_CLIFF_CELLS]) > _CLIFF_M
    return step


def _strongest(strength: Float64, teeth: Int64, apart: int) -> Int64:
    """Keep of lines nearer to each other than `apart` rows the strongest: (S,) rows of straps."""
    kept: list[int] = []
    for k in np.argsort(-strength):
        if all(abs(teeth[k] - row) >= apart for row in kept):
            kept.append(int(teeth[k]))
    return np.array(kept, np.int64)


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


@dataclass(frozen=True)
class Pack:
    """Bars that straps hold, with their flanks: from low_m to high_m beside a fit's axis. span: of the straps
    themselves; others_m: where other bundles' begin on either side, infinite where none do. top_m: highest
    place over the axis; sides_seen: both flanks sink before a neighbour begins: the width is whole.
    diameter_m: of its bars by the dark lines along it, NaN where they aren't seen.
    """

    low_m: float
    high_m: float
    span: StrapSpan
    others_m: tuple[float, float]
    top_m: float
    sides_seen: bool
    diameter_m: float = math.nan

    @property
    def width_m(self) -> float:
        """Return the width from flank to flank."""
        return self.high_m - self.low_m

    @property
    def middle_m(self) -> float:
        """Return the place midway between the flanks."""
        return (self.low_m + self.high_m) / 2


def strapped_pack(height_map: HeightMap, sheet: AlignedMap, fit: Fit) -> Pack | None:
    """Find what straps hold together over a fit's axis; None where none are seen."""
    rows = agreeing_rows(fit)
    if height_map.gray is None or rows.size < MIN_ROWS:
        return None
    beside, level = mean_section(sheet, fit, rows, round(REACH_M / sheet.cell_m))
    pack = find_pack(strap_spans(height_map, sheet, fit, level), fit.width_m, beside, level)
    if pack is None:
        return pack
    ends = (pack.low_m, pack.high_m) if pack.sides_seen else (pack.span.low_m, pack.span.high_m)
    return replace(pack, diameter_m=bar_diameter(height_map, sheet, fit, *ends))


def find_pack(
    spans: tuple[StrapSpan, ...], width_m: float, beside_m: Float64, level_m: Float64
) -> Pack | None:
    """Extend the straps over a fit's axis to its flanks; None where no straps lie over it.

    width_m: of the fit. level_m: (N,) mean heights over the axis at beside_m: NaN unknown, -inf floor.
    A flank is seen where the surface falls to the floor, or far under the top, or where a neighbour
    begins that is no higher and whose straps lie elsewhere. What may be a bar of the same bundle leaves it
    open.
    """
    shares = [
        (min(s.high_m, 0.5 * width_m) - max(s.low_m, -0.5 * width_m)) / min(s.width_m, width_m) for s in spans
    ]
    if not shares or max(shares) < _OWN_RATIO:
        return None
    number = int(np.argmax(shares))
    own = spans[number]
    inside = np.flatnonzero((beside_m >= own.low_m) & (beside_m <= own.high_m) & np.isfinite(level_m))
    if inside.size == 0:
        return None
    top = float(level_m[inside].max())
    cell = float(beside_m[1] - beside_m[0])
    level_inside = level_m[inside[0] : inside[-1] + 1]
    seen = own.spread_m <= _SPREAD_M and _dip(level_inside) < _DIP_RATIO * own.width_m
    ends, others = [], []
    for step, at, number_beside in ((-1, inside[0], number - 1), (1, inside[-1], number + 1)):
        next_one = spans[number_beside] if 0 <= number_beside < len(spans) else None
        near, begin = np.inf, None
        shared = None if next_one is None else _shared(own, next_one)
        if next_one is not None:
            near = next_one.high_m if step < 0 else next_one.low_m
            begin = max(round((abs(near - float(beside_m[at])) - cell / 2) / cell), 0)
        others.append(float(near) if shared is False else step * np.inf)
        last, is_seen = _flank(level_m[at::step], level_m[at::-step], begin, shared, top, own.width_m, cell)
        ends.append(float(beside_m[at]) + step * cell * (last + 0.5))
        seen &= is_seen
    return Pack(ends[0], ends[1], own, (others[0], others[1]), top, bool(seen))


def contradicts(pack: Pack, width_m: float) -> tuple[float, str]:
    """Say how a pack that isn't seen whole speaks against an outline about the same axis, and how far one is
    off the other, m; 0 and empty where it doesn't.
    """
    beyond = max(-width_m / 2 - pack.span.low_m, pack.span.high_m - width_m / 2)
    if beyond > _BEYOND_M:
        return beyond, f"straps hold bars up to {1e3 * beyond:.0f} mm beyond its outline"
    within = max(pack.others_m[0] + width_m / 2, width_m / 2 - pack.others_m[1])
    if within > _BEYOND_M:
        return within, f"other straps reach {1e3 * within:.0f} mm into its outline"
    return 0.0, ""


def _dip(level: Float64) -> float:
    """Compute how deep the surface sinks between two higher places; what isn't seen lies on the floor."""
    seen = np.nan_to_num(level, nan=-_FLOOR_M, neginf=-_FLOOR_M)
    between = np.minimum(np.maximum.accumulate(seen), np.maximum.accumulate(seen[::-1])[::-1])
    return float((between - seen).max(initial=0.0))


def _shared(one: StrapSpan, other: StrapSpan) -> bool | None:
    """Check whether most straps of either lie in line with the other's, as those of one bundle do; None where
    they do but for some that lie just beside one.
    """
    apart = np.abs(np.subtract.outer(one.rows_m, other.rows_m))
    nearest = apart.min(axis=1 if len(one.rows_m) <= len(other.rows_m) else 0)
    in_line = nearest < _IN_LINE_M
    if 2 * in_line.sum() <= nearest.size:
        return False
    return None if (~in_line & (nearest < _BESIDE_M)).any() else True


def _flank(
    outwards: Float64, inwards: Float64, begin: int | None, shared: bool | None, top: float, width_m: float,
    cell_m: float,
) -> tuple[int, bool]:  # fmt: skip
    """Find the last place of a bundle on one side, and whether its flank is seen there.

    outwards, inwards: heights from the last place that its straps hold: NaN unseen, -inf floor. begin: places
    to the next straps, None where there are none; shared: whether those lie in line with its own. top,
    width_m: of what the straps hold.
    """
    deep = top - max(_FLANK_RATIO * width_m, _FLANK_DEPTH_M)
    limit = round(_FLANK_M / cell_m)
    last, falls = _fall(outwards, limit if begin is None else min(begin, limit), deep)
    if falls:
        behind = outwards[last + 1 : last + 1 + _BEHIND_CELLS]
        known = behind[~np.isnan(behind)]
        open_below = (known[:_DEEP_CELLS] <= deep).sum() >= _DEEP_CELLS
        return last, bool(open_below or not is_overhung(inwards, behind))
    if begin is None or shared or begin > round(_FAR_M / cell_m):
        return last, False
    alone = shared is None or begin > round(_NEAR_M / cell_m)
    bottom = _gully(outwards[: begin + 1], top, alone)
    if bottom is None:
        return last, False
    last = int(np.flatnonzero(np.isfinite(outwards[: bottom + 1]))[-1])
    hidden = not np.isfinite(outwards[last + 1 : bottom + _HIDDEN_CELLS]).all()
    if hidden and top - float(np.nanmin(outwards[: last + 1])) >= _STEEP_RATIO * width_m:
        return last, True
    before = np.concatenate([outwards[last:0:-1], inwards])
    towers = bool((outwards[: begin + _BEHIND_CELLS // 4] > top + _CLIFF_M).any())
    return last, not towers and not is_overhung(before, outwards[last + 1 :][:_BEHIND_CELLS])


def _fall(level: Float64, limit: int, deep: float) -> tuple[int, bool]:
    """Walk outwards to the lowest place before the surface rises; whether it is seen to fall away there.

    level: heights: NaN unseen, -inf floor. deep: height under which nothing belongs to the bundle but what
    goes on there without a step.
    """
    lowest = 0
    for k in range(1, min(len(level), limit + 1)):
        if np.isnan(level[k]):
            behind = level[k : k + _HIDDEN_CELLS]
            behind = behind[~np.isnan(behind)]
            return lowest, bool(behind.size and behind[0] <= deep)
        if level[k] <= deep:
            last = lowest
            while k <= limit and k < len(level) and -_RISES_M < level[last] - level[k] < _STEP_M:
                last, k = k, k + 1
            return (lowest + last) // 2, True
        if level[k] > level[lowest] + _RISES_M:
            break
        if level[k] < level[lowest]:
            lowest = k
    return lowest, False


def _gully(level: Float64, top: float, alone: bool) -> int | None:
    """Find the bottom of the gully between a bundle's straps and another's: the place, None where none parts
    them.

    level: heights from the last place of the ones to the first of the others. alone: the straps are so far
    apart that it must be the only one, and deep.
    """
    filled = _fill_hidden(level)
    bottom = int(np.argmin(filled))
    if not alone:
        return bottom
    dips = find_minima(filled, _TWIN_M, falling=True)
    if len(dips) != 1:
        return None
    deep = min(top - filled[bottom], filled[bottom:].max() - filled[bottom]) >= _GULLY_M
    return bottom if deep else None


def _fill_hidden(level: Float64) -> Float64:
    """Fill places out of sight, and floor, below the lower of their two neighbours; the first is seen."""
    filled = level.copy()
    runs, count = ndimage.label(~np.isfinite(level))
    for number in range(1, count + 1):
        own = np.flatnonzero(runs == number)
        around = [level[k] for k in (own[0] - 1, own[-1] + 1) if 0 <= k < len(level)]
        floor = np.isneginf(level[own]).any()
        filled[own] = min(around) - (_FLOOR_M if floor else _HIDDEN_DEPTH_M)
    return filled
