"""Single bars: which of a bundle's bars are seen from above, and where each of them lies."""

from __future__ import annotations

import numpy as np

from barsight.core.arrays import Float64, Int64
from barsight.yard.bundle_fit import AGREES, DIAMETER, ROLL, SLOPE_U, SLOPE_Z, Fit, Found
from barsight.yard.bundle_settings import BundleSettings
from barsight.yard.outline import STEP_M, highest_bars, turned_hexagon
from barsight.yard.sheet import Sheet
from barsight.yard.types import Bar

_SEEN_SHARE = 0.3
_RESOLVED_CELLS = 3.0
_ROWS = 300
_STEPS = 5
_STEEPEST = 0.85


def visible_bars(fit: Fit) -> Int64:
    """Numbers of the packing's bars of which at least 30 % of the diameter is seen from straight above."""
    return np.flatnonzero(_seen_share(fit) >= _SEEN_SHARE)


def _seen_share(fit: Fit) -> Float64:
    axes = turned_hexagon(fit.rings, float(fit.values[DIAMETER]), float(fit.values[ROLL]))
    u = np.arange(-fit.width_m / 2, fit.width_m / 2, STEP_M)
    highest, _ = highest_bars(axes, fit.values[DIAMETER] / 2, u)
    counts = np.bincount(highest[highest >= 0], minlength=len(axes))
    share: Float64 = counts * STEP_M / fit.values[DIAMETER]
    return share


def fit_bars(found: Found, settings: BundleSettings) -> tuple[Bar, ...]:
    """A cylinder for each bar seen from above; none where neither heights nor pictures resolve them.

    Place, height, yaw and pitch of each axis come from the heights where that bar is highest, by least
    squares from the bundle's outline on; the diameter is the bundle's, with its uncertainty. Bars thinner
    than three cells lie as the packing says that the pictures show.
    """
    sheet, fit = found.sheet, found.fit
    diameter = float(fit.values[DIAMETER])
    if diameter < _RESOLVED_CELLS * sheet.cell_m and found.shades is None:
        return ()
    rows = np.flatnonzero(fit.state == AGREES)
    rows = rows[(rows >= fit.first) & (rows <= fit.last)]
    rows = rows[:: 1 + rows.size // _ROWS]
    v = sheet.v0_m + sheet.cell_m * rows - fit.v_m
    middle = fit.values[0] + fit.values[SLOPE_U] * v
    reach = int(np.ceil(fit.width_m / 2 / sheet.cell_m)) + 1
    first = np.rint((middle - sheet.u0_m) / sheet.cell_m).astype(int) - reach
    columns = first[:, None] + np.arange(2 * reach + 1)
    inside = (columns >= 0) & (columns < sheet.z_m.shape[1])
    clipped = columns.clip(0, sheet.z_m.shape[1] - 1)
    z = np.where(inside, sheet.z_m[rows[:, None], clipped], np.nan)
    u = sheet.u0_m + sheet.cell_m * columns - middle[:, None]
    r = z - fit.values[2] - (fit.values[SLOPE_Z] * v)[:, None]
    axes = turned_hexagon(fit.rings, diameter, float(fit.values[ROLL]))
    highest, _ = highest_bars(axes, diameter / 2, u.ravel())
    level = np.abs(u.ravel() - axes[highest, 0]) < _STEEPEST * diameter / 2
    usable = level & (highest >= 0) & np.isfinite(r.ravel())
    along = np.broadcast_to(v[:, None], u.shape).ravel()
    bars = []
    for number in visible_bars(fit):
        mine = usable & (highest == number)
        if mine.sum() >= 50:
            points = np.stack([u.ravel()[mine], along[mine], r.ravel()[mine]])
            bars.append(_cylinder(points, axes[number], sheet, fit, settings))
    return tuple(bars)


def _cylinder(points: Float64, axis: Float64, sheet: Sheet, fit: Fit, settings: BundleSettings) -> Bar:
    """Least squares of one bar's upper side. points: (3, N) sideways of the bundle's axis, along, up."""
    radius = float(fit.values[DIAMETER]) / 2
    u, v, z = points
    half = max(float(np.ptp(v)) / 2, 0.1)
    figures = np.array([axis[0], axis[1], 0.0, 0.0])
    prior = 1 / np.array([0.01, 0.01, 0.01 / half, 0.01 / half]) ** 2
    start = figures.copy()
    spread = max(fit.rms_m, 0.002)
    normal = np.diag(prior)
    for _ in range(_STEPS):
        beside = u - figures[0] - figures[2] * v
        rise = np.sqrt(np.maximum(radius**2 - beside**2, (0.3 * radius) ** 2))
        misfit = z - figures[1] - figures[3] * v - rise
        weight = np.maximum(1 - (misfit / (4 * spread)) ** 2, 0) ** 2 / spread**2
        slope = beside / rise
        jacobian = np.stack([slope, np.ones_like(u), slope * v, v])
        alike = settings.correlated_along_m * settings.correlated_across_m / sheet.cell_m**2
        weight = weight / alike * max(1.0, float(np.ptp(v)) / sheet.cell_m / np.unique(v).size)
        normal = (jacobian * weight) @ jacobian.T + np.diag(prior)
        figures = figures + np.linalg.solve(normal, (jacobian * weight) @ misfit + prior * (start - figures))
    covariance: Float64 = np.asarray(np.linalg.inv(normal), dtype=np.float64)
    return _bar(figures, covariance, v, sheet, fit, settings)


def _bar(
    figures: Float64, covariance: Float64, v: Float64, sheet: Sheet, fit: Fit, settings: BundleSettings
) -> Bar:
    centre_v = fit.v_m + float(v.min() + v.max()) / 2
    along = centre_v - fit.v_m
    u, z = fit.at(centre_v)
    place = sheet.to_map(np.array([[u + figures[0] + figures[2] * along, centre_v]]))[0]
    slope = np.array([fit.values[SLOPE_U] + figures[2], fit.values[SLOPE_Z] + figures[3]])
    flat = sheet.to_map(np.array([[slope[0], 1.0]]))[0]
    direction = np.append(flat, slope[1])
    direction = direction / np.linalg.norm(direction)
    if direction[1] < 0:
        direction = -direction
    whole = np.zeros((5, 5))
    carry = np.eye(4)
    carry[0, 2] = carry[1, 3] = along
    whole[:4, :4] = carry @ covariance @ carry.T
    whole[0, 0] += settings.shared_lateral_m**2
    whole[1, 1] += (settings.shared_height_share * fit.sigma_m) ** 2
    whole[4, 4] = fit.covariance[DIAMETER, DIAMETER]
    return Bar(
        centre_m=np.append(place, z + figures[1] + figures[3] * along),
        direction=direction,
        diameter_m=float(fit.values[DIAMETER]),
        length_m=float(np.ptp(v)),
        covariance=whole,
    )
