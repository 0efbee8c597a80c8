"""Estimate the rig's drift in the batch: a yaw between the cameras and a scale.

A point seen from several positions on a known path has a depth without stereo. The disparity that this
depth implies, compared with the measured one, shows the yaw (px nearly the same everywhere) and the scale (px
proportional to the disparity).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from barsight.core.arrays import Float64
from barsight.core.records.trajectory import RigDrift
from barsight.motion.problem.problem import Problem, StereoObservations

HUBER_SIGMAS = 2.2
"""Threshold of Huber's loss for the length of three whitened numbers, which 19 % exceed; 1.345 is for one."""
LOOSE = (0.02, 0.2)
"""Standard deviations (rad, ratio) of priors that only keep the system solvable; the real ones are applied
afterwards.
"""
SERVICE_RAD = float(np.deg2rad(0.2))
"""Prior standard deviation of a camera's turn in service, used where encoders can show it."""
MATCHING_BIAS_PX = 0.015
"""Disparity error that matching causes everywhere alike (1 sigma), whatever the calibration."""
COMMON_BIAS_PX = 0.01
"""Part of it that all pieces of the yard share, used where each piece's own part is an unknown."""


def drift_jacobian(seen: StereoObservations) -> Float64:
    """Differentiate the right columns (N, 2) px by the rig's yaw (rad) and scale ratio."""
    camera = seen.camera
    x = (seen.stereo[:, 2] - camera.doffs_px - camera.cx_px) / camera.focal_px
    disparity = seen.stereo[:, 0] - seen.stereo[:, 2] + camera.doffs_px
    return np.column_stack([-camera.focal_px * (1 + x**2), -disparity])


def combine_with_prior(theta: Float64, covariance: Float64, problem: Problem) -> RigDrift:
    """Combine the observed drift with the calibration's prior.

    Matching has a bias common to all points, and glossy bars show another one for nearer points: both pass
    for drift (`_floor`). Where the pieces' disparity biases are unknowns, only their common part does.
    Without encoders a yaw as large as the calibration's own sigma does too, since rectification errors vary
    over the picture, and near points lie low in it and far ones high.
    """
    seen = problem.sightings
    assert seen is not None
    focal, baseline = seen.camera.focal_px, seen.camera.baseline_m
    disparity = seen.stereo[:, 0] - seen.stereo[:, 2] + seen.camera.doffs_px
    prior, floor = drift_prior(problem), drift_floor(problem)
    if not problem.has_latency:
        floor[0, 0] += prior[0] ** 2
    yaw, scale, combined = _weighed(np.eye(2), theta, covariance + floor, prior)
    range_m = focal * baseline / float(np.median(disparity))
    return RigDrift(yaw, scale, combined, prior, baseline, range_m, bool(problem.has_latency))


def drift_prior(problem: Problem) -> Float64:
    """Return the prior standard deviations (2,) of yaw (rad) and scale."""
    seen = problem.sightings
    assert seen is not None
    yaw = SERVICE_RAD if problem.has_latency else problem.offset_prior_px / seen.camera.focal_px
    return np.array([yaw, problem.scale_prior])


def drift_floor(problem: Problem) -> Float64:
    """Compute the covariance (2, 2) of yaw and scale that matching biases add to what sightings show."""
    seen = problem.sightings
    assert seen is not None
    disparity = seen.stereo[:, 0] - seen.stereo[:, 2] + seen.camera.doffs_px
    everywhere_px, near_px = MATCHING_BIAS_PX, MATCHING_BIAS_PX
    if problem.pieces is not None:
        everywhere_px, near_px = COMMON_BIAS_PX, 0.0
    return _floor(disparity, seen.camera.focal_px, everywhere_px, near_px)


def with_matching_bias(drift: RigDrift, problem: Problem) -> RigDrift:
    """Add the full matching bias to the reported covariance of the drift: people judge heights by it, and the
    disparity biases of single pieces falsify those too.
    """
    seen = problem.sightings
    if problem.pieces is None or seen is None:
        return drift
    disparity = seen.stereo[:, 0] - seen.stereo[:, 2] + seen.camera.doffs_px
    own_px = float(np.sqrt(MATCHING_BIAS_PX**2 - COMMON_BIAS_PX**2))
    floor = _floor(disparity, seen.camera.focal_px, own_px, MATCHING_BIAS_PX)
    rows, values, variance = drift.by_travel()
    yaw, scale, combined = _weighed(
        rows, values, np.diag(variance) + rows @ floor @ rows.T, drift.prior_sigma
    )
    return replace(drift, yaw_rad=yaw, scale=scale, covariance=combined)


def _weighed(
    rows: Float64, values: Float64, covariance: Float64, prior_sigma: Float64
) -> tuple[float, float, Float64]:
    """Estimate yaw, scale and their covariance (2, 2) from observed values of rows (K, 2) of them, with the
    values' covariance (K, K) and the prior's sigmas (2,).
    """
    information = rows.T @ np.linalg.inv(covariance)
    combined = np.linalg.inv(information @ rows + np.diag(prior_sigma**-2.0)).astype(np.float64)
    yaw, scale = combined @ information @ values
    return float(yaw), float(scale), combined


def _floor(disparity: Float64, focal_px: float, everywhere_px: float, near_px: float) -> Float64:
    """Compute the covariance floor (2, 2) of yaw and scale from two matching biases: one at the mean
    disparity, another over the disparities' spread.
    """
    per_px = near_px / max(float(disparity.std()), 1e-3)
    by = np.array([[-1 / focal_px, float(disparity.mean()) / focal_px], [0.0, -1.0]])
    floor: Float64 = by @ np.diag([everywhere_px**2, per_px**2]) @ by.T
    return floor
