"""Find thin bars that lie loose across a load in the top photo: matching sees none under three pixels.

Such a bar is a narrow bright line that runs on over gullies between bars and gaps between bundles. A strap is
dark, and ends where its bundle does; dunnage shows beside the load, not on it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy import ndimage

from barsight.core.arrays import Float32, Float64, Int64
from barsight.core.linalg.robust import mad_sigma
from barsight.yard.types import Bundle, HeightMap

KNOWN_ACROSS = "crosses over it"
"""In the reason of a bundle that heights show to be crossed at several places, as by dunnage."""
MAX_STRENGTH = 8.0
"""Of a line that texture, dunnage or a strap with a bright middle makes on a load, in sigmas of its row."""
STEP_M = 0.01
REACH_M = 0.6
"""How far beside a bundle's axis a line may add to what is seen of it on the bundle."""
AROUND_M = 0.07
"""Length along the bars over which the steel's own gray level is taken: a line is far narrower."""
INNER_RATIO = 0.84
"""Of the load's width, its middle: a line must show there. Dunnage may show beside it."""
BESIDE_M = (0.0, 0.1, 0.2, 0.35, 0.55)
"""How far beyond the middle, to either side, a line is followed."""
BESIDE_RATIO = 1.5
"""What lies beyond counts at most so many times as much as the middle, by length."""
DARK, BRIGHT = -2.0, 5.0
"""Contrasts, in sigmas of a column, beyond which more doesn't count."""
MIN_SIGMA_LOG = 0.05
HIGHLIGHT_LOG, FADE_LOG = 0.3, 0.4
"""A bar doesn't show on highlights, this much over the load's median; they count less from FADE_LOG below."""
BESIDE_END_M = 0.12
"""Rows nearer to an end tell nothing: what lies before it shows there."""
MIN_SEEN_RATIO = 0.8
_SLOPES = [*np.arange(-1.2, -0.5, 0.05), *np.arange(-0.5, 0.501, 0.02), *np.arange(0.55, 1.21, 0.05)]
_ROW_SIGMAS = math.sqrt(3.0)
"""Neighbouring columns of the photo share their pixels: a row's sum scatters more by this."""


@dataclass(frozen=True)
class ThinLine:
    """The strongest line across a bundle. strength: its contrast in sigmas. along_m: where it crosses the
    axis, from the middle. askew_deg: its angle from square to the axis.
    """

    strength: float
    along_m: float
    askew_deg: float


def find_thin_line(heights: HeightMap, bundle: Bundle) -> ThinLine | None:
    """Find the strongest line across a bundle in the top photo; None where too little of it is seen."""
    found = line_strengths(heights, bundle)
    if found is None:
        return None
    along, strength = found
    number, row = np.unravel_index(int(strength.argmax()), strength.shape)
    askew_deg = math.degrees(math.atan(_SLOPES[number]))
    return ThinLine(float(strength[number, row]), float(along[row]), askew_deg)


def with_thin_lines(bundle: Bundle, heights: HeightMap) -> Bundle:
    """Return a bundle that says so where a line runs across it; dunnage that heights show is left out."""
    if heights.tops is None or any(KNOWN_ACROSS in reason for reason in bundle.reasons):
        return bundle
    line = find_thin_line(heights, bundle)
    if line is None or line.strength < MAX_STRENGTH:
        return bundle
    reason = f"a line runs across it {line.along_m:+.2f} m from its middle: a thin bar may lie over it"
    return replace(bundle, reasons=(*bundle.reasons, reason))


def line_strengths(heights: HeightMap, bundle: Bundle) -> tuple[Float64, Float32] | None:
    """Compute where lines cross a bundle's axis (V,), m from its middle, and the strengths (S, V) of each
    slope; None where too little of it is seen.

    Gray levels are taken along the bars: their logarithm less its median over AROUND_M, over the column's
    scatter. A line's strength is its sum over sqrt(columns), of columns that aren't highlights; what lies
    beside the load adds to what lies on it, up to BESIDE_RATIO of it.
    """
    if heights.tops is None:
        return None
    along, level = _strip(heights, bundle)
    rim = round(BESIDE_END_M / STEP_M)
    middle, half = level.shape[1] // 2, max(round(INNER_RATIO * bundle.width_m / 2 / STEP_M), 3)
    first, last = middle - half, middle + half + 1
    if len(along) <= 2 * rim or np.isfinite(level[:, first:last]).mean() < MIN_SEEN_RATIO:
        return None
    contrast, weight = _contrast(level, middle, round(bundle.width_m / 2 / STEP_M))
    reaches = [round(beside / STEP_M) for beside in BESIDE_M]
    left = [first - n for n in reaches if n <= first]
    right = [last + n for n in reaches if last + n <= level.shape[1]]
    ends, power = np.array([*left[::-1], *right]), weight**2
    strength = np.array([
        _strengths(_sums(contrast, slope, ends), _sums(power, slope, ends), len(left), last - first, ends)
        for slope in _SLOPES
    ])  # fmt: skip
    return along[rim:-rim], strength[:, rim:-rim]


