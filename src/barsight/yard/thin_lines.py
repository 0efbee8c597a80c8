"""Find thin bars that lie loose across a load in the top photo: matching can't see bars under three pixels.

Such a bar is a narrow bright line that continues over gullies between bars and gaps between bundles. A strap
is dark, and ends where its bundle does; dunnage shows beside the load, not on it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import maximum_filter1d, uniform_filter1d

from barsight.core.arrays import Float32, Float64, Int64, kernel
from barsight.core.linalg.robust import known_median, mad_sigma, running_median
from barsight.yard.map_lookup import SATURATED_LEVEL, sample_levels
from barsight.yard.types import Bundle, Doubt, DoubtKind, HeightMap

MAX_STRENGTH = 8.0
"""Maximum strength, in sigmas of its row, of a line on a load due to texture, dunnage or a strap with a
bright middle, where the load is at least WIDE_M wide. A bar's strength grows as the square root of the
length of its line, and beside a narrow load a floor as bright as the bar shows none of it: there the limit
falls as that root.
"""
WIDE_M = 0.28
SURE_STRENGTH = 14.0
"""Minimum strength of a line that can't be a strap."""
STEP_M = 0.01
REACH_M = 0.6
"""Distance (m) beyond a bundle's flank within which a line may add to its strength on the bundle."""
AROUND_M = 0.07
"""Length (m) along the bars of the median that gives the steel's own gray level: a line is far narrower."""
INNER_RATIO = 0.84
"""Middle share of the load's width in which a line must show; dunnage may show beside it."""
BESIDE_M = (0.0, 0.1, 0.2, 0.35, 0.55)
"""Distances (m) beyond the middle, to either side, to which a line is followed."""
BESIDE_RATIO = 1.5
"""Maximum weight, by length and relative to the middle, of the parts of a line beyond it."""
MIN_CONTRAST, MAX_CONTRAST = -2.0, 5.0
"""Limits, in sigmas of a column, at which contrasts are clipped."""
MIN_SIGMA_LOG = 0.05
"""Minimum scatter of a column's log levels."""
HIGHLIGHT_LOG, FADE_LOG = 0.3, 0.4
"""Log level over the load's median from which highlights have no weight, as a bar doesn't show on them; and
the range below it over which their weight falls.
"""
LIT_M = 0.3
"""Length (m) along the load of the median of its rows' medians: where that is higher than the load's own
median, the load is lit more brightly there, as by the sun, and highlights are told by that level.
"""
BESIDE_END_M = 0.12
"""Distance (m) from an end within which rows aren't used, since objects before the end show there."""
MIN_SEEN_RATIO = 0.8
"""Minimum share of a load's cells that must be seen in the top photo."""
MAX_SATURATED_RATIO, SATURATED_M = 0.65, 0.2
"""Maximum share of a load's cells that may be saturated, over a length (m) that is longer than a label."""
APART_M = 0.1
"""Minimum distance (m) along a bundle between two lines; closer ones are one."""
STRAP_M, STRAP_SLOPE = 0.025, 0.17
"""Distance (m) along a bundle from one of its known straps, and slope, within which lines are that strap."""
_SLOPES = np.r_[np.arange(-1.2, -0.5, 0.05), np.arange(-0.5, 0.501, 0.02), np.arange(0.55, 1.21, 0.05)]
MAX_SLOPE = float(_SLOPES.max())
"""Maximum slope of a line relative to the perpendicular of the bundle's axis."""
_DARK = 2
"""Level added to all levels, since ratios of very dark levels mean nothing."""
_ROW_SIGMAS = np.float32(math.sqrt(3.0))
"""Factor on the scatter of a row's sum, since neighbouring columns of the photo share their pixels."""


@dataclass(frozen=True)
class ThinLine:
    """A line across a bundle. strength: its contrast in sigmas. along_m: where it crosses the axis, from the
    middle. askew_deg: its angle from the perpendicular of the axis. limit: strength from which it may be a
    bar.
    """

    strength: float
    along_m: float
    askew_deg: float
    limit: float = MAX_STRENGTH

    @property
    def excess_ratio(self) -> float:
        """Return the strength relative to its limit."""
        return self.strength / self.limit


