"""Extend the part that straps hold to its flanks: a pack, whose whole width is known where both are seen."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from barsight.core.arrays import Float64
from barsight.yard.bundles.fitting.outline_fit import DIAMETER, Fit
from barsight.yard.bundles.fitting.rotated_map import AlignedMap
from barsight.yard.bundles.section.dark_lines import SAME_DIAMETER_RATIO, bar_diameter
from barsight.yard.bundles.section.pack_sides import (
    MAX_FEW_RATIO,
    PackSide,
    ends_over_lower_bar,
    find_side,
    flank_depth,
    hidden_places,
)
from barsight.yard.bundles.section.seen_section import agreeing_rows, mean_section
from barsight.yard.bundles.section.strap_lines import FLOOR_M
from barsight.yard.bundles.section.straps import MIN_ROWS, REACH_M, StrapSpan, bare_rise, strap_spans
from barsight.yard.lift_settings import UPPER
from barsight.yard.types import HeightMap

_OWN_RATIO = 0.5
"""Minimum overlap of straps and a fit, in widths of the narrower, for the straps to be the fit's own."""
_DIP_RATIO = 0.12
"""Minimum depth of a dip, in widths of its span, that may separate two bundles whose straps are in line."""
_SPREAD_M = 0.03
"""Maximum median distance (m) between the straps' ends for the pack's bounds to be known."""
_IN_LINE_M = 0.018
"""Maximum distance (m), along the bars, between the two halves of one strap where they meet."""
_MIN_WIDTH_BARS = 1.5
"""Minimum width of a strapped pack, in diameters of its bars."""
_BEYOND_M = 0.03
"""Distance (m) by which straps beyond an outline, or others' straps inside it, contradict the outline."""
_DENT_M = 0.006
"""Minimum depth (m) of the dent between two bundles: without one, what looks like another's straps are lines
on the same bundle.
"""


@dataclass(frozen=True)
class Pack:
    """Bars that straps hold, with their flanks: from low_m to high_m beside a fit's axis.

    span: width of the straps themselves; others_m: where other bundles' straps begin on either side, infinite
    where there are none, or no dent parts them from its own. top_m: highest place over the axis; sides: the
    low and the high one. diameter_m: of its bars by the dark lines along it, NaN where these aren't seen.
    hidden_m: length out of sight behind the low and the high flank, where bars may bulge. bare_m: rise of a
    crest that no strap crosses.
    """

    low_m: float
    high_m: float
    span: StrapSpan
    others_m: tuple[float, float]
    top_m: float
    sides: tuple[PackSide, PackSide]
    diameter_m: float = math.nan
    hidden_m: tuple[float, float] = (0.0, 0.0)
    bare_m: float = 0.0

    @property
    def sides_seen(self) -> bool:
        """Check whether both flanks fall off before a neighbour begins, so that the whole width is known."""
        return self.sides == (PackSide.SEEN, PackSide.SEEN)

    @property
    def is_bounded(self) -> bool:
        """Check whether the extent of the visible pack is known on both sides."""
        return PackSide.OPEN not in self.sides

    @property
    def width_m(self) -> float:
        """Return the width from flank to flank."""
        return self.high_m - self.low_m

    @property
    def middle_m(self) -> float:
        """Return the place midway between the flanks."""
        return (self.low_m + self.high_m) / 2


def strapped_pack(height_map: HeightMap, grid: AlignedMap, fit: Fit) -> Pack | None:
    """Find the pack that straps hold together over a fit's axis; None where no straps are seen."""
    rows = agreeing_rows(fit)
    if height_map.gray is None or rows.size < MIN_ROWS:
        return None
    beside, level = mean_section(grid, fit, rows, round(REACH_M / grid.cell_m))
    spans = strap_spans(height_map, grid, fit, level)
    number = find_own(spans, fit.width_m)
    if number is None:
        return None
    own = spans[number]
    thick = bar_diameter(height_map, grid, fit, own.low_m, own.high_m)
    pack = find_pack(spans, number, beside, level, thick * (1 + UPPER * SAME_DIAMETER_RATIO))
    if pack is None:
        return None
    pack = replace(pack, bare_m=bare_rise(height_map, grid, fit, own, level))
    if not pack.is_bounded:
        return replace(pack, diameter_m=thick)
    pack = replace(pack, diameter_m=bar_diameter(height_map, grid, fit, pack.low_m, pack.high_m))
    # Straps hold several bars: where no dark line shows, the visible one may be the top one of several.
    one_bar = fit.rings == 0 and math.isnan(pack.diameter_m)
    if one_bar and pack.width_m < _MIN_WIDTH_BARS * float(fit.values[DIAMETER]):
        return replace(pack, sides=(PackSide.OPEN, PackSide.OPEN))
    return pack


def find_own(spans: tuple[StrapSpan, ...], width_m: float) -> int | None:
    """Find the index of the straps over a fit of this width; None where there are none."""
    shares = [
        (min(s.high_m, 0.5 * width_m) - max(s.low_m, -0.5 * width_m)) / min(s.width_m, width_m) for s in spans
    ]
    return int(np.argmax(shares)) if shares and max(shares) >= _OWN_RATIO else None


