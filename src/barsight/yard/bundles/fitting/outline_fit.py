"""Fit a bundle's outline to the map's heights along its whole length."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from barsight.core.arrays import Float32, Float64, UInt8
from barsight.yard.bundles.fitting.gauss_newton import Heights, Rules, fit_outline
from barsight.yard.bundles.fitting.outline import (
    BARS_OF_RINGS,
    TRIANGLE,
    TRIANGLE_BARS_M,
    bundle_width,
    make_outline,
    packing_axes,
)
from barsight.yard.bundles.fitting.rotated_map import AlignedMap
from barsight.yard.bundles.fitting.settings import BundleSettings

U, SLOPE_U, Z, SLOPE_Z, ROLL, DIAMETER = range(6)
"""Indices of a fit's parameters: lateral place and its slope, axis height and its slope, roll, diameter."""
UNKNOWN, AGREES, ABOVE, BELOW, MIXED = range(5)
"""States of a row of the map compared with a bundle's outline."""
_ROWS_ENOUGH = 150
"""Number of rows beyond which more only cost time, since errors of neighbouring rows are correlated."""
_HALF_STEPS = 3
"""Number of Gauss-Newton steps from the whole bundle's outline to that of a half."""


@dataclass(frozen=True, eq=False)
class Fit:
    """An outline that follows the map from row `first` to row `last` of its grid.

    values: (6,) at v_m, see U ... DIAMETER; covariance: (6, 6). state: (rows,) of the whole grid. gain:
    (rows,) cells explained, 0 where the row doesn't agree. rms_m: weighted RMS of the heights' residuals.
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
        """Return the number of bars in the packing."""
        return BARS_OF_RINGS[self.rings]

    @property
    def width_m(self) -> float:
        """Return the diameter of the circle around all bars."""
        return bundle_width(self.rings, self.values[DIAMETER])

    def at(self, v_m: float) -> tuple[float, float]:
        """Compute the lateral place and the height of the axis at v_m."""
        along = v_m - self.v_m
        return self.values[U] + self.values[SLOPE_U] * along, self.values[Z] + self.values[SLOPE_Z] * along


@dataclass(frozen=True, eq=False)
class ShadeProfile:
    """Logarithms of gray levels (N,) at lateral places (N,) from a bundle's axis: medians along the bars."""

    places_m: Float64
    levels: Float64


@dataclass(frozen=True, eq=False)
class FittedOutline:
    """A fitted outline and the grid that its parameters refer to.

    shades: gray levels across its bars, where they settle the packing. doubt: rings of another packing that
    the gray levels favour, where they don't settle it.
    """

    grid: AlignedMap
    fit: Fit
    shades: ShadeProfile | None = None
    doubt: int | None = None


def refine_outline(
    grid: AlignedMap,
    start: Fit,
    settings: BundleSettings,
    steps: int = 20,
    gate_m: float | None = None,
    common: tuple[float, float] | None = None,
) -> Fit | None:
    """Refine a fit by Gauss-Newton over rows first ... last; None where the outline leaves the map or
    degenerates.

    The weight of a height falls with its sigma, with the outline's slope (its lateral position is uncertain)
    and, by Tukey's biweight, with the ratio of its residual to `gate_m`. common: diameter known from
    elsewhere, and its sigma.
    """
    rows = (max(start.first, 0), min(start.last, grid.z_m.shape[0] - 1))
    v_m = grid.v0_m + grid.cell_m * (rows[0] + rows[1]) / 2
    values = start.values.copy()
    values[U], values[Z] = start.at(v_m)
    free = np.ones(6, bool)
    free[ROLL] = start.rings > 0
    if settings.catalogue_mm:
        free[DIAMETER] = False
    half = (rows[1] - rows[0]) * grid.cell_m / 2
    free[SLOPE_U] = free[SLOPE_Z] = half > 2 * settings.slice_m
    stride = 1 + (rows[1] - rows[0]) // _ROWS_ENOUGH
    alike = settings.correlated_along_m * settings.correlated_across_m / grid.cell_m**2 / stride
    width_ratio = bundle_width(start.rings, 1.0)
    narrowest = settings.min_width_m if start.rings else settings.min_single_diameter_m
    widths_m = 0.8 * narrowest, 1.2 * settings.max_width_m
    if start.rings == TRIANGLE:
        least, most = (bundle_width(TRIANGLE, diameter_m) for diameter_m in TRIANGLE_BARS_M)
        widths_m = max(widths_m[0], 0.8 * least), min(widths_m[1], 1.2 * most)
    held, values, normal, moments, alike = fit_outline(
        Heights(
            grid.z_m, grid.sigma_m, grid.u0_m, grid.v0_m, grid.cell_m, rows[0], rows[1], stride, v_m
        ),
        values,
        Rules(
            packing_axes(start.rings), width_ratio, free, steps, float(gate_m or 2 * settings.agreement_m),
            settings.placing_m, settings.smoothing_m, alike, common or (0.0, np.inf),
            widths_m,
        ),
    )  # fmt: skip
    if not held:
        return None
    covariance = np.zeros((6, 6))
    covariance[np.ix_(free, free)] = alike * np.linalg.inv(normal[np.ix_(free, free)])
    rms, sigma = float(np.sqrt(moments[2] / moments[1])), float(np.sqrt(moments[0] / moments[1]))
    return replace(
        start, v_m=v_m, values=values, covariance=covariance, first=rows[0], last=rows[1], rms_m=rms,
        sigma_m=sigma,
    )  # fmt: skip


def compare_halves(one: FittedOutline, settings: BundleSettings) -> tuple[float, float]:
    """Fit the halves of a bundle separately. Return the difference of their slopes, which is 4 b / L for bars
    of length L that bow by b, and how far the mean of both slopes is off the whole bundle's.

    If a half can't be fitted alone, the bars may bow by as much as heights may differ and still agree.
    """
    fit, middle = one.fit, (one.fit.first + one.fit.last) // 2
    finer = replace(settings, slice_m=settings.slice_m / 2)
    slopes = [
        float(half.values[SLOPE_U])
        for first, last in ((fit.first, middle), (middle + 1, fit.last))
        if (half := refine_outline(one.grid, replace(fit, first=first, last=last), finer, _HALF_STEPS))
    ]
    if len(slopes) < 2:
        return 4 * settings.agreement_m / (one.grid.cell_m * (fit.last - fit.first + 1)), 0.0
    return abs(slopes[1] - slopes[0]), abs(sum(slopes) / 2 - float(fit.values[SLOPE_U]))


def widen_fit(fit: Fit, settings: BundleSettings) -> Fit:
    """Add the error of the width due to the map's smoothing: it moves the axis, but not the top.

    For a single bar, half of it goes to the top: its highlight is measured as far back as its flanks grow.
    """
    share = settings.packing_error_ratio if fit.rings else settings.single_error_ratio
    top_m = float(np.nanmax(make_outline(fit.rings, fit.values[DIAMETER], fit.values[ROLL], 0.0).exact_m))
    change = np.zeros(6)
    change[DIAMETER], change[Z] = share * fit.values[DIAMETER], -share * top_m * (1.0 if fit.rings else 0.5)
    return replace(fit, covariance=fit.covariance + np.outer(change, change))
