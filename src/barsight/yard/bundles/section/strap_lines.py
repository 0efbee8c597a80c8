"""Find lines across the bars in gray levels, and group the places that share them."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from barsight.core.arrays import Bool, Float32, Float64, Int64, kernel
from barsight.core.linalg.robust import mad_sigma, running_median

_AROUND_M = 0.2
"""Length (m) along the bars of the running median that yields the steel's own gray level."""
_MIN_SIGMA_LOG = 0.05
"""Minimum scatter of the log gray level along a bar."""
_CLIPPED, _NOISE = 6.0, 2.0
"""Contrast in units of the noise: the value at which it is clipped, and the one that a line must exceed."""
_TOOTH = 0.6
"""Minimum mean contrast, beyond _NOISE and over a bundle's width, of a strap."""
_PRICE, _GULLY_PRICE = 60.0, 10.0
"""Minimum total contrast of a bundle's straps, so that chance doesn't split one bundle into two; the second,
lower value applies where the surface shows a gully.
"""
_POOL_M = 0.07
"""Length (m) across the bars over which a faint line's gray levels are averaged."""
_MIN_VARIANCE = 0.3
"""Minimum variance that one place contributes to a faint line's sum."""
_SPOT = 3.0
"""Contrast over noise at which levels are clipped for faint lines: single spots then count less."""
_FAINT, _FAINT_PRICE, _FAINT_GULLY_PRICE = 4.0, 15.0, 5.0
"""Thresholds for faint lines: minimum mean level in units of the noise of such means, and minimum total of
half the squares beyond that, elsewhere and in a gully.
"""
GULLY_M, _GULLY_SIDE_M = 0.03, 0.08
"""Minimum depth (m) of a gully that may separate bundles, and the extent (m) of each of its two sides."""
CLIFF_M, _CLIFF_CELLS = 0.12, 2
"""Minimum height (m) of a step that no strap spans, and the number of places within which it occurs."""
FLOOR_M = 1e3
"""Depth (m) assumed for the floor and for unseen places."""


def line_contrast(gray: Float32, cell_m: float) -> Float64:
    """Compute the contrast (rows, places) over noise, beyond _NOISE, of lines across the bars.

    Lines may be off by a cell from bar to bar.
    """
    beyond = np.minimum(np.abs(level_along(gray, cell_m)), _CLIPPED) - _NOISE
    lines: Float64 = ndimage.maximum_filter1d(ndimage.uniform_filter1d(beyond, 3, axis=0), 3, axis=0)
    return lines


def faint_lines(gray: Float32, stock: Bool, cell_m: float) -> tuple[Float64, Float64]:
    """Compute by how much each place (rows, places) is brighter than the steel before and behind it, averaged
    along the bar over a strap's width, and the variance that each place (places,) contributes to a sum
    across.

    On rough or rusty bars a strap is fainter than the bar's own spots, but it is darker or brighter at the
    same place on all bars. stock: where bars lie.
    """
    level = np.clip(level_along(gray, cell_m), -_SPOT, _SPOT)
    level = ndimage.uniform_filter1d(np.where(stock, level, 0.0), 3, axis=0)
    pool = round(_POOL_M / cell_m) | 1
    scatter = mad_sigma(ndimage.uniform_filter1d(level, pool, axis=1), axis=0)
    return level, np.maximum(pool * scatter**2, _MIN_VARIANCE)


def pooled_contrast(level: Float64, variance: Float64, cell_m: float) -> Float64:
    """Compute the contrast (rows, places) over noise of faint lines, averaged over _POOL_M."""
    pool = round(_POOL_M / cell_m) | 1
    mean = ndimage.uniform_filter1d(level, pool, axis=1)
    return np.asarray(np.abs(mean) / np.sqrt(variance / pool), np.float64)


