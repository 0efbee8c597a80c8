"""Find cameras whose stamps are late or early against all other sensors.

The estimate has the encoders' latency as an unknown, but takes cameras and IMU as being on one clock. The
encoders tell the offset of the two: the delay with which their readings fit the pictures' steps, less that
with which they fit the IMU's motion, whatever their own latency is.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.arrays import Float64
from barsight.core.records.sensor_samples import CraneSamples
from barsight.core.stamps import NS_PER_S, interpolate_at, seconds_to_ns
from barsight.motion.crane.encoder_delay import DelaySearch, FittedDelay, fit_delay
from barsight.motion.crane.known_motion import SeenSteps
from barsight.motion.frontend.seen_steps import seen_steps
from barsight.motion.frontend.sightings import Sighting

LATE_S: Float64 = np.array(np.arange(-15, 16) * 0.02, np.float64)
"""Delays of the readings against the pictures that are tried, s."""
MIN_STEPS = 12
NEAREST_RATIO = 0.9
"""Share of the steps, those that fit best, by which a delay is judged."""
MAX_OFFSET_S, OFFSET_SIGMAS, MIN_SIGMA_S = 0.03, 4.0, 0.005
"""Maximum offset of the cameras' clock, s and in sigma, and the minimum of that sigma."""


def camera_doubts(
    sightings: Sequence[Sighting], rectifier: Rectifier, shift_ns: int, crane: CraneSamples | None,
    search: DelaySearch,
) -> tuple[str, ...]:  # fmt: skip
    """Describe an offset of the cameras' stamps against encoders and IMU. crane: the readings in which
    `search` looked for a delay, without their faults.
    """
    numbers = [k for k in range(1, len(sightings)) if sightings[k].motion is not None]
    if crane is None or len(crane.stamp_ns) < 2 or len(numbers) < MIN_STEPS:
        return ()
    by_pictures = delay_by_pictures(seen_steps(sightings, numbers, rectifier, shift_ns), crane)
    by_imu = search.fitted
    if by_pictures is None or by_imu is None:
        return ()
    offset_s = by_imu.late_s - by_pictures.late_s - crane.late_ns / NS_PER_S
    sigma_s = float(np.linalg.norm([by_imu.sigma_s, by_pictures.sigma_s, MIN_SIGMA_S]))
    if abs(offset_s) < max(MAX_OFFSET_S, OFFSET_SIGMAS * sigma_s):
        return ()
    return (
        f"the cameras' stamps are {1e3 * abs(offset_s):.0f} ms {'late' if offset_s > 0 else 'early'} against "
        f"encoders and IMU (1 sigma {1e3 * sigma_s:.0f} ms): put all sensors on one clock, and check "
        "timeshift_cam_imu",
    )


def delay_by_pictures(steps: SeenSteps, crane: CraneSamples) -> FittedDelay | None:
    """Estimate the delay with which the readings fit the pictures' steps best, whatever scale and attitude
    these have; None where too few steps are covered, or none is best.
    """
    stamps = np.stack([steps.old_ns, steps.new_ns])
    way = steps.way_m @ crane.yard_from_body_nominal.T

    def read(late_s: float) -> Float64:
        old, new = (
            interpolate_at(at + seconds_to_ns(late_s), crane.stamp_ns, crane.position_m) for at in stamps
        )
        return np.asarray(new - old)

    tried = [read(late_s) for late_s in LATE_S.tolist()]
    covered = np.isfinite(np.array(tried)).all(axis=(0, 2))
    count = int(NEAREST_RATIO * np.count_nonzero(covered))
    if count < MIN_STEPS:
        return None
    squares = []
    for one in tried:
        off = way[covered] - one[covered] @ (np.linalg.pinv(one[covered]) @ way[covered])
        squares.append(float(np.sort((off**2).sum(axis=1))[:count].mean()))
    return fit_delay(LATE_S, np.array(squares), count)
