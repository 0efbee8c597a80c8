"""Find where a pack ends on one side, and whether its flank is seen there."""

from __future__ import annotations

from enum import IntEnum, auto

import numpy as np
from scipy import ndimage

from barsight.core.arrays import Float64
from barsight.yard.bundles.section.dark_lines import find_minima
from barsight.yard.bundles.section.seen_section import is_overhung, unseen_places
from barsight.yard.bundles.section.strap_lines import FLOOR_M, GULLY_M

_FLANK_RATIO, _FLANK_DEPTH_M, _FLANK_M = 0.6, 0.15, 0.15
"""Depth under the top that counts as a flank, the larger of a share of the straps' width and a minimum (m);
distance from the straps within which a flank is searched for (m).
"""
_WIDEST_RATIO, _WIDEST_M = 0.6, 0.1
"""Depth under the top below which no pack gets wider: at least the first (in strap widths) and the second
(m).
"""
_LEDGE_SLOPE = 1.0
"""Maximum slope of a ledge, as a low bar at the side shows: two successive steps that fall less steeply."""
_PARTING_M, _PARTING_RATIO = 0.06, 0.3
"""Minimum depth of a gully that separates two packs, whatever their straps show: absolute (m) and as a share
of the straps' width. It must also be as deep as a bar is thick. In 3757 simulated packs no gully is deeper
than 86 mm; in 1956 of them none is deeper than 1.7 bars of up to 25 mm, 1.05 of up to 60 mm, or 0.85 of 80 to
100 mm.
"""
_HIDDEN_CELLS = 12
"""Maximum number of unseen places in a flank behind which the surface can be seen to have fallen away."""
_STEP_M, _DEEP_CELLS = 0.05, 2
"""Minimum step (m) that separates the bundle's lowest bars from something far below; minimum number of places
seen that deep that rule out an overhang.
"""
_NEAR_M, _FAR_M = 0.08, 0.25
"""Maximum distances (m) to another bundle's straps at which the lowest place between separates the two, and
at which only a single gully does.
"""
_HIDDEN_DEPTH_M, _TWIN_M = 0.03, 0.012
"""Depth (m) assumed for places out of sight below their neighbours; minimum rise (m) between two gullies."""
_STEEP_RATIO = 0.3
"""Minimum fall, in widths, of a flank that then goes out of sight: what it hides of the bundle is little."""
_DENT_M, _RIM_CELLS = 0.006, 8
"""Minimum depth (m) of the dent between two bundles that touch, under the highest of this many places on
either side. A round surface without a dent belongs to one bundle, whatever lines are seen on it.
"""
_HIGHER_M, _COVERED_RATIO = 0.03, 0.5
"""Minimum rise (m) over a pack's top of a neighbour that may lie over its flank; minimum fall of the flank,
in the straps' widths, that rules this out: a round pack is widest half its width under its top. A neighbour
that rises by more than the whole width is a separate stack.
"""
MAX_FEW_RATIO = 2.4
"""Maximum width of a pack of three or four bars, in their maximum diameter."""
_PEAK_FALL_RATIO, _PEAK_RATIO, _PEAKED_FALL_RATIO = 0.25, 0.65, 0.6
"""A section is peaked where the part that falls by less than the first is narrower than the second, in
widths: 0.5 of an upright triangle of three bars, 0.87 of a round pack, and 0.92 of a hexagon of seven that
stands on a corner, whose shoulders lie 0.18 widths under its top. A triangle is widest 0.68 widths under its
top: a flank that falls by less than the third ends over its lower bar, on which a neighbour may rest, even a
lower one.
"""
_BEHIND_CELLS = 16
"""Number of places behind a flank within which a neighbour that stands over it must begin."""
_RISES_M = 0.01
"""Minimum rise (m) of the surface behind a flank for it to be a neighbour's."""


class PackSide(IntEnum):
    """State of a pack's side: its flank is seen, a neighbour that may lie over it begins there, or the pack's
    end isn't known.
    """

    SEEN = auto()
    COVERED = auto()
    OPEN = auto()