def level_along(gray: Float32, cell_m: float) -> Float64:
    """Compute the log gray levels (rows, places) minus their running median along the bar, divided by the
    bar's own scatter; NaN counts as the bar's median.
    """
    level = np.log(gray + 2.0)
    known = np.isfinite(level).sum(axis=0)
    # NaN sorts last.
    middle = np.take_along_axis(np.sort(level, axis=0), np.maximum(known - 1, 0)[None] // 2, axis=0)
    level = np.where(np.isfinite(level), level, np.nan_to_num(middle))
    around = 2 * round(_AROUND_M / cell_m / 2) + 1
    off = level - running_median(level, around)
    return np.asarray(off / np.maximum(mad_sigma(np.abs(off), axis=0), _MIN_SIGMA_LOG), np.float64)


def split_columns(
    contrast: Float64, narrowest: int, gullies: Bool, cliffs: Bool
) -> list[tuple[int, int, Int64]]:
    """Split the places into stretches that share their straps: (first, one past the last, rows of its
    straps).

    Each row whose mean contrast exceeds _TOOTH adds its sum to a stretch's gain. contrast: (rows, places);
    gullies, cliffs: (places,).
    """
    spread = np.arange(contrast.shape[1] + 1, dtype=np.float64)
    prices = _prices(gullies, _PRICE, _GULLY_PRICE)
    return _split(_sums(contrast[1::2]), spread, prices, narrowest, cliffs, is_faint=False)


def split_faint(
    level: Float64, variance: Float64, narrowest: int, gullies: Bool, cliffs: Bool
) -> list[tuple[int, int, Int64]]:
    """Split the places as `split_columns` does, by lines that only stand out over a stretch's whole width.

    Each row whose sum exceeds _FAINT standard deviations adds half the excess of its square to a stretch's
    gain. level, variance: of `faint_lines`.
    """
    prices = _prices(gullies, _FAINT_PRICE, _FAINT_GULLY_PRICE)
    spread = _sums(variance[None])[:, 0].copy()
    return _split(_sums(level[1::2]), spread, prices, narrowest, cliffs, is_faint=True)


def _sums(values: Float64) -> Float64:
    """Compute cumulative sums along rows (places + 1, rows)."""
    return np.concatenate([np.zeros((1, len(values))), np.cumsum(values, axis=1).T])


def _prices(gullies: Bool, price: float, gully_price: float) -> Float64:
    """Return the cost of a stretch by its end (places + 1,): lower in a gully, and at the last place."""
    cheap = np.pad(gullies, (0, 1), constant_values=True)
    cheap[1:] |= gullies
    return np.where(cheap, gully_price, price)


def _split(
    sums: Float64, spread: Float64, prices: Float64, narrowest: int, cliffs: Bool, *, is_faint: bool
) -> list[tuple[int, int, Int64]]:
    """Find by dynamic programming the stretches with the largest total gain; none extends across a cliff.

    Each is (first, one past the last, rows with locally maximal gain). sums: (places + 1, rows) of every
    other row; spread: (places + 1,) cumulative widths of the places.
    """
    before = _best_stretches(sums, spread, prices, narrowest, cliffs, is_faint)
    found, last = [], len(prices) - 1
    while last > 0:
        first = int(before[last])
        own = row_gains(sums[first], sums[last], spread[last] - spread[first], is_faint)
        peak = (own == ndimage.maximum_filter1d(own, 5)) & (own > 0)
        if last - first >= narrowest and peak.any():
            found.append((first, last, 2 * np.flatnonzero(peak) + 1))
        last = first
    return found[::-1]


@kernel()
def _best_stretches(
    sums: Float64, spread: Float64, prices: Float64, narrowest: int, cliffs: Bool, is_faint: bool
) -> Int64:
    """Find the first place of the best stretch that ends at each place (places + 1,).

    sums: (places + 1, rows), spread, prices: (places + 1,), cliffs: (places,), see `_split`.
    """
    places = len(prices) - 1
    best, before = np.zeros(places + 1), np.zeros(places + 1, np.int64)
    begin = 0
    for last in range(1, places + 1):
        if last > 1 and cliffs[last - 2]:
            begin = last - 1
        best[last] = -np.inf
        for first in range(begin, last):
            total = best[first] - prices[last]
            if last - first >= narrowest:
                gains = row_gains(sums[first], sums[last], spread[last] - spread[first], is_faint)
                total = best[first] + gains.sum() - prices[last]
            if total > best[last]:
                best[last], before[last] = total, first
    return before


@kernel()
def row_gains(begin: Float64, end: Float64, wide: float, is_faint: bool) -> Float64:
    """Compute the gain of a stretch from each row (rows,): see `split_columns`, and `split_faint` if
    is_faint.

    begin, end: (rows,) cumulative sums at its first and last place. wide: number of places, or the sum of
    their variances if is_faint.
    """
    gains = np.empty(begin.size)
    for k in range(begin.size):
        own = end[k] - begin[k]
        if is_faint:
            gains[k] = max(own * own / wide - _FAINT**2, 0.0) / 2
        else:
            gains[k] = own if own > _TOOTH * wide else 0.0
    return gains


def find_gullies(level_m: Float64, cell_m: float) -> Bool:
    """Check at which places (N,) the surface sinks by GULLY_M between two sides, or isn't seen."""
    seen = np.nan_to_num(level_m, nan=-FLOOR_M, neginf=-FLOOR_M)
    reach = round(_GULLY_SIDE_M / cell_m)
    before = np.array([seen[max(k - reach, 0) : k + 1].max() for k in range(len(seen))])
    behind = np.array([seen[k : k + reach + 1].max() for k in range(len(seen))])
    return np.asarray(np.minimum(before, behind) - seen > GULLY_M)


def find_cliffs(level_m: Float64) -> Bool:
    """Check at which places (N,) the surface steps by CLIFF_M, in sight or across places out of sight."""
    last_seen = np.maximum.accumulate(np.where(np.isnan(level_m), 0, np.arange(len(level_m))))
    filled = np.nan_to_num(level_m[last_seen], nan=-FLOOR_M, neginf=-FLOOR_M)
    step = np.zeros(len(filled), bool)
    step[:-_CLIFF_CELLS] = np.abs(filled[_CLIFF_CELLS:] - filled[:-_CLIFF_CELLS]) > CLIFF_M
    return step