def find_pack(
    spans: tuple[StrapSpan, ...], number: int, beside_m: Float64, level_m: Float64, thick_m: float
) -> Pack | None:
    """Extend one of `spans` to the flanks of what its straps hold; None where nothing of it is seen.

    level_m: (N,) mean heights over the axis at beside_m: NaN unknown, -inf floor. thick_m: upper bound of the
    bars' diameter, NaN where it isn't known.

    A flank is seen where the surface falls to the floor or far under the top, where a gully is deeper than
    the bars of one pack leave, or where a neighbour begins that is no higher and whose straps are elsewhere.
    The flank stays open at what may be a bar of the same bundle, and at a neighbour most of whose straps are
    in line. A neighbour that stands higher may lie over the flank.
    """
    own = spans[number]
    inside = np.flatnonzero((beside_m >= own.low_m) & (beside_m <= own.high_m) & np.isfinite(level_m))
    if inside.size == 0:
        return None
    top = float(level_m[inside].max())
    cell = float(beside_m[1] - beside_m[0])
    level_inside = level_m[inside[0] : inside[-1] + 1]
    is_one = own.spread_m <= _SPREAD_M and dip_depth(level_inside) < _DIP_RATIO * own.width_m
    ends, others, sides, hidden, flanks = [], [], [], [], []
    for step, at, beyond in ((-1, inside[0], spans[:number][::-1]), (1, inside[-1], spans[number + 1 :])):
        near, begin, shared = np.inf, None, None
        for other in beyond:
            shared = _shared(other, own) if step < 0 else _shared(own, other)
            if not shared and _lies_below(other, beside_m, level_m, flank_depth(top, own.width_m)):
                continue
            near = other.high_m if step < 0 else other.low_m
            begin = max(round((abs(near - float(beside_m[at])) - cell / 2) / cell), 0)
            break
        is_other = begin is not None and shared is False and _is_parted(own, other, beside_m, level_m)
        others.append(float(near) if is_other else step * np.inf)
        around = level_m[at::step], level_m[at::-step]
        last, side = find_side(*around, begin, None if shared else shared, top, own.width_m, cell, thick_m)
        if shared and side is PackSide.SEEN:
            last, side = find_side(*around, begin, True, top, own.width_m, cell, thick_m)
        flanks.append((*around, last))
        ends.append(float(beside_m[at]) + step * cell * (last + 0.5))
        sides.append(side if is_one else PackSide.OPEN)
        hidden.append(cell * hidden_places(around[0], last))
    if not own.width_m > MAX_FEW_RATIO * thick_m:
        for k, flank in enumerate(flanks):
            if sides[k] is PackSide.SEEN and ends_over_lower_bar(*flank, top, ends[1] - ends[0], cell):
                sides[k] = PackSide.COVERED
    return Pack(
        ends[0], ends[1], own, (others[0], others[1]), top, (sides[0], sides[1]), math.nan,
        (hidden[0], hidden[1]),
    )  # fmt: skip


def _lies_below(span: StrapSpan, beside_m: Float64, level_m: Float64, deep_m: float) -> bool:
    """Check whether straps belong to another layer: most of what they hold lies below a pack's flanks."""
    seen = level_m[(beside_m >= span.low_m) & (beside_m <= span.high_m) & ~np.isnan(level_m)]
    return bool(seen.size and np.median(seen) <= deep_m)


def _is_parted(own: StrapSpan, other: StrapSpan, beside_m: Float64, level_m: Float64) -> bool:
    """Check whether the surface sinks between the highest places that two spans hold, as between bundles: a
    flank's own straps, seen aside of those on its crest, may look like another's.
    """
    highest = []
    for span in (own, other):
        inside = np.flatnonzero((beside_m >= span.low_m) & (beside_m <= span.high_m) & np.isfinite(level_m))
        if not inside.size:
            return True
        highest.append(int(inside[np.argmax(level_m[inside])]))
    return dip_depth(level_m[min(highest) : max(highest) + 1]) >= _DENT_M


def contradicts(pack: Pack, width_m: float) -> tuple[float, str]:
    """State how a pack that isn't wholly seen contradicts an outline about the same axis, and by how many
    metres; 0 and an empty text where it doesn't.
    """
    beyond = max(-width_m / 2 - pack.span.low_m, pack.span.high_m - width_m / 2)
    if beyond > _BEYOND_M:
        return beyond, f"straps hold bars up to {1e3 * beyond:.0f} mm beyond its outline"
    within = max(pack.others_m[0] + width_m / 2, width_m / 2 - pack.others_m[1])
    if within > _BEYOND_M:
        return within, f"other straps reach {1e3 * within:.0f} mm into its outline"
    return 0.0, ""


def dip_depth(level: Float64) -> float:
    """Compute how deep the surface sinks between two higher places; unseen places count as floor."""
    seen = np.nan_to_num(level, nan=-FLOOR_M, neginf=-FLOOR_M)
    between = np.minimum(np.maximum.accumulate(seen), np.maximum.accumulate(seen[::-1])[::-1])
    return float((between - seen).max(initial=0.0))


def _shared(lower: StrapSpan, upper: StrapSpan) -> bool | None:
    """Check whether most straps of one are in line with the other's where they meet, as those of one bundle
    are; False where none is, None where at most half are.
    """
    apart = np.abs(np.subtract.outer([rows[1] for rows in lower.rows_m], [rows[0] for rows in upper.rows_m]))
    nearest = apart.min(axis=1 if len(lower.rows_m) <= len(upper.rows_m) else 0)
    in_line = nearest < _IN_LINE_M
    if not in_line.any():
        return False
    return None if 2 * in_line.sum() <= nearest.size else True
