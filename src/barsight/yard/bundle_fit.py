"""A bundle's outline fitted to the map's heights along its whole length."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from barsight.core.arrays import Float32, Float64, UInt8, kernel
from barsight.yard.bundle_settings import BundleSettings
from barsight.yard.outline import BARS_OF_RINGS, STEP_M, bundle_width, make_outline
from barsight.yard.sheet import Sheet

U, SLOPE_U, Z, SLOPE_Z, ROLL, DIAMETER = range(6)
"""Figures of a fit: place across, its slope along, height of the axis, its slope, roll, bars' diameter."""
UNKNOWN, AGREES, ABOVE, BELOW, MIXED = range(5)
"""What a row of the map says of a bundle's outline."""
_ROLL_STEP_RAD = np.radians(1.0)
_DIAMETER_STEP = 0.01
_RIM_M = 0.008
_KNOWN_SHARE = 0.3
_AGREE_SHARE = 0.55
_MOST_BELOW_M = 0.04
_MOST_ABOVE_M = 0.8
_MOST_UNKNOWN_M = 0.6
_MOST_MIXED_M = 0.2
_ROWS_ENOUGH = 150
"""Neighbouring rows err alike, so more of them than this only cost time."""


@dataclass(frozen=True, eq=False)
class Fit:
    """An outline that follows the map from row `first` to row `last` of its sheet.

    values: (6,) at v_m, see U ... DIAMETER; covariance: (6, 6). state: (rows,) of the whole sheet. gain:
    (rows,) cells explained, 0 where the row doesn't agree. rms_m: of the heights about the outline.
    """

    rings: int
    v_m: float
    values: Float64
    covariance: Float64
    first: int
    last: int
    state: UInt8
    gain: Float32
    rms_m: float
    sigma_m: float

    @property
    def bars(self) -> int:
        """Bars of the packing."""
        return BARS_OF_RINGS[self.rings]

    @property
    def width_m(self) -> float:
        """Diameter of the circle around all bars."""
        return bundle_width(self.rings, self.values[DIAMETER])

    def at(self, v_m: float) -> tuple[float, float]:
        """Place across and height of the axis at v_m."""
        along = v_m - self.v_m
        return self.values[U] + self.values[SLOPE_U] * along, self.values[Z] + self.values[SLOPE_Z] * along


@dataclass(frozen=True, eq=False)
class _Tables:
    """(4, N) outline by sideways place, STEP_M apart: height, slope, change by roll and by diameter."""

    reach_m: float
    rows: Float64


def _tables(rings: int, values: Float64, settings: BundleSettings) -> _Tables:
    diameter, roll = float(values[DIAMETER]), float(values[ROLL])
    middle = make_outline(rings, diameter, roll, settings.smoothing_m)
    rolled = make_outline(rings, diameter, roll + _ROLL_STEP_RAD, settings.smoothing_m)
    grown = make_outline(rings, diameter * (1 + _DIAMETER_STEP), roll, settings.smoothing_m)
    by_roll = (_fit_to(rolled.seen_m, middle.seen_m.size) - middle.seen_m) / _ROLL_STEP_RAD
    by_diameter = (_fit_to(grown.seen_m, middle.seen_m.size) - middle.seen_m) / (diameter * _DIAMETER_STEP)
    return _Tables(middle.reach_m, np.stack([middle.seen_m, middle.slope, by_roll, by_diameter]))


def _fit_to(row: Float64, size: int) -> Float64:
    """The middle `size` entries of an odd-sized row, NaN where it is shorter."""
    change = (size - row.size) // 2
    if change >= 0:
        return np.pad(row, change, constant_values=np.nan)
    return row[-change : row.size + change]