def find_thin_lines(heights: HeightMap, bundle: Bundle) -> tuple[ThinLine, ...] | None:
    """Find the strongest line across a bundle in the top photo that isn't a known strap, then all others over
    the limit; None where too little of the bundle is seen, or a part of it is saturated.
    """
    found = line_strengths(heights, bundle)
    if found is None:
        return None
    along, strength = found
    for strap in bundle.straps_m:
        strength[np.ix_(np.abs(_SLOPES) < STRAP_SLOPE, np.abs(along - strap) < STRAP_M)] = 0.0
    limit = MAX_STRENGTH * math.sqrt(min(bundle.width_m / WIDE_M, 1.0))
    number, best = strength.argmax(axis=0), strength.max(axis=0)
    peaks = best == maximum_filter1d(best, 2 * round(APART_M / STEP_M) + 1)
    peaks &= best >= min(limit, best.max())
    rows = np.flatnonzero(peaks)
    return tuple(
        ThinLine(float(best[row]), float(along[row]), math.degrees(math.atan(_SLOPES[number[row]])), limit)
        for row in rows[np.argsort(-best[rows], kind="stable")]
    )


def with_thin_lines(bundle: Bundle, heights: HeightMap) -> Bundle:
    """Return the bundle with a doubt where a line runs across it, unless heights already show that something,
    such as dunnage, crosses it.
    """
    if heights.tops is None or any(doubt.kind is DoubtKind.CROSSED for doubt in bundle.reasons):
        return bundle
    lines = find_thin_lines(heights, bundle)
    if lines is None or lines[0].excess_ratio < 1:
        return bundle
    kind = DoubtKind.THIN_BAR if lines[0].strength >= SURE_STRENGTH else DoubtKind.FAINT_LINE
    doubt = Doubt(kind, f"a line runs across it {lines[0].along_m:+.2f} m from its middle: {kind.value}")
    return bundle.with_cover_doubt(doubt)


def line_strengths(heights: HeightMap, bundle: Bundle) -> tuple[Float64, Float32] | None:
    """Compute the places (V,) at which lines cross a bundle's axis, m from its middle, and their strengths
    (S, V) for each slope; None where too little of the bundle is seen, or a part of it is saturated.

    Contrasts are taken along the bars: log gray level minus its median over AROUND_M, divided by the column's
    scatter. A line's strength is its sum divided by sqrt(columns), without columns that are highlights. Parts
    beside the load add to those on it, up to BESIDE_RATIO times as much.
    """
    if heights.tops is None:
        return None
    along, level = _strip(heights, bundle)
    rim = round(BESIDE_END_M / STEP_M)
    middle, half = level.shape[1] // 2, max(round(INNER_RATIO * bundle.width_m / 2 / STEP_M), 3)
    first, last = middle - half, middle + half + 1
    if len(along) <= 2 * rim or np.isfinite(level[:, first:last]).mean() < MIN_SEEN_RATIO:
        return None
    saturated = (level[:, first:last] >= np.log(SATURATED_LEVEL + _DARK)).mean(axis=1)
    if uniform_filter1d(saturated, round(SATURATED_M / STEP_M)).max() > MAX_SATURATED_RATIO:
        return None
    contrast, weight = _contrast(level, middle, round(bundle.width_m / 2 / STEP_M))
    reaches = [round(beside / STEP_M) for beside in BESIDE_M]
    left = [first - n for n in reaches if n <= first]
    right = [last + n for n in reaches if last + n <= level.shape[1]]
    ends = np.array([*left[::-1], *right])
    reach = math.ceil(MAX_SLOPE * level.shape[1]) + 1
    columns, power = (
        np.pad(np.ascontiguousarray(part.T), ((0, 0), (reach, reach))) for part in (contrast, weight**2)
    )
    strength = _line_strengths(columns, power, reach, _SLOPES, ends, len(left), last - first)
    return along[rim:-rim], strength[:, rim:-rim]


