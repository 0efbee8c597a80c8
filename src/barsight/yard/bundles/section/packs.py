"""Extend what straps hold to its flanks: a pack, whose width is whole where both flanks are seen."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from barsight.core.arrays import Float64
from barsight.yard.bundles.fitting.outline_fit import Fit
from barsight.yard.bundles.fitting.rotated_map import AlignedMap
from barsight.yard.bundles.section.bar_pitch import bar_diameter, find_minima
from barsight.yard.bundles.section.seen_section import agreeing_rows, is_overhung, mean_section
from barsight.yard.bundles.section.strap_lines import CLIFF_M, FLOOR_M, GULLY_M
from barsight.yard.bundles.section.straps import MIN_ROWS, REACH_M, StrapSpan, strap_spans
from barsight.yard.types import HeightMap

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
    seen = np.nan_to_num(level, nan=-FLOOR_M, neginf=-FLOOR_M)
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
    towers = bool((outwards[: begin + _BEHIND_CELLS // 4] > top + CLIFF_M).any())
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
    deep = min(top - filled[bottom], filled[bottom:].max() - filled[bottom]) >= GULLY_M
    return bottom if deep else None


def _fill_hidden(level: Float64) -> Float64:
    """Fill places out of sight, and floor, below the lower of their two neighbours; the first is seen."""
    filled = level.copy()
    runs, count = ndimage.label(~np.isfinite(level))
    for number in range(1, count + 1):
        own = np.flatnonzero(runs == number)
        around = [level[k] for k in (own[0] - 1, own[-1] + 1) if 0 <= k < len(level)]
        floor = np.isneginf(level[own]).any()
        filled[own] = min(around) - (FLOOR_M if floor else _HIDDEN_DEPTH_M)
    return filled
