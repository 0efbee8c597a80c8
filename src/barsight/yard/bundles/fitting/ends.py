"""Find the ends of a bundle, and whether each one was seen."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from barsight.core.arrays import Bool, Float64, Int64
from barsight.core.linalg.robust import nan_medians
from barsight.yard.bundles.fitting.bars import visible_bars
from barsight.yard.bundles.fitting.outline import STEP_M, make_outline
from barsight.yard.bundles.fitting.outline_fit import DIAMETER, ROLL, SLOPE_U, SLOPE_Z, Fit
from barsight.yard.bundles.fitting.rotated_map import AlignedMap
from barsight.yard.bundles.fitting.settings import BundleSettings
from barsight.yard.map_lookup import nearest_cells
from barsight.yard.types import HeightMap

_LOOK_M = 1.3
_PROOF_M, _EDGE_PROOF_M = 0.1, 0.05
"""Length (m) beyond an end over which the surface must lie deep; the same where nothing is known further on,
as at the pictures' edge.
"""
_RAGGED_M = 0.2
_SOME, _MAX_VALUE = 0.3, 0.6
_DEEP_RATIO = 0.5
"""Minimum depth of the surface under the outline, in widths, from which the bundle has ended."""
_GROWTH_M = 0.015
"""Distance (m) by which the map extends a bundle beyond its true end. The matching window, not the size of
the cells, determines it.
"""
_SEEN_SIGMA_M, _SEEN_CELLS, _SEEN_SIGMAS = 0.0053, 12**-0.5, 1.0
"""Standard deviation of an end's place where all bars end flush: a constant part (m), the rounding to whole
cells, and a multiple of the heights' sigma, which rises with the size of the pixels.
"""
_UNEVEN_SIGMAS, _RAGGED_RATIO = 2.0, 0.35
"""Parts of an end's sigma: factor on the sigma that follows from the spread of the visible bars' ends, since
hidden ones may end elsewhere; fraction of the length over which the surface goes on a little lower.
"""
_BLURRED_M, _UNSEEN_RATIO = 0.06, 0.5
"""Length (m) beyond a bundle's last row, before _EDGE_PROOF_M in all are proven deep, of which nothing is
known at a seen end; part of an end's sigma, as a fraction of what exceeds it: the bars may go on there.
"""
_UNEVEN_M = (-0.15, 0.2)
_ENDS_M = 0.03
_QUARTILES = 1.349
"""Distance between the quartiles of a normal distribution, in standard deviations."""
_ALIKE = 0.6
"""Correlation of the outward errors of a bundle's two ends: what moves one outwards moves the other too."""


@dataclass(frozen=True)
class End:
    """An end of a bundle at v_m along its grid.

    sigma_m, and flush_sigma_m for bars that certainly end flush, are NaN where the end is open; `why` then
    gives the reason. is_covered: something higher lies there. shows_gap: the surface sinks deep behind the
    open end, but not far enough to prove it.
    """

    v_m: float
    sigma_m: float
    is_open: bool
    why: str = ""
    flush_sigma_m: float = np.nan
    is_covered: bool = False
    shows_gap: bool = False


def find_end(grid: AlignedMap, fit: Fit, step: int, settings: BundleSettings, heights: HeightMap) -> End:
    """Find the end at the fit's first (step -1) or last row (step 1).

    The end is seen where, for 0.1 m beyond it and over most of the bundle's width, the surface lies below the
    outline by more than half the bundle's height, or lines of sight passed as low: no bar is in their way.
    Since the bars end unevenly, the end is put a quarter of the way from the last row that agrees to the last
    one that is only a little lower, less what a map grows over ends.
    """
    row = fit.first if step < 0 else fit.last
    deep = -_DEEP_RATIO * fit.width_m
    known, misfit = _beyond(grid, fit, row, step, settings, heights)
    cell = grid.cell_m
    v = grid.v0_m + cell * (row + step / 2)
    ragged = lower = clear = unseen = 0
    for k in range(known.size):
        if known[k] < _SOME:
            continue
        if misfit[k] > 2 * settings.agreement_m:
            return _open_end(v, "something higher lies there", lower, is_covered=True)
        if misfit[k] > deep:
            ragged, clear = k + 1, 0
            if ragged * cell > _RAGGED_M:
                return _open_end(v, "the surface goes on at about its height", lower)
        elif known[k] >= _MAX_VALUE:
            lower, clear = lower + 1, clear + 1
            if clear * cell <= _EDGE_PROOF_M:
                unseen = k + 1 - ragged - clear
            if lower * cell >= _PROOF_M:
                break
    if lower * cell < _PROOF_M and clear * cell < _EDGE_PROOF_M:
        return _open_end(v, "the map doesn't show what lies beyond", lower)
    spread = ragged * cell
    uneven = _unevenness(grid, fit, row, step, settings)
    hidden = _UNSEEN_RATIO * max(unseen * cell - _BLURRED_M, 0.0)
    flush = math.hypot(_SEEN_SIGMA_M, _SEEN_CELLS * cell, _SEEN_SIGMAS * fit.sigma_m, hidden)
    sigma = math.hypot(flush, _RAGGED_RATIO * spread, _UNEVEN_SIGMAS * uneven)
    return End(v + step * (spread / 4 - _GROWTH_M), sigma, is_open=False, flush_sigma_m=flush)


