"""Extend a fitted outline from a short piece to the whole bundle."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from barsight.core.arrays import Float32, Float64, UInt8, kernel
from barsight.yard.bundles.fitting.gauss_newton import Heights
from barsight.yard.bundles.fitting.outline import STEP_M, make_outline
from barsight.yard.bundles.fitting.outline_fit import (
    ABOVE,
    AGREES,
    BELOW,
    DIAMETER,
    MIXED,
    ROLL,
    SLOPE_U,
    Fit,
    refine_outline,
)
from barsight.yard.bundles.fitting.rotated_map import AlignedMap
from barsight.yard.bundles.fitting.settings import BundleSettings

_AGREE_RATIO = 0.55
_KNOWN_RATIO = 0.3
_MAX_ABOVE_M = 0.8
_MAX_BELOW_M = 0.04
_MAX_MIXED_M = 0.2
_MAX_UNKNOWN_M = 0.6


def extend_rows(grid: AlignedMap, fit: Fit, settings: BundleSettings, reach_m: float) -> Fit | None:
    """Extend the fit's rows as far as the outline follows the map, at most reach_m beyond either end."""
    outline = make_outline(
        fit.rings, float(fit.values[DIAMETER]), float(fit.values[ROLL]), settings.smoothing_m
    )
    more = int(reach_m / grid.cell_m)
    bounds = max(fit.first - more, 0), min(fit.last + more, grid.z_m.shape[0] - 1)
    heights = Heights(grid.z_m, grid.sigma_m, grid.u0_m, grid.v0_m, grid.cell_m, *bounds, 1, fit.v_m)
    state, gain = _row_states(
        heights, fit.values, outline.seen_m, outline.slope, outline.reach_m, settings.agreement_m
    )
    runs = np.array([_MAX_UNKNOWN_M, 0.0, _MAX_ABOVE_M, _MAX_BELOW_M, _MAX_MIXED_M]) / grid.cell_m
    agreeing = np.flatnonzero(state[fit.first : fit.last + 1] == AGREES)
    if agreeing.size < 0.5 * (fit.last + 1 - fit.first):
        return None
    low = _walk(state, fit.first + int(agreeing[0]), -1, bounds[0], runs)
    high = _walk(state, fit.first + int(agreeing[-1]), 1, bounds[1], runs)
    gain[:low] = 0
    gain[high + 1 :] = 0
    return replace(fit, first=low, last=high, state=state, gain=gain)


@kernel()
def _walk(state: UInt8, start: int, step: int, limit: int, runs: Float64) -> int:
    """Find the last agreeing row before too many rows of one other state have been passed.

    state: (rows,), of `_row_states`. start, step, limit: row to begin with, 1 or -1, last row. runs: (5,)
    maximum number of rows of each state after the last agreeing one.
    """
    last = start
    waiting = np.zeros(5)
    row = start
    while row != limit:
        row += step
        if state[row] == AGREES:
            last = row
            waiting[:] = 0
            continue
        waiting[state[row]] += 1
        if (waiting > runs).any():
            break
    return last


@kernel()
def _row_states(
    heights: Heights, values: Float64, seen: Float64, slope: Float64, reach: float, agreement: float
) -> tuple[UInt8, Float32]:
    """Classify each row and count the cells that it explains, over the parts of the outline that aren't
    steep.

    values: (6,) of the fit. seen, slope: of the outline at -reach ... reach, m. agreement: m. Returns state
    and gain of all the grid's rows, 0 outside of first ... last.
    """
    z, cell, u0 = heights.z_m, heights.cell_m, heights.u0_m
    rows, columns = z.shape
    state, gain = np.zeros(rows, np.uint8), np.zeros(rows, np.float32)
    cosine = 1.0 / np.sqrt(1.0 + values[1] * values[1])
    size = seen.size
    for j in range(heights.first, heights.last + 1):
        along = heights.v0_m + cell * j - heights.v_m
        u = values[0] + values[1] * along
        base = values[2] + values[3] * along
        low = int(np.ceil((u - reach / cosine - u0) / cell))
        high = int((u + reach / cosine - u0) / cell)
        count = known = agree = above = below = 0
        total = 0.0
        for i in range(low, high + 1):
            k = int(((u0 + cell * i - u) * cosine + reach) / STEP_M + 0.5)
            if k < 0 or k >= size or seen[k] != seen[k] or not abs(slope[k]) < 2.0:
                continue
            count += 1
            if i < 0 or i >= columns or z[j, i] != z[j, i]:
                continue
            known += 1
            r = z[j, i] - base - seen[k]
            total += max(1.0 - (r / agreement) ** 2, -1.0)
            if abs(r) <= agreement:
                agree += 1
            elif r > 0:
                above += 1
            else:
                below += 1
        if known < _KNOWN_RATIO * count or known == 0:
            continue
        if agree >= _AGREE_RATIO * known:
            state[j] = AGREES
            gain[j] = total
        elif above > below and above >= 0.4 * known:
            state[j] = ABOVE
        elif below >= 0.4 * known:
            state[j] = BELOW
        else:
            state[j] = MIXED
    return state, gain


def grow_outline(grid: AlignedMap, seed: Fit, settings: BundleSettings) -> Fit | None:
    """Grow a short piece to the whole bundle: fit and extend in turn until neither end moves."""
    fit = refine_outline(grid, seed, settings, steps=8, gate_m=3 * settings.agreement_m)
    if fit is None:
        return None
    reach = 0.4
    limit = np.tan(np.radians(settings.max_skew_deg) * 1.5)
    for _ in range(12):
        longer = extend_rows(grid, fit, settings, reach)
        if longer is None:
            return None
        settled = longer.first == fit.first and longer.last == fit.last
        refined = refine_outline(grid, longer, settings, steps=6 if settled else 3)
        if refined is None or abs(refined.values[SLOPE_U]) > limit:
            return None
        fit = refined
        if settled and reach >= grid.z_m.shape[0] * grid.cell_m:
            return extend_rows(grid, fit, settings, 0.05)
        reach = reach * 2 if not settled else np.inf if reach > 1.5 else reach * 2
        reach = min(reach, grid.z_m.shape[0] * grid.cell_m)
    return extend_rows(grid, fit, settings, 0.05)