def find_side(
    outwards: Float64, inwards: Float64, begin: int | None, shared: bool | None, top: float, width_m: float,
    cell_m: float, thick_m: float,
) -> tuple[int, PackSide]:  # fmt: skip
    """Find the last place of a bundle that is in sight on one side, and the state of that side.

    outwards, inwards: heights from the last place that its straps hold: NaN unseen, -inf floor. begin: places
    to the next straps, None where there are none; shared: whether those are in line with its own. top,
    width_m: of the part that the straps hold. thick_m: maximum diameter of its bars, NaN if unknown.
    """
    deep = flank_depth(top, width_m)
    limit = round(_FLANK_M / cell_m)
    widest = top - max(_WIDEST_RATIO * width_m, _WIDEST_M)
    last, falls = _fall(outwards, limit if begin is None else min(begin, limit), deep)
    if falls:
        last = _widest(outwards[: last + 1], widest, cell_m)
        behind = outwards[last + 1 : last + 1 + _BEHIND_CELLS]
        known = behind[~np.isnan(behind)]
        open_below = (known[:_DEEP_CELLS] <= deep).sum() >= _DEEP_CELLS
        return last, PackSide.SEEN if open_below or not is_overhung(inwards, behind) else PackSide.COVERED
    bottom = None
    if begin is not None and not shared and begin <= round(_FAR_M / cell_m):
        alone = shared is None or begin > round(_NEAR_M / cell_m)
        bottom = _gully(outwards[: begin + 1], top, alone)
    if bottom is None:
        min_depth_m = float(np.max((thick_m, _PARTING_M, _PARTING_RATIO * width_m)))
        bottom = _parting(outwards, limit, top, min_depth_m)
    if bottom is None:
        return last, PackSide.OPEN
    last = int(np.flatnonzero(np.isfinite(outwards[: bottom + 1]))[-1])
    hidden = not np.isfinite(outwards[last + 1 : bottom + _HIDDEN_CELLS]).all()
    fall = top - float(np.nanmin(outwards[: last + 1]))
    end = _widest(outwards[: last + 1], widest, cell_m)
    if hidden and fall >= _STEEP_RATIO * width_m:
        return end, PackSide.SEEN
    before = np.concatenate([outwards[last:0:-1], inwards])
    rims = before[:_RIM_CELLS], outwards[last + 1 :][:_RIM_CELLS]
    if np.isfinite(rims[1][:1]).any() and min(map(_highest, rims)) - outwards[last] < _DENT_M:
        return last, PackSide.OPEN
    beside = _adjoining(outwards[last + 1 :][:_BEHIND_CELLS], float(outwards[last]))
    rise = _highest(beside) - top
    higher = rise > _HIGHER_M
    steep = fall >= (_COVERED_RATIO if higher else _STEEP_RATIO) * width_m
    if steep or not (higher or is_overhung(before, beside)):
        return end, PackSide.SEEN
    return last, PackSide.OPEN if rise > width_m else PackSide.COVERED


def ends_over_lower_bar(
    outwards: Float64, inwards: Float64, last: int, top: float, width_m: float, cell_m: float
) -> bool:
    """Check whether a flank that ends at `last` may end over its own lower bar, as that of an upright
    triangle of bars does where a neighbour rests on it. width_m: of the pack; others: of `find_side`.
    """
    beyond = outwards[last:][:_BEHIND_CELLS]
    beyond = beyond[~np.isnan(beyond)]
    lowest = np.minimum.accumulate(beyond)
    rises = np.flatnonzero(beyond > lowest + _RISES_M)
    if not rises.size or top - lowest[rises[0]] >= _PEAKED_FALL_RATIO * width_m:
        return False
    section = np.concatenate([outwards[last:0:-1], inwards])[: round(width_m / cell_m)]
    high = np.flatnonzero(section >= top - _PEAK_FALL_RATIO * width_m)
    return bool(high.size and (high[-1] - high[0] + 1) * cell_m < _PEAK_RATIO * width_m)


