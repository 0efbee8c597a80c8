"""The yard from crane moves: the way as the cameras saw it against the way as the encoders counted it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from barsight.core.arrays import Float64
from barsight.core.errors import Failed
from barsight.core.stamps import seconds_to_ns
from barsight.core.types import CraneSamples, Trajectory
from barsight.motion.crane import fit_position
from barsight.registration.yard import YardCalibration, calibrate_yard

WINDOW_S = 0.35
LEAST_FRAMES = 8


@dataclass(frozen=True, eq=False)
class MovedYard:
    """calibration: yard_from_world. yard_from_body: (3, 3) how the rig hangs, mean over the frames."""

    calibration: YardCalibration
    yard_from_body: Float64


def yard_from_moves(trajectory: Trajectory, crane: CraneSamples, shift_ns: int) -> MovedYard | Failed:
    """Align a trajectory in `world` with the encoders' places of the body.

    Odometry drifts, so neighbouring residuals are alike and count as fewer (`_times_alike`). Failed
    `few-points`, and `roll` where the crane moved along one axis only.
    """
    seen, counted = [], []
    for frame in trajectory.frames:
        fit = fit_position(crane, frame.stamp_ns + shift_ns, seconds_to_ns(WINDOW_S))
        if not isinstance(fit, Failed):
            seen.append(frame.reference_from_body.translation)
            counted.append(fit.position_m + crane.crane_to_body_m)
    if len(seen) < LEAST_FRAMES:
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
    share = 1 / _times_alike(found.off_m)
    found = calibrate_yard(names, measured, yard, None, free, "world", share)
    assert not isinstance(found, Failed)
    attitude = np.mean([frame.reference_from_body.rotation for frame in trajectory.frames], axis=0)
    u, _, vt = np.linalg.svd(found.alignment.target_from_source.rotation @ attitude)
    return MovedYard(found, np.asarray(u @ vt))


def _times_alike(off: Float64) -> float:
    """How many neighbouring residuals (N, 3) stand for one: 1 + 2 (r1 + r2 + ...), r the autocorrelations up
    to the first that is none [Geyer 1992], each raised by what the fit of six unknowns takes off.
    """
    count = len(off)
    alike = 1.0
    for lag in range(1, count // 3):
        pairs = count / (count - lag)
        correlation = pairs * float((off[lag:] * off[:-lag]).sum() / (off**2).sum()) + 2 / count
        if correlation < 2 / (3 * (count - lag)) ** 0.5:
            break
        alike += 2 * correlation
    return alike