def refine(
    sheet: Sheet, start: Fit, settings: BundleSettings, steps: int = 6, gate_m: float | None = None
) -> Fit | None:
    """Gauss-Newton over the rows first ... last; None where the outline leaves the map or degenerates.

    The weight of a height falls with its sigma, with the outline's slope (it may lie beside its place) and,
    by Tukey's biweight, with its misfit over `gate_m`.
    """
    rows = (max(start.first, 0), min(start.last, sheet.z_m.shape[0] - 1))
    v_m = sheet.v0_m + sheet.cell_m * (rows[0] + rows[1]) / 2
    values = start.values.copy()
    values[U], values[Z] = start.at(v_m)
    gate = gate_m or 2 * settings.agreement_m
    free = np.ones(6, bool)
    free[ROLL] = start.rings > 0
    if settings.catalogue_mm:
        free[DIAMETER] = False
    half = (rows[1] - rows[0]) * sheet.cell_m / 2
    free[SLOPE_U] = free[SLOPE_Z] = half > 2 * settings.slice_m
    stride = 1 + (rows[1] - rows[0]) // _ROWS_ENOUGH
    normal = np.eye(6)
    moments = np.zeros(4)
    for _ in range(steps):
        tables = _tables(start.rings, values, settings)
        normal, right, moments = _normal_equations(
            sheet.z_m, sheet.sigma_m, sheet.u0_m, sheet.v0_m, sheet.cell_m, rows[0], rows[1], stride, v_m,
            values, tables.rows, tables.reach_m, gate, settings.placing_m,
        )  # fmt: skip
        if moments[0] < 30:
            return None
        change = np.zeros(6)
        damped = normal[np.ix_(free, free)]
        damped = damped + np.diag(_prior(values, half)[free])
        change[free] = np.linalg.solve(damped, right[free])
        change[ROLL] = np.clip(change[ROLL], -0.1, 0.1)
        change[DIAMETER] = (
            np.clip(change[DIAMETER], -0.05, 0.05 * values[DIAMETER] + 1e-3) if free[5] else 0.0
        )
        change[DIAMETER] = max(change[DIAMETER], -0.05 * values[DIAMETER])
        values = values + change
        width = bundle_width(start.rings, values[DIAMETER])
        if not 0.8 * settings.least_single_m < width < 1.2 * settings.widest_m:
            return None
        if abs(change[U]) < 1e-5 and abs(change[DIAMETER]) < 1e-5 and abs(change[SLOPE_U]) * half < 1e-5:
            break
    covariance = np.zeros((6, 6))
    alike = settings.correlated_along_m * settings.correlated_across_m / sheet.cell_m**2
    misfit = moments[2] / max(moments[0], 1)
    scale = alike / stride * max(1.0, misfit)
    covariance[np.ix_(free, free)] = scale * np.linalg.inv(
        normal[np.ix_(free, free)] + np.diag(_prior(values, half)[free])
    )
    rms, sigma = float(np.sqrt(moments[3] / moments[1])), float(np.sqrt(moments[0] / moments[1]))
    return replace(
        start, v_m=v_m, values=values, covariance=covariance, first=rows[0], last=rows[1], rms_m=rms,
        sigma_m=sigma,
    )  # fmt: skip


def _prior(values: Float64, half_m: float) -> Float64:
    """What keeps a step small where the map says nothing of a figure: weak against any real evidence."""
    sigma = np.array(
        [0.05, 0.1 / max(half_m, 0.1), 0.05, 0.1 / max(half_m, 0.1), 0.3, 0.1 * values[DIAMETER]]
    )
    prior: Float64 = 1.0 / sigma**2
    return prior


@kernel()
def _normal_equations(
    z: Float32, sigma: Float32, u0: float, v0: float, cell: float, first: int, last: int, stride: int,
    v_middle: float, values: Float64, tables: Float64, reach: float, gate: float, placing: float,
) -> tuple[Float64, Float64, Float64]:  # fmt: skip
    """J'WJ (6, 6), J'Wr (6,) and (count, sum w, chi squared, sum w r^2) of the heights under the outline."""
    normal, right = np.zeros((6, 6)), np.zeros(6)
    moments = np.zeros(4)
    row = np.zeros(6)
    cosine = 1.0 / np.sqrt(1.0 + values[1] * values[1])
    columns = z.shape[1]
    size = tables.shape[1]
    inner = reach - _RIM_M
    for j in range(first, last + 1, stride):
        along = v0 + cell * j - v_middle
        u = values[0] + values[1] * along
        low = max(int(np.ceil((u - inner / cosine - u0) / cell)), 0)
        high = min(int((u + inner / cosine - u0) / cell), columns - 1)
        for i in range(low, high + 1):
            if z[j, i] != z[j, i]:
                continue
            place = ((u0 + cell * i - u) * cosine + reach) / STEP_M
            k = int(place)
            if k < 0 or k + 1 >= size:
                continue
            share = place - k
            h = tables[0, k] * (1 - share) + tables[0, k + 1] * share
            slope = tables[1, k] * (1 - share) + tables[1, k + 1] * share
            by_roll, by_diameter = tables[2, k], tables[3, k]
            if not (h == h and slope == slope and by_roll == by_roll and by_diameter == by_diameter):
                continue
            r = z[j, i] - values[2] - values[3] * along - h
            if abs(r) >= gate:
                continue
            tukey = (1 - (r / gate) ** 2) ** 2
            w = tukey / (sigma[j, i] ** 2 + (slope * placing) ** 2)
            row[0], row[1] = -slope * cosine, -slope * cosine * along
            row[2], row[3], row[4], row[5] = 1.0, along, by_roll, by_diameter
            for a in range(6):
                right[a] += w * row[a] * r
                for b in range(6):
                    normal[a, b] += w * row[a] * row[b]
            moments[0] += tukey
            moments[1] += w
            moments[2] += w * r * r
            moments[3] += w * r * r
    return normal, right, moments