def _strengths(total: Float32, known: Float32, count: int, width: int, ends: Int64) -> Float32:
    """Compute the strength of the line in each row (V,): the best of all reaches beside the load's middle.

    total, known: sums (E, V) of contrasts and squared weights from the first of `ends` (E,) to each, of which
    the first `count` lie left of the middle, the nearest last. width: the middle's columns.
    """
    left, right = slice(None, count), slice(count, None)
    own = total[count] - total[count - 1]
    beside = total[right] - total[left][:, None] - own
    share = np.subtract.outer(ends[right], ends[left]).T / width - 1
    counted = np.minimum(beside, BESIDE_RATIO * np.maximum(own, 0) * share[..., None])
    spread = np.sqrt(known[right] - known[left][:, None] + 2.0) * _ROW_SIGMAS
    return np.asarray(((own + counted) / spread).max(axis=(0, 1)), np.float32)


def _strip(heights: HeightMap, bundle: Bundle) -> tuple[Float64, Float32]:
    """Resample the photo along a bundle's axis: places along it (V,), logarithms of gray levels (V, U), NaN
    where unseen.
    """
    assert heights.tops is not None
    axis = np.array([-math.sin(bundle.yaw_rad), math.cos(bundle.yaw_rad)])
    half_v, half_u = round(bundle.length_m / 2 / STEP_M), round((bundle.width_m / 2 + REACH_M) / STEP_M)
    along, beside = (STEP_M * np.arange(-half, half + 1.0) for half in (half_v, half_u))
    x = bundle.centre_m[0] + along[:, None] * axis[0] + beside * axis[1]
    y = bundle.centre_m[1] + along[:, None] * axis[1] - beside * axis[0]
    column, row = (
        np.asarray((at - first) / heights.cell_m, np.float32)
        for at, first in ((x, heights.x0_m), (y, heights.y0_m))
    )
    low = [max(math.floor(float(at.min())), 0) for at in (row, column)]
    high = [max(math.ceil(float(at.max())) + 1, 0) for at in (row, column)]
    part = heights.tops[low[0] : high[0], low[1] : high[1]]
    if part.size == 0:
        return along, np.full(x.shape, np.nan, np.float32)
    seen = np.where(part > 0, np.log(part + 2.0), np.nan).astype(np.float32)
    level = cv2.remap(seen, column - low[1], row - low[0], cv2.INTER_LINEAR, borderValue=np.nan)
    return along, np.asarray(level, np.float32)


def _contrast(level: Float32, middle: int, half: int) -> tuple[Float32, Float32]:
    """Compute each place's contrast (V, U) to its column around it, in sigmas, and the columns' weights."""
    seen = np.isfinite(level)
    ordered = np.sort(level, axis=0)
    typical = np.take_along_axis(ordered, np.maximum(seen.sum(axis=0) - 1, 0)[None] // 2, axis=0)
    filled = np.where(seen, level, np.nan_to_num(typical))
    around = ndimage.median_filter(filled, (2 * round(AROUND_M / STEP_M / 2 - 0.5) + 1, 1), mode="nearest")
    off = np.where(seen, filled - around, 0)
    off -= np.median(off, axis=0)
    sigma = np.maximum(mad_sigma(off, axis=0), MIN_SIGMA_LOG)
    contrast = np.clip(off / sigma, DARK, BRIGHT)
    base = float(np.median(around[:, middle - half : middle + half + 1]))
    weight = np.clip((base + HIGHLIGHT_LOG - around) / FADE_LOG, 0, 1)
    return ((contrast - contrast.mean(axis=0)) * weight).astype(np.float32), weight.astype(np.float32)


def _sums(part: Float32, slope: float, ends: Int64) -> Float32:
    """Compute sums (E, V) of the columns from the first of `ends` (E,) to each, columns (V, U) shifted so
    that lines of this slope through the middle become rows.
    """
    columns = np.ascontiguousarray(part.T)
    shift = np.array([[1, slope, -slope * (len(columns) // 2)], [0, 1, 0]], np.float32)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    sheared = cv2.warpAffine(columns, shift, (columns.shape[1], columns.shape[0]), flags=flags)
    sums = np.zeros((len(ends), columns.shape[1]), np.float32)
    sums[1:] = np.add.reduceat(sheared[: ends[-1]], ends[:-1], axis=0).cumsum(axis=0)
    return sums