def hidden_places(outwards: Float64, last: int) -> int:
    """Count the places out of sight behind a flank that ends at `last`, or slightly further out, as high."""
    behind = outwards[last + 1 :]
    level = np.append(np.abs(behind - outwards[last]) <= _RISES_M, False)
    first = int(np.argmin(level))
    return unseen_places(behind[first:])


def flank_depth(top: float, width_m: float) -> float:
    """Compute the height below which only what continues without a step is a pack's. width_m:
    of its straps.
    """
    return top - max(_FLANK_RATIO * width_m, _FLANK_DEPTH_M)


def _parting(level: Float64, limit: int, top: float, min_depth_m: float) -> int | None:
    """Find the bottom, within `limit` places, of the first gully that is deeper than `min_depth_m` from both
    of its sides, as no gully within a pack is. Places out of sight count as no deeper than what is seen.

    None where there is no such gully, or `min_depth_m` is NaN.
    """
    lowest, rises = 0, False
    for k, height in enumerate(level):
        if height < level[lowest]:
            if rises or k > limit:
                return None
            lowest = k
        # An unseen place may be arbitrarily low, but it has no depth below itself.
        if not height <= level[lowest] and min(top, height) - level[lowest] >= min_depth_m:
            return lowest
        rises |= bool(height > level[lowest] + _RISES_M)
    return None


def _adjoining(behind: Float64, bottom: float) -> Float64:
    """Cut the surface behind a gully at its first wall if something lower rises from the gully's bottom
    before it: then the wall isn't adjacent to the gully.
    """
    walls = np.flatnonzero(np.diff(np.maximum(behind, -FLOOR_M), prepend=bottom) > _STEP_M)
    first = int(walls[0]) if walls.size else len(behind)
    rises = first >= 2 and _highest(behind[:first]) > bottom + _RISES_M
    return behind[:first] if rises else behind


def _highest(level: Float64) -> float:
    """Return the maximum of the seen heights, -inf where none is seen."""
    return float(level[np.isfinite(level)].max(initial=-np.inf))


def _widest(level: Float64, deep: float, cell_m: float) -> int:
    """Find the last place of a flank. Where the flank continues deeper than `deep` without a ledge, the map
    has smeared it, and the last place above that depth counts.
    """
    last = len(level) - 1
    deeper = np.flatnonzero(level < deep)
    if deeper.size == 0:
        return last
    first = max(int(deeper[0]) - 1, 0)
    is_level = np.diff(level[first:]) > -_LEDGE_SLOPE * cell_m
    return last if (is_level[1:] & is_level[:-1]).any() else first


def _fall(level: Float64, limit: int, deep: float) -> tuple[int, bool]:
    """Walk outwards to the lowest place before the surface rises; also return whether it is seen to fall away
    there.

    level: heights: NaN unseen, -inf floor. deep: height under which only what continues without a step
    belongs to the bundle.
    """
    lowest = 0
    for k in range(1, min(len(level), limit + 1)):
        if np.isnan(level[k]):
            behind = level[k : k + _HIDDEN_CELLS]
            behind = behind[~np.isnan(behind)]
            falls = bool(behind.size and behind[0] <= deep)
            return k - 1 if falls else lowest, falls
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
    """Find the bottom of the gully between the straps of two bundles: its place, None where no gully
    separates them.

    level: heights from the last place of one bundle's straps to the first of the other's. alone: the straps
    are so far apart that the gully must be the only one, and deep.
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
    """Fill places out of sight, and floor, with heights below the lower of their two neighbours; the first
    place must be seen.
    """
    filled = level.copy()
    runs, count = ndimage.label(~np.isfinite(level))
    for number in range(1, count + 1):
        own = np.flatnonzero(runs == number)
        around = [level[k] for k in (own[0] - 1, own[-1] + 1) if 0 <= k < len(level)]
        floor = np.isneginf(level[own]).any()
        filled[own] = min(around) - (FLOOR_M if floor else _HIDDEN_DEPTH_M)
    return filled
