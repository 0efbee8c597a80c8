"""Find lines across the bars in gray levels, and part places that share them from those that do not."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from barsight.core.arrays import Bool, Float32, Float64, Int64
from barsight.core.linalg.robust import mad_sigma, running_median

_AROUND_M = 0.2
"""Length along the bars over which the steel's own gray level is taken."""
_MIN_SIGMA_LOG = 0.05
"""Least scatter of a bar's gray levels along it, in the logarithm."""
_CLIPPED, _NOISE = 6.0, 2.0
"""Contrasts over noise: from where more counts no more, and what a line must have more of."""
_TOOTH = 0.6
"""Mean of the contrast over noise, beyond _NOISE, that a strap has over a bundle's width."""
_PRICE, _GULLY_PRICE = 60.0, 10.0
"""Contrast that a bundle's straps must have in all, so that chance doesn't part one bundle into two; less is
asked where the surface does."""
GULLY_M, _GULLY_SIDE_M = 0.03, 0.08
"""Least depth of a gully that may part bundles, and the reach of its two sides."""
CLIFF_M, _CLIFF_CELLS = 0.12, 2
"""No straps hold bars on both sides of a step of this height, within so many places."""
FLOOR_M = 1e3
"""Depth that stands for the floor and for what is not seen."""


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
    """Check at which places (N,) the surface sinks by GULLY_M between two sides, or isn't seen."""
    seen = np.nan_to_num(level_m, nan=-FLOOR_M, neginf=-FLOOR_M)
    reach = round(_GULLY_SIDE_M / cell_m)
    before = np.array([seen[max(k - reach, 0) : k + 1].max() for k in range(len(seen))])
    behind = np.array([seen[k : k + reach + 1].max() for k in range(len(seen))])
    return np.asarray(np.minimum(before, behind) - seen > GULLY_M)


def find_cliffs(level_m: Float64) -> Bool:
    """Check at which places (N,) the surface steps by CLIFF_M, seen or behind what is not seen."""
    last_seen = np.maximum.accumulate(np.where(np.isnan(level_m), 0, np.arange(len(level_m))))
    filled = np.nan_to_num(level_m[last_seen], nan=-FLOOR_M, neginf=-FLOOR_M)
    step = np.zeros(len(filled), bool)
    step[:-_CLIFF_CELLS] = np.abs(filled[_CLIFF_CELLS:] - filled[:-_CLIFF_CELLS]) > CLIFF_M
    return step