def _open_end(v_m: float, why: str, lower: int, *, is_covered: bool = False) -> End:
    """Make an end that wasn't seen. lower: number of rows beyond it in which the surface lies deep."""
    return End(v_m, float("nan"), True, why, is_covered=is_covered, shows_gap=lower > 0)


def gap_rows(grid: AlignedMap, fit: Fit, settings: BundleSettings) -> int:
    """Count the rows between a bundle's ends in which most of its width is seen to lie deep."""
    over = _over(grid, fit, np.arange(fit.first, fit.last + 1), settings)
    over = over[np.isfinite(over).mean(axis=1) >= _MAX_VALUE]
    return int((nan_medians(over.T) <= -_DEEP_RATIO * fit.width_m).sum()) if len(over) else 0


def lost_rows(grid: AlignedMap, fit: Fit, settings: BundleSettings) -> Bool:
    """Mark the rows between a bundle's ends (rows,) in which its surface isn't seen to go on: too little of
    the width is known, or what is known lies deep.
    """
    over = _over(grid, fit, np.arange(fit.first, fit.last + 1), settings)
    known = np.isfinite(over).mean(axis=1)
    lost = known < _SOME
    lost[known > 0] |= nan_medians(over[known > 0].T) <= -_DEEP_RATIO * fit.width_m
    return np.asarray(lost, np.bool_)


def middle_and_length_sigma(ends_sigma_m: tuple[float, float]) -> tuple[float, float]:
    """Propagate the sigmas of both ends, whose outward errors correlate, to the middle and the length."""
    squares, alike = (
        ends_sigma_m[0] ** 2 + ends_sigma_m[1] ** 2,
        2 * _ALIKE * ends_sigma_m[0] * ends_sigma_m[1],
    )
    return float(np.sqrt(squares - alike)) / 2, float(np.sqrt(squares + alike))


def _unevenness(grid: AlignedMap, fit: Fit, row: int, step: int, settings: BundleSettings) -> float:
    """Estimate the sigma (m) of the mean end of the bars from the spread of the visible bars' ends."""
    first, last = (round(reach / grid.cell_m) for reach in _UNEVEN_M)
    rows = row + step * np.arange(first, last + 1)
    rows = rows[(rows >= 0) & (rows < grid.z_m.shape[0])]
    follows = np.abs(_over(grid, fit, rows, settings)) < _ENDS_M
    ends = rows.size - 1 - follows[::-1].argmax(axis=0)[follows.any(axis=0)]
    if ends.size == 0:
        return _RAGGED_M
    spread = grid.cell_m * float(np.subtract(*np.percentile(ends, [75, 25]))) / _QUARTILES
    return float(1.25 * spread / np.sqrt(max(len(visible_bars(fit)), 1)))


def _beyond(
    grid: AlignedMap, fit: Fit, row: int, step: int, settings: BundleSettings, heights: HeightMap
) -> tuple[Float64, Float64]:
    """Measure for each row beyond the end the known share of the outline, and the median height (m) over it.

    Where no height is known, a bound by lines of sight counts if it lies deep.
    """
    rows = row + step * np.arange(1, int(_LOOK_M / grid.cell_m) + 1)
    rows = rows[(rows >= 0) & (rows < grid.z_m.shape[0])]
    over = _over(grid, fit, rows, settings)
    if heights.free_m is not None:
        u, level = _outline_at(grid, fit, rows, settings)
        v = np.broadcast_to((grid.v0_m + grid.cell_m * rows)[:, None], u.shape)
        x, y = np.moveaxis(grid.to_map(np.stack([u, v], axis=-1).reshape(-1, 2)), -1, 0)
        column, place, inside = nearest_cells(heights, x, y)
        bound = np.where(inside, heights.free_m[place, column], np.inf).reshape(u.shape) - level
        over = np.where(np.isnan(over) & (bound <= -_DEEP_RATIO * fit.width_m), bound, over)
    known = np.isfinite(over).mean(axis=1)
    misfit = np.full(rows.size, np.nan)
    misfit[known > 0] = nan_medians(over[known > 0].T)
    return known, misfit


def _over(grid: AlignedMap, fit: Fit, rows: Int64, settings: BundleSettings) -> Float64:
    """Sample measured heights (rows, N) over the outline across most of its width; NaN where unknown."""
    u, level = _outline_at(grid, fit, rows, settings)
    columns = np.rint((u - grid.u0_m) / grid.cell_m).astype(int)
    inside = (columns >= 0) & (columns < grid.z_m.shape[1])
    z = np.where(inside, grid.z_m[rows[:, None], columns.clip(0, grid.z_m.shape[1] - 1)], np.nan)
    over: Float64 = z - level
    return over


def _outline_at(grid: AlignedMap, fit: Fit, rows: Int64, settings: BundleSettings) -> tuple[Float64, Float64]:
    """Return places u (rows, N) across most of the width, and the outline's heights (m) there."""
    outline = make_outline(
        fit.rings, float(fit.values[DIAMETER]), float(fit.values[ROLL]), settings.smoothing_m
    )
    across = np.arange(-0.4 * fit.width_m, 0.4 * fit.width_m, grid.cell_m)
    height = outline.seen_m[np.rint((across + outline.reach_m) / STEP_M).astype(int).clip(0, None)]
    along = grid.v0_m + grid.cell_m * rows - fit.v_m
    u = fit.values[0] + fit.values[SLOPE_U] * along[:, None] + across
    return u, (fit.values[2] + fit.values[SLOPE_Z] * along)[:, None] + height
