"""Run the compiled Gauss-Newton iterations that fit a bundle's outline to the heights."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from barsight.core.arrays import Bool, Float32, Float64, kernel
from barsight.yard.bundles.fitting.outline import STEP_M, trace_with_changes

Four = tuple[float, float, float, float]

_ROLL, _DIAMETER = 4, 5
_RIM_M = 0.008
_STEEPEST = 4.5
_MIN_HEIGHTS = 30
_STILL_M = 1e-5
_MIN_SCATTER = 0.04
"""Lower bound of the ratio of observed to stated variance by which the covariance is scaled."""


class Heights(NamedTuple):
    """Heights and sigmas of the grid (rows, columns), and the rows that are used: first, last and stride.

    v_m: place along the bars to which the parameters refer.
    """

    z_m: Float32
    sigma_m: Float32
    u0_m: float
    v0_m: float
    cell_m: float
    first: int
    last: int
    stride: int
    v_m: float


class Rules(NamedTuple):
    """Rules of a fit.

    packing: (bars, 2), see `packing_axes`. free: (6,), the parameters to be estimated. widths_m: minimum and
    maximum. alike: number of heights that share one error. common_m: diameter known from elsewhere and its
    sigma, which is infinite where none is known.
    """

    packing: Float64
    width_ratio: float
    free: Bool
    steps: int
    gate_m: float
    placing_m: float
    smoothing_m: float
    alike: float
    common_m: tuple[float, float]
    widths_m: tuple[float, float]


@kernel()
def fit_outline(
    heights: Heights, start: Float64, rules: Rules
) -> tuple[bool, Float64, Float64, Float64, float]:
    """Fit an outline. Return success, parameters (6,), J'WJ with priors (6, 6), (count, sum w, chi squared),
    and the number of heights that share one error, scaled by the observed variance.

    The fit fails where fewer than 30 heights are left or the width leaves its bounds.
    """
    values, alike = start.copy(), rules.alike
    normal, moments = np.eye(6), np.zeros(3)
    half = (heights.last - heights.first) * heights.cell_m / 2
    before, damping = np.zeros(6), 1.0
    for _ in range(rules.steps):
        tables = trace_with_changes(rules.packing, values[_DIAMETER], values[_ROLL], rules.smoothing_m)
        normal, right, moments = _normal_equations(heights, values, tables, rules.gate_m, rules.placing_m)
        if moments[0] < _MIN_HEIGHTS:
            return False, values, normal, moments, alike
        # A height's sigma includes errors that all heights share; only the actual scatter averages out.
        alike = rules.alike * max(_MIN_SCATTER, moments[2] / moments[0])
        weight = alike / rules.common_m[1] ** 2
        normal[_DIAMETER, _DIAMETER] += weight
        right[_DIAMETER] += weight * (rules.common_m[0] - values[_DIAMETER])
        _hold(normal, values[_DIAMETER], half)
        change = _step(normal, right, rules.free)
        change[_ROLL] = min(max(change[_ROLL], -0.1), 0.1)
        if rules.free[_DIAMETER]:
            most = 0.05 * values[_DIAMETER]
            change[_DIAMETER] = min(max(change[_DIAMETER], -most), most + 1e-3)
        # A step that turns back was too long: without damping, many fits oscillate by millimetres forever.
        if before @ normal @ change < 0:
            damping /= 2
        before, change = change, damping * change
        values += change
        width = values[_DIAMETER] * rules.width_ratio
        if not rules.widths_m[0] < width < rules.widths_m[1]:
            return False, values, normal, moments, alike
        if max(abs(change[0]), abs(change[_DIAMETER]), abs(change[1]) * half) < _STILL_M:
            break
    return True, values, normal, moments, alike


@kernel()
def _hold(normal: Float64, diameter: float, half: float) -> None:
    """Add weak priors that keep steps small where the map doesn't determine a parameter.

    normal: (6, 6), added to. diameter: m. half: half the length of the rows, m.
    """
    slope = 0.1 / max(half, 0.1)
    sigmas = (0.05, slope, 0.05, slope, 0.3, 0.1 * diameter)
    for k in range(6):
        normal[k, k] += 1.0 / sigmas[k] ** 2


@kernel()
def _step(normal: Float64, right: Float64, free: Bool) -> Float64:
    """Solve for the step of the free parameters; that of the others is 0.

    normal: (6, 6). right, free: (6,). Returns (6,).
    """
    table, wanted = normal.copy(), right.copy()
    for k in range(6):
        if not free[k]:
            table[k, :] = 0.0
            table[:, k] = 0.0
            table[k, k] = 1.0
            wanted[k] = 0.0
    found, change = np.linalg.solve(table, wanted), np.empty(6)
    for k in range(6):
        change[k] = found[k]
    return change


@kernel()
def _normal_equations(
    heights: Heights, values: Float64, tables: Float64, gate: float, placing: float
) -> tuple[Float64, Float64, Float64]:
    """Form J'WJ (6, 6), J'Wr (6,) and (count, sum w, chi squared) of the heights under the outline.

    Within a row, the derivatives by the two slopes are those by the places times the distance along the bars,
    so four sums per row yield all six parameters.
    """
    normal, right = np.zeros((6, 6)), np.zeros(6)
    count = weight = chi2 = 0.0
    cell, columns, size = heights.cell_m, heights.z_m.shape[1], tables.shape[1]
    cosine = 1.0 / np.sqrt(1.0 + values[1] * values[1])
    reach = size // 2 * STEP_M
    inner = (reach - _RIM_M) / cosine
    for j in range(heights.first, heights.last + 1, heights.stride):
        along = heights.v0_m + cell * j - heights.v_m
        u = values[0] + values[1] * along - heights.u0_m
        # Scalars stay in registers; array elements would be stored and loaded for each height.
        uu = uz = ur = ud = zz = zr = zd = rr = rd = dd = 0.0
        side_u = side_z = side_r = side_d = 0.0
        first = max(int(np.ceil((u - inner) / cell - 0.5)), 0)
        for i in range(first, min(int(np.floor((u + inner) / cell + 0.5)), columns - 1) + 1):
            z = heights.z_m[j, i]
            place = ((cell * i - u) * cosine + reach) / STEP_M
            k = int(place)
            if z != z or k < 0 or k + 1 >= size:
                continue
            share = place - k
            h = tables[0, k] * (1 - share) + tables[0, k + 1] * share
            slope = tables[1, k] * (1 - share) + tables[1, k + 1] * share
            roll = tables[2, k] * (1 - share) + tables[2, k + 1] * share
            diameter = tables[3, k] * (1 - share) + tables[3, k + 1] * share
            r = z - values[2] - values[3] * along - h
            if not (abs(r) < gate and abs(slope) < _STEEPEST and roll == roll and diameter == diameter):
                continue
            # If weights jumped as a cell enters or leaves, the steps would oscillate about the jump.
            within = min((inner - abs(cell * i - u)) / cell + 0.5, 1.0) * min(_STEEPEST - abs(slope), 1.0)
            tukey = within * (1 - (r / gate) ** 2) ** 2
            w = tukey / (heights.sigma_m[j, i] ** 2 + (slope * placing) ** 2)
            sideways = -slope * cosine
            w_u, w_r, w_d = w * sideways, w * roll, w * diameter
            side_u, side_z = side_u + w_u * r, side_z + w * r
            side_r, side_d = side_r + w_r * r, side_d + w_d * r
            uu, uz, ur, ud = uu + w_u * sideways, uz + w_u, ur + w_u * roll, ud + w_u * diameter
            zz, zr, zd = zz + w, zr + w_r, zd + w_d
            rr, rd, dd = rr + w_r * roll, rd + w_r * diameter, dd + w_d * diameter
            count += tukey
            weight += w
            chi2 += w * r * r
        part = ((uu, uz, ur, ud), (uz, zz, zr, zd), (ur, zr, rr, rd), (ud, zd, rd, dd))
        _add_row(normal, right, part, (side_u, side_z, side_r, side_d), along)
    return normal, right, np.array([count, weight, chi2])


@kernel()
def _add_row(
    normal: Float64, right: Float64, part: tuple[Four, Four, Four, Four], side: Four, along: float
) -> None:
    """Expand a row's sums over place, height, roll and diameter to the six parameters U ... DIAMETER.

    part: (4, 4) and side: (4,), the row's sums. along: distance of the row from the middle, m. Added to:
    normal (6, 6), right (6,).
    """
    source = (0, 0, 1, 1, 2, 3)
    times = (1.0, along, 1.0, along, 1.0, 1.0)
    for a in range(6):
        right[a] += times[a] * side[source[a]]
        for b in range(6):
            normal[a, b] += times[a] * times[b] * part[source[a]][source[b]]
