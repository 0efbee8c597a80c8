"""Locate single bars: which bars of a bundle are seen from above, and where they are."""

from __future__ import annotations

import numpy as np

from barsight.core.arrays import Float64, Int64
from barsight.yard.bundles.fitting.outline import STEP_M, highest_bars, turned_packing
from barsight.yard.bundles.fitting.outline_fit import (
    AGREES,
    DIAMETER,
    ROLL,
    SLOPE_U,
    SLOPE_Z,
    Fit,
    FittedOutline,
    U,
    Z,
)
from barsight.yard.bundles.fitting.settings import BundleSettings
from barsight.yard.types import Bar

_SEEN_RATIO = 0.3
_RESOLVED_CELLS = 3.0
_LOOSE_M = 0.001
"""Standard deviation (m) of a bar's distance from its place in the packing."""


def visible_bars(fit: Fit) -> Int64:
    """Select the bars of the packing of which at least 30 % of the diameter is seen from straight above."""
    diameter = float(fit.values[DIAMETER])
    axes = turned_packing(fit.rings, diameter, float(fit.values[ROLL]))
    highest, _ = highest_bars(axes, diameter / 2, np.arange(-fit.width_m / 2, fit.width_m / 2, STEP_M))
    counts = np.bincount(highest[highest >= 0], minlength=len(axes))
    return np.flatnonzero(counts * STEP_M >= _SEEN_RATIO * diameter)


def fit_bars(found: FittedOutline, settings: BundleSettings) -> tuple[Bar, ...]:
    """Derive a cylinder for each bar seen from above; none where neither heights nor photo resolve the bars.

    The bundle's fit is a joint fit of all its cylinders: each bar's parameters and their covariance follow
    from the bundle's place, slopes, roll and diameter. Fitted one by one, bars are off by 4 mm, because the
    heights are smoothed.
    """
    grid, fit = found.grid, found.fit
    diameter = float(fit.values[DIAMETER])
    if diameter < _RESOLVED_CELLS * grid.cell_m and found.shades is None:
        return ()
    rows = np.flatnonzero(fit.state == AGREES)
    rows = rows[(rows >= fit.first) & (rows <= fit.last)]
    if rows.size == 0:
        return ()
    ends = grid.v0_m + grid.cell_m * rows[[0, -1]]
    middle = float(ends.mean())
    u, z = fit.at(middle)
    axes = turned_packing(fit.rings, diameter, float(fit.values[ROLL]))
    flat = grid.to_map(np.array([[fit.values[SLOPE_U], 1.0]]))[0]
    direction = np.append(flat, fit.values[SLOPE_Z])
    direction = direction / np.linalg.norm(direction) * (1.0 if flat[1] >= 0 else -1.0)
    return tuple(
        Bar(
            centre_m=np.append(grid.to_map(np.array([[u + side, middle]]))[0], z + up),
            direction=direction,
            diameter_m=diameter,
            length_m=float(np.ptp(ends)),
            covariance=_covariance(fit, middle - fit.v_m, side, up, settings),
        )
        for side, up in axes[visible_bars(fit)]
    )


def _covariance(fit: Fit, along: float, side: float, up: float, settings: BundleSettings) -> Float64:
    """Compute the covariance (5, 5) of a bar's lateral place, height, yaw, pitch and diameter."""
    change = np.zeros((5, 6))
    change[0, [U, SLOPE_U, ROLL, DIAMETER]] = 1.0, along, -up, side / fit.values[DIAMETER]
    change[1, [Z, SLOPE_Z, ROLL, DIAMETER]] = 1.0, along, side, up / fit.values[DIAMETER]
    change[2, SLOPE_U] = change[3, SLOPE_Z] = change[4, DIAMETER] = 1.0
    own = [settings.shared_lateral_m**2 + _LOOSE_M**2, settings.shared_height_m**2 + _LOOSE_M**2, 0, 0, 0]
    covariance: Float64 = change @ fit.covariance @ change.T + np.diag(own)
    return covariance