@kernel()
def _line_strengths(
    contrast: Float32, power: Float32, reach: int, slopes: Float64, ends: Int64, count: int, width: int
) -> Float32:  # fmt: skip
    """Compute the strength (S, V) of the line of each slope through each row of the middle column: the
    maximum over all distances to which it is followed beside the load's middle.

    contrast, power: (U, V + 2 reach) contrasts and squared weights by columns, with zeros before and after
    for as far as the steepest line reaches, plus one. ends: (E,) columns, of which the first `count` lie left
    of the middle, the nearest last. width: number of the middle's columns.
    """
    rows = contrast.shape[1] - 2 * reach
    strength = np.full((slopes.size, rows), -np.inf, np.float32)
    total, known = np.empty((ends.size, rows), np.float32), np.empty((ends.size, rows), np.float32)
    for s in range(slopes.size):
        _add_along(contrast, slopes[s], ends, total)
        _add_along(power, slopes[s], ends, known)
        best = strength[s]
        for i in range(count):
            for j in range(count, ends.size):
                share = np.float32(BESIDE_RATIO * ((ends[j] - ends[i]) / width - 1))
                for v in range(rows):
                    own = total[count, v] - total[count - 1, v]
                    beside = total[j, v] - total[i, v] - own
                    counted = own + min(beside, share * max(own, np.float32(0)))
                    spread = _ROW_SIGMAS * np.sqrt(known[j, v] - known[i, v] + np.float32(2))
                    best[v] = max(best[v], counted / spread)
    return strength


@kernel()
def _add_along(part: Float32, slope: float, ends: Int64, sums: Float32) -> None:
    """Sum columns from the first of `ends` (E,) to each of them along lines of one slope, (E, V);
    interpolated linearly between rows. part: (U, V + 2 reach), see `_line_strengths`.
    """
    rows, middle = sums.shape[1], len(part) // 2
    reach = (part.shape[1] - rows) // 2
    sums[0] = 0
    for e in range(1, ends.size):
        into = sums[e]
        into[:] = sums[e - 1]
        for u in range(ends[e - 1], ends[e]):
            shift = slope * (u - middle)
            before = int(np.floor(shift))
            share = np.float32(shift - before)
            rest = np.float32(1) - share
            column = part[u, reach + before : reach + before + rows + 1]
            for v in range(rows):
                into[v] += rest * column[v] + share * column[v + 1]


def _strip(heights: HeightMap, bundle: Bundle) -> tuple[Float64, Float32]:
    """Resample the photo along a bundle's axis: places along it (V,), log gray levels (V, U),
    NaN if unseen.
    """
    assert heights.tops is not None
    across, axis = bundle.axes
    half_v, half_u = round(bundle.length_m / 2 / STEP_M), round((bundle.width_m / 2 + REACH_M) / STEP_M)
    along, beside = (STEP_M * np.arange(-half, half + 1.0) for half in (half_v, half_u))
    x = bundle.centre_m[0] + along[:, None] * axis[0] + beside * across[0]
    y = bundle.centre_m[1] + along[:, None] * axis[1] + beside * across[1]
    return along, np.log(sample_levels(heights, heights.tops, x, y) + _DARK)


def _contrast(level: Float32, middle: int, half: int) -> tuple[Float32, Float32]:
    """Compute each place's contrast (V, U) to its column around it, in sigmas, and the columns' weights."""
    seen = np.isfinite(level)
    filled = np.where(seen, level, np.nan_to_num(known_median(level)))
    around = running_median(filled, _odd_steps(AROUND_M))
    off = np.where(seen, filled - around, 0)
    off -= np.median(off, axis=0)
    sigma = np.maximum(mad_sigma(off, axis=0), MIN_SIGMA_LOG)
    contrast = np.clip(off / sigma, MIN_CONTRAST, MAX_CONTRAST)
    own = around[:, middle - half : middle + half + 1]
    lit = running_median(np.median(own, axis=1, keepdims=True), _odd_steps(LIT_M))
    base = np.maximum(np.median(own), lit)
    weight = np.clip((base + HIGHLIGHT_LOG - around) / FADE_LOG, 0, 1)
    return ((contrast - contrast.mean(axis=0)) * weight).astype(np.float32), weight.astype(np.float32)


def _odd_steps(length_m: float) -> int:
    """Return the odd number of steps nearest to a length."""
    return 2 * round(length_m / STEP_M / 2 - 0.5) + 1
