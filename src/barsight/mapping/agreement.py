"""Compare a contour with a laser profile as two measuring methods, neither of which is the truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from barsight.core.arrays import Bool, Float64
from barsight.core.errors import Failed
from barsight.core.linalg.robust import SIGMAS_95
from barsight.core.records.heights import Agreement, Contour, HeightSource
from barsight.core.records.sensor_samples import LaserProfile
from barsight.mapping.agreement_intervals import agreement_intervals

JUMP_M = 0.03
"""Minimum height difference (m) of neighbours that are on two surfaces: a step, not a slope."""
_FURTHEST_M, _MIN_SHARED = 0.06, 50
"""Maximum shift (m) of a profile along x, and minimum number of points that are compared at a shift."""


def profile_difference(contour: Contour, laser: LaserProfile) -> Float64:
    """Subtract the laser from vision (m) at each laser point (N,); NaN where vision has no measurement."""
    return _at_laser(contour, contour.z_m, laser) - laser.z_m


def _at_laser(contour: Contour, values: Float64, laser: LaserProfile) -> Float64:
    """Interpolate values (M,) of a contour's samples at the laser's points (N,), between measured samples
    only.
    """
    if contour.x_m.size == 0:
        return np.full(laser.x_m.shape, np.nan)
    measured = np.where(contour.source == HeightSource.VISION, values, np.nan)
    spacing = contour.x_m[1] - contour.x_m[0] if contour.x_m.size > 1 else 0.01
    place = (laser.x_m - contour.x_m[0]) / spacing
    before = np.floor(place + 1e-3).astype(np.int64)
    share = np.clip(place - before, 0, 1)
    inside = (before >= 0) & (before < measured.size)
    k = before.clip(0, measured.size - 1)
    following = np.append(measured[1:], np.nan)
    on_sample = share < 2e-3
    value = np.where(on_sample, measured[k], measured[k] * (1 - share) + following[k] * share)
    return np.where(inside, value, np.nan)


def smooth_places(z_m: Float64, reach: int = 2) -> Bool:
    """Mark smooth places along the last axis: samples with no neighbour within `reach` samples that is
    more than 30 mm higher or lower.
    """
    broken = np.zeros(z_m.shape, dtype=np.bool_)
    for k in range(1, reach + 1):
        jump = np.abs(z_m[..., k:] - z_m[..., :-k]) > JUMP_M
        broken[..., k:] |= jump
        broken[..., :-k] |= jump
    return ~broken


def profile_shift(contour: Contour, laser: LaserProfile) -> tuple[float, float]:
    """Register the laser's profile along x and z, m: find the shift with the smallest median absolute
    difference, to a fifth of a millimetre in x. NaN where fewer than 50 points can be compared.

    The median over all points isn't pulled by steps seen from another side, nor by gullies.
    """
    best, found = np.inf, (np.nan, np.nan)
    reach, step = _FURTHEST_M, 2e-3
    centre = 0.0
    for _ in range(2):
        for shift in centre + np.arange(-reach, reach + step / 2, step):
            error = profile_difference(contour, replace(laser, x_m=laser.x_m - shift))
            error = error[np.isfinite(error)]
            if error.size < _MIN_SHARED:
                continue
            above = -float(np.median(error))
            cost = float(np.median(np.abs(error + above)))
            if cost < best:
                best, found = cost, (float(shift), above)
        if not np.isfinite(best):
            break
        centre, reach, step = found[0], 2e-3, 2e-4
    return found


def compute_agreement(
    contour: Contour, laser: LaserProfile, speed_mps: float = float("nan")
) -> Agreement | Failed:
    """Compute bias, limits of agreement [Bland 1986], median, MAE, RMSE, P95, maximum and coverage of the
    laser's points.

    Returns Failed `no-overlap` where fewer than two points can be compared.
    """
    error = profile_difference(contour, laser)
    compared = error[np.isfinite(error)] * 1e3
    if compared.size < 2:
        return Failed(
            "no-overlap",
            f"profile {laser.profile}: {compared.size} of {error.size} laser points were measured by vision",
        )
    bias, spread = float(compared.mean()), float(compared.std(ddof=1))
    size = np.abs(compared)
    level = smooth_places(laser.z_m)
    smooth = np.abs(error[np.isfinite(error) & level]) * 1e3
    intervals = agreement_intervals(
        error, laser.z_m, _at_laser(contour, contour.sigma_m, laser), laser.range_std_m, level
    )
    x_shift, z_shift = profile_shift(contour, laser)
    return Agreement(
        profile=laser.profile,
        y_m=float(np.median(laser.y_m)),
        samples=int(compared.size),
        coverage_pct=100 * compared.size / error.size,
        bias_mm=bias,
        median_mm=float(np.median(size)),
        mae_mm=float(size.mean()),
        smooth_mae_mm=float(smooth.mean()) if smooth.size else float("nan"),
        rmse_mm=float(np.sqrt((compared**2).mean())),
        p95_mm=float(np.percentile(size, 95)),
        max_mm=float(size.max()),
        loa_low_mm=bias - SIGMAS_95 * spread,
        loa_high_mm=bias + SIGMAS_95 * spread,
        x_shift_mm=1e3 * x_shift,
        z_shift_mm=1e3 * z_shift,
        time_shift_s=x_shift / speed_mps if speed_mps else float("nan"),
        **vars(intervals),
    )