def follow(sheet: Sheet, fit: Fit, settings: BundleSettings, reach_m: float) -> Fit | None:
    """How far the outline follows the map from the fit's rows on, at most reach_m further to either side."""
    tables = _tables(fit.rings, fit.values, settings)
    more = int(reach_m / sheet.cell_m)
    bounds = max(fit.first - more, 0), min(fit.last + more, sheet.z_m.shape[0] - 1)
    state, gain = _row_states(
        sheet.z_m, sheet.u0_m, sheet.v0_m, sheet.cell_m, *bounds, fit.v_m, fit.values, tables.rows,
        tables.reach_m, settings.agreement_m,
    )  # fmt: skip
    runs = np.array([_MOST_UNKNOWN_M, 0.0, _MOST_ABOVE_M, _MOST_BELOW_M, _MOST_MIXED_M]) / sheet.cell_m
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
    """The last agreeing row before a run of others gets too long for its kind."""
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
    z: Float32, u0: float, v0: float, cell: float, first: int, last: int, v_middle: float, values: Float64,
    tables: Float64, reach: float, agreement: float,
) -> tuple[UInt8, Float32]:  # fmt: skip
    """Each row's state and the cells it explains, over the parts of the outline that aren't steep."""
    rows, columns = z.shape
    state, gain = np.zeros(rows, np.uint8), np.zeros(rows, np.float32)
    cosine = 1.0 / np.sqrt(1.0 + values[1] * values[1])
    size = tables.shape[1]
    for j in range(first, last + 1):
        along = v0 + cell * j - v_middle
        u = values[0] + values[1] * along
        base = values[2] + values[3] * along
        low = int(np.ceil((u - reach / cosine - u0) / cell))
        high = int((u + reach / cosine - u0) / cell)
        count = known = agree = above = below = 0
        total = 0.0
        for i in range(low, high + 1):
            k = int(((u0 + cell * i - u) * cosine + reach) / STEP_M + 0.5)
            if k < 0 or k >= size or tables[0, k] != tables[0, k] or not abs(tables[1, k]) < 2.0:
                continue
            count += 1
            if i < 0 or i >= columns or z[j, i] != z[j, i]:
                continue
            known += 1
            r = z[j, i] - base - tables[0, k]
            total += max(1.0 - (r / agreement) ** 2, -1.0)
            if abs(r) <= agreement:
                agree += 1
            elif r > 0:
                above += 1
            else:
                below += 1
        if known < _KNOWN_SHARE * count or known == 0:
            continue
        if agree >= _AGREE_SHARE * known:
            state[j] = AGREES
            gain[j] = total
        elif above > below and above >= 0.4 * known:
            state[j] = ABOVE
        elif below >= 0.4 * known:
            state[j] = BELOW
        else:
            state[j] = MIXED
    return state, gain


def grow(sheet: Sheet, seed: Fit, settings: BundleSettings) -> Fit | None:
    """From a short piece to the whole bundle: fit, follow, fit again until both ends stand still."""
    fit = refine(sheet, seed, settings, steps=8, gate_m=3 * settings.agreement_m)
    if fit is None:
        return None
    reach = 0.4
    limit = np.tan(np.radians(settings.max_skew_deg) * 1.5)
    for _ in range(12):
        longer = follow(sheet, fit, settings, reach)
        if longer is None:
            return None
        settled = longer.first == fit.first and longer.last == fit.last
        refined = refine(sheet, longer, settings, steps=6 if settled else 3)
        if refined is None or abs(refined.values[SLOPE_U]) > limit:
            return None
        fit = refined
        if settled and reach >= sheet.z_m.shape[0] * sheet.cell_m:
            return follow(sheet, fit, settings, 0.05)
        reach = reach * 2 if not settled else np.inf if reach > 1.5 else reach * 2
        reach = min(reach, sheet.z_m.shape[0] * sheet.cell_m)
    return follow(sheet, fit, settings, 0.05)
