"""Register the world to the yard by crane moves: visual trajectory against encoders."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from barsight.core.arrays import Float64
from barsight.core.errors import Failed
from barsight.core.pose import nearest_rotation
from barsight.core.records.sensor_samples import CraneSamples
from barsight.core.records.trajectory import Trajectory
from barsight.core.stamps import NS_PER_S, seconds_to_ns
from barsight.motion.crane.encoder_trajectory import fit_position
from barsight.registration.rigid import design_rows
from barsight.registration.yard import YardCalibration, calibrate_yard

WINDOW_S = 0.35
MIN_FRAMES, MAX_FRAMES = 8, 300
FADES = 8
RATIOS = tuple(2.0**k for k in range(-4, 9, 2))
"""Ratios to try of the correlated errors' variance to that of each position's own error."""


@dataclass(frozen=True, eq=False)
class MovedYard:
    """calibration: yard_from_world. yard_from_body: (3, 3) mean attitude of the rig over the frames."""

    calibration: YardCalibration
    yard_from_body: Float64


def yard_from_moves(trajectory: Trajectory, crane: CraneSamples, shift_ns: int) -> MovedYard | Failed:
    """Align a trajectory in `world` with the encoders' positions of the body.

    Odometry drifts, so the errors of neighbours are correlated: see `error_correlation`. At most `MAX_FRAMES`
    evenly spaced positions are used. Failed `few-points`, and `roll` where the crane moved along one axis
    only.
    """
    seen, counted, stamps_ns = [], [], []
    for frame in trajectory.frames[:: -(-len(trajectory.frames) // MAX_FRAMES)]:
        fit = fit_position(crane, frame.stamp_ns + shift_ns, seconds_to_ns(WINDOW_S))
        if not isinstance(fit, Failed):
            stamps_ns.append(frame.stamp_ns)
            seen.append(frame.reference_from_body.translation)
            counted.append(fit.position_m + crane.crane_to_body_m)
    if len(seen) < MIN_FRAMES:
        return Failed("few-points", f"only {len(seen)} frames have a place by pictures and by encoders")
    measured, yard = np.array(seen), np.array(counted)
    names = tuple(str(k) for k in range(len(seen)))
    free = np.zeros(len(seen), np.bool_)
    found = calibrate_yard(names, measured, yard, None, free, "world")
    if isinstance(found, Failed):
        if found.code != "collinear":
            return found
        return Failed(
            "roll", f"the crane moved along one axis only: the roll about it can't be seen ({found.reason}); "
            "move bridge and trolley in one recording",
        )  # fmt: skip
    stamps = np.array(stamps_ns, np.int64)
    together = error_correlation(measured, found, (stamps - stamps[0]) / NS_PER_S)
    found = calibrate_yard(names, measured, yard, together, free, "world")
    assert not isinstance(found, Failed)
    attitude = np.mean([frame.reference_from_body.rotation for frame in trajectory.frames], axis=0)
    return MovedYard(found, nearest_rotation(found.alignment.target_from_source.rotation @ attitude))


def error_correlation(measured: Float64, found: YardCalibration, time_s: Float64) -> Float64:
    """Model the covariance (N, N) m2 of the errors of positions (N, 3), the same on each axis.

    Each position has an independent error and one whose correlation fades with time, as odometry drifts. Both
    sizes and the fading time are those under which the residuals are likely once the fit has taken up its six
    unknowns [restricted likelihood: Patterson and Thompson 1971]. All candidates are averaged by their
    likelihood, since a short path hardly tells a slow drift from an error of the alignment.
    """
    design = design_rows((measured - measured.mean(axis=0)) @ found.alignment.target_from_source.rotation.T)
    free = measured.size - 6
    apart_s = np.abs(time_s[:, None] - time_s)
    likelihood, covariance = [], []
    for fade_s in np.geomspace(np.median(np.diff(time_s)), time_s[-1] / 3, FADES):
        alike = np.exp(-apart_s / fade_s)
        for ratio in (0.0, *RATIOS):
            spread = np.eye(len(time_s)) + ratio * alike
            factor = np.linalg.cholesky(spread)
            rows = solve_triangular(factor, design.reshape(len(time_s), -1), lower=True).reshape(-1, 6)
            off = solve_triangular(factor, found.off_m, lower=True).ravel()
            normal = rows.T @ rows
            pull = rows.T @ off
            power = float(off @ off - pull @ np.linalg.solve(normal, pull)) / free
            whole = 6 * np.log(np.diag(factor)).sum() + np.linalg.slogdet(normal)[1] + free * np.log(power)
            # No correlated errors are taken to be as likely as all ratios together.
            likelihood.append(-whole / 2 + (np.log(len(RATIOS)) if ratio == 0 else 0.0))
            covariance.append(power * spread)
    weight = np.exp(np.array(likelihood) - max(likelihood))
    together: Float64 = np.tensordot(weight / weight.sum(), np.array(covariance), 1)
    return together
