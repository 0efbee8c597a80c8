"""Measure a bundle's flanks: how far it falls off on either side, and what may lie over them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from barsight.core.arrays import Float64
from barsight.yard.bundles.fitting.outline_fit import FittedOutline
from barsight.yard.bundles.section.seen_section import agreeing_rows, mean_section
from barsight.yard.types import Doubt, DoubtKind

_CREST_RATIO = 0.35
"""Maximum distance of the crest, a bundle's highest place, from the middle, in widths."""
_FLANK_RATIOS = 0.3, 0.5, 0.55
"""Distances from a bundle's middle, in widths: where it begins to fall off, its edge, and how far a map may
extend the flank over the edge.
"""
_SIDES = "low", "high"
_BESIDE_M, _BEYOND_M = 0.05, 0.15
"""Minimum distance (m) beyond a bundle's edge of a place that shows what lies beside it; maximum distance of
a neighbour that may lie over it.
"""
_FLAT_RATIO, _SHALLOW_RATIO, _SURE_RATIO, _HIGHER_M = 0.1, 0.18, 0.3, 0.03
"""Thresholds on a flank's fall, in widths, and on a neighbour's rise over the crest (m).

A flank that falls by less than the first isn't seen. Beside a neighbour that rises by more than the last,
neither is one that falls by less than the second, and one that falls by less than the third isn't certain.
A neighbour that rises by the whole width is a separate stack.
"""
_ENDED_RATIO = 0.6
"""Minimum depth, in widths, under the crest of a place beside a flank that can't be the bundle's own: a round
one is widest half its width under its top.
"""


@dataclass(frozen=True)
class Flanks:
    """Flanks on the low and the high side.

    falls_m: from the crest to the lowest place of each flank, inf where it falls to the floor or out of
    sight, 0 where something higher hides all of it or nothing was measured beside it. rises_m: from the crest
    to the highest place beside each flank, -inf where only floor is seen, NaN where nothing was measured, as
    beyond the map's end. are_flat: neither flank falls off before its edge, as with a plate, a
    cart or a wall. ended: the sides on which straps show where the bundle ends, however little it falls
    there.
    """

    width_m: float
    falls_m: tuple[float, float]
    rises_m: tuple[float, float]
    are_flat: bool
    ended: tuple[bool, bool] = (False, False)

    @property
    def doubt(self) -> Doubt | None:
        """Return the doubt that something may lie over a flank; None where both are seen."""
        return self._doubt(_SHALLOW_RATIO)

    @property
    def cover_doubt(self) -> Doubt | None:
        """Return the same doubt for a flank that isn't seen with certainty."""
        return self._doubt(_SURE_RATIO)

    @property
    def are_steps(self) -> bool:
        """Check whether neither flank falls off even as far as a map extends it, beside nothing higher. Round
        bars show a flank there, whatever lines on top look like straps.
        """
        sides = zip(self.falls_m, self.rises_m, strict=True)
        return all(fall < _FLAT_RATIO * self.width_m and rise <= _HIGHER_M for fall, rise in sides)

    @property
    def unbounded(self) -> tuple[str, ...]:
        """Name the flanks beside which nothing was measured, so that the bundle may be wider."""
        return tuple(name for name, rise in zip(_SIDES, self.rises_m, strict=True) if np.isnan(rise))

    @property
    def falls_off(self) -> tuple[bool, bool]:
        """Check on the low and the high side whether the surface certainly falls off before its edge."""
        low, high = (fall >= _SURE_RATIO * self.width_m for fall in self.falls_m)
        return low, high

    def _doubt(self, shallow_ratio: float) -> Doubt | None:
        sides = list(zip(_SIDES, self.falls_m, self.rises_m, self.ended, strict=True))
        for name, fall, rise, ended in sides:
            if fall < _FLAT_RATIO * self.width_m and not (ended and rise <= _HIGHER_M):
                said = f"its {name} flank was not seen: something may lie over it"
                return Doubt(DoubtKind.UNSEEN_FLANK, said)
        for name, fall, rise, _ in sides:
            if fall < shallow_ratio * self.width_m and _HIGHER_M < rise < self.width_m:
                said = f"what stands {1e3 * rise:.0f} mm higher beside it may lie over its {name} flank"
                return Doubt(DoubtKind.HIDDEN_FLANK, said)
        return None


def seen_flanks(one: FittedOutline, low_m: float, high_m: float) -> Flanks | None:
    """Measure the flanks of a bundle from low_m to high_m beside an outline's axis; None where too few rows
    agree with the outline or the crest isn't seen.
    """
    rows = agreeing_rows(one.fit)
    if rows.size < 3:
        return None
    width, middle = high_m - low_m, (low_m + high_m) / 2
    half = round((width / 2 + abs(middle) + _BEYOND_M) / one.grid.cell_m) + 1
    beside, level = mean_section(one.grid, one.fit, rows, half)
    away = np.asarray(beside - middle, np.float64)
    crest = level[(np.abs(away) < _CREST_RATIO * width) & np.isfinite(level)].max(initial=-np.inf)
    if not np.isfinite(crest):
        return None
    low, high = (_flank(side * away, level, float(crest), width) for side in (-1, 1))
    are_flat = max(low[0], high[0]) < _FLAT_RATIO * width
    return Flanks(width, (low[1], high[1]), (low[2], high[2]), are_flat)


def _flank(outwards: Float64, level: Float64, crest: float, width: float) -> tuple[float, float, float]:
    """Measure one side from the crest (m): the fall before its edge; the fall including what a map extends
    over it, inf where that goes to the floor or out of sight, 0 where something higher hides the whole flank
    or nothing was measured beside it; and the rise of what lies beyond, NaN where nothing was measured. What
    stands behind a place that is deeper than the bundle can't lie over it, but what goes on over the edge
    before such a place may.
    """
    first, edge, last = (ratio * width for ratio in _FLANK_RATIOS)
    inner = level[(outwards > first) & (outwards < edge)]
    before = crest - inner[np.isfinite(inner)].min(initial=crest)
    measured = ~np.isnan(level) & (outwards < edge + _BEYOND_M)
    furthest = int(np.flatnonzero(measured)[outwards[measured].argmax()])
    if outwards[furthest] < edge + _BESIDE_M and crest - level[furthest] < width:
        return float(before), 0.0, np.nan
    ended = (outwards > first) & (crest - level > _ENDED_RATIO * width)
    end = outwards[ended].min(initial=np.inf)
    own = level[(outwards > first) & (outwards < min(last, end))]
    beyond = level[(outwards >= edge) & (outwards < edge + _BEYOND_M) & (outwards <= end)]
    rise = beyond[np.isfinite(beyond)].max(initial=-np.inf) - crest
    seen = own[~np.isnan(own)]
    lowest = seen.min() if seen.size else crest if own.size and rise > _HIGHER_M else -np.inf
    goes_on = np.isfinite(level[(outwards >= last) & (outwards < end)]).any()
    fall = np.inf if end < last + _BESIDE_M and not goes_on else crest - lowest
    return float(before), float(fall), float(rise)
