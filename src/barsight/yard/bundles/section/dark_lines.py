"""Measure the diameter of a pack's bars by the spacing of the dark lines along which bars meet."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from barsight.core.arrays import Float64
from barsight.yard.bundles.fitting.outline_fit import Fit, ShadeProfile
from barsight.yard.bundles.fitting.rotated_map import AlignedMap
from barsight.yard.bundles.section.shades import shade_profile
from barsight.yard.types import HeightMap

SAME_DIAMETER_RATIO = 0.13
"""Tolerance of a diameter that is measured by the dark lines, as a fraction of it. Where all lines show, the
bars of simulated packs have 0.78 (P5) to 1.4 (P95) times the measured diameter.
"""
_DIAMETER_RATIO = 1.06
"""Bar diameter divided by the median spacing of the dark lines: some bars are partly hidden."""
_STEP_M, _BLUR_M = 0.002, 0.004
_DARKER_LOG = 0.15
"""Minimum difference of the log gray level between a dark line and the bars on both of its sides."""


def bar_diameter(height_map: HeightMap, grid: AlignedMap, fit: Fit, low_m: float, high_m: float) -> float:
    """Measure the bar diameter of a pack by the median spacing of the dark lines along it, from low_m to
    high_m beside a fit's axis; NaN where fewer than two lines are seen.
    """
    shades = shade_profile(height_map, grid, fit, (low_m, high_m))
    lines = np.empty(0) if shades is None else dark_lines(shades)
    return _DIAMETER_RATIO * float(np.median(np.diff(lines))) if lines.size > 1 else float("nan")


def dark_lines(shades: ShadeProfile) -> Float64:
    """Find the places of the gray levels' minima between a fall and a rise by _DARKER_LOG."""
    places = np.arange(shades.places_m[0], shades.places_m[-1], _STEP_M)
    level = np.interp(places, shades.places_m, shades.levels)
    level = ndimage.gaussian_filter1d(level, _BLUR_M / _STEP_M)
    return np.asarray(places[find_minima(level, _DARKER_LOG, falling=False)], np.float64)


def find_minima(level: Float64, depth: float, *, falling: bool) -> list[int]:
    """Find the minima of a profile (N,) between falls and rises by `depth`.

    falling: whether the beginning of the profile counts as a fall.
    """
    minima, lowest, highest = list[int](), 0, level[0]
    for k in range(1, len(level)):
        if falling and level[k] < level[lowest]:
            lowest = k
        elif falling and level[k] > level[lowest] + depth:
            minima.append(lowest)
            falling, highest = False, level[k]
        elif not falling and level[k] < highest - depth:
            falling, lowest = True, k
        highest = max(highest, level[k])
    return minima
