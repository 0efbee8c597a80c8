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
_STEEPEST = 4.0
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
class OutlineTables:
    """(4, N) outline by sideways place, STEP_M apart: height, slope, change by roll and by diameter."""

    reach_m: float
    rows: Float64


def outline_tables(rings: int, values: Float64, settings: BundleSettings) -> OutlineTables:
    diameter, roll = float(values[DIAMETER]), float(values[ROLL])
    middle = make_outline(rings, diameter, roll, settings.smoothing_m)
    rolled = make_outline(rings, diameter, roll + _ROLL_STEP_RAD, settings.smoothing_m)
    grown = make_outline(rings, diameter * (1 + _DIAMETER_STEP), roll, settings.smoothing_m)
    by_roll = (_fit_to(rolled.seen_m, middle.seen_m.size) - middle.seen_m) / _ROLL_STEP_RAD
    by_diameter = (_fit_to(grown.seen_m, middle.seen_m.size) - middle.seen_m) / (diameter * _DIAMETER_STEP)
    return OutlineTables(middle.reach_m, np.stack([middle.seen_m, middle.slope, by_roll, by_diameter]))


def _fit_to(row: Float64, size: int) -> Float64:
    """The middle `size` entries of an odd-sized row, NaN where it is shorter."""
    change = (size - row.size) // 2
    if change >= 0:
        return np.pad(row, change, constant_values=np.nan)
    return row[-change : row.size + change]


def refine(
    sheet: Sheet,
    start: Fit,
    settings: BundleSettings,
    steps: int = 6,
    gate_m: float | None = None,
    common: tuple[float, float] | None = None,
) -> Fit | None:
    """Gauss-Newton over the rows first ... last; None where the outline leaves the map or degenerates.

    The weight of a height falls with its sigma, with the outline's slope (it may lie beside its place) and,
    by Tukey's biweight, with its misfit over `gate_m`. common: diameter and sigma known from elsewhere.
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
    alike = alike_rows = settings.correlated_along_m * settings.correlated_across_m / sheet.cell_m**2 / stride
    normal, moments = np.eye(6), np.zeros(4)
    for _ in range(steps):
        tables = outline_tables(start.rings, values, settings)
        normal, right, moments = _normal_equations(
            sheet.z_m, sheet.sigma_m, sheet.u0_m, sheet.v0_m, sheet.cell_m, rows[0], rows[1], stride, v_m,
            values, tables.rows, tables.reach_m, gate, settings.placing_m,
        )  # fmt: skip
        if moments[0] < 30:
            return None
        alike = alike_rows * max(1.0, moments[2] / moments[0])
        if common is not None:
            normal[DIAMETER, DIAMETER] += alike / common[1] ** 2
            right[DIAMETER] += alike * (common[0] - values[DIAMETER]) / common[1] ** 2
        normal += np.diag(_prior(values, half))
        change = np.zeros(6)
        change[free] = np.linalg.solve(normal[np.ix_(free, free)], right[free])
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
    covariance[np.ix_(free, free)] = alike * np.linalg.inv(normal[np.ix_(free, free)])
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
            if abs(slope) > _STEEPEST or not (
                h == h and slope == slope and by_roll == by_roll and by_diameter == by_diameter
            ):
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
