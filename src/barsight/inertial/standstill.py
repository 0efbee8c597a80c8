"""Detect standstill, and estimate gravity's direction and the gyro's bias from it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import binary_opening, uniform_filter1d

from barsight.calibration.geometry.imu_noise import ImuNoise
from barsight.core.arrays import Bool, Float64
from barsight.core.errors import Failed
from barsight.core.records.sensor_samples import ImuSamples
from barsight.core.stamps import NS_PER_S
from barsight.inertial.model import GRAVITY_MPS2, ImuBias

WINDOW_S = 0.6
MIN_S = 1.0
"""Minimum duration of a standstill: a shorter stretch without change is a turning point of the sway."""
MAX_EXCESS = 1.4
"""Maximum ratio of the deviation over a window to the sensor's own noise at standstill."""
MAX_DRIFT_SIGMAS = 5.0
STRENGTH_RANGE_MPS2 = (8.0, 12.0)


@dataclass(frozen=True, eq=False)
class RestEstimate:
    """Gravity and gyro bias of a body at rest.

    up_in_body: (3,) unit vector against gravity. An accelerometer bias perpendicular to it can't be told from
    a tilt (5 mm/s^2 are 0.03 degrees), so bias.accel_mps2 holds only the part along it. gyro_sigma_radps,
    tilt_sigma_rad: due to noise alone. seconds: duration of the rest.
    """

    up_in_body: Float64
    bias: ImuBias
    gyro_sigma_radps: float
    tilt_sigma_rad: float
    seconds: float


def stands_still(imu: ImuSamples, noise: ImuNoise) -> Bool:
    """Detect rest: the samples (N,) around which, over 0.6 s, both sensors vary no more than by their own
    noise; stretches under a second are left out.

    Constant speed looks the same to an IMU: the caller must know that the body didn't travel (from a crane's
    encoders, or because the recording starts before the motion).
    """
    count = imu.stamp_ns.size
    if count < 8:
        return np.zeros(count, dtype=np.bool_)
    rate_hz = NS_PER_S / float(np.median(np.diff(imu.stamp_ns)))
    size = max(8, round(WINDOW_S * rate_hz))
    index = np.arange(count)
    still: Bool = np.ones(count, dtype=np.bool_)
    for values, density in ((imu.gyro_radps, noise.gyro_density), (imu.accel_mps2, noise.accel_density)):
        sigma = density * np.sqrt(rate_hz)
        mean = uniform_filter1d(values, size, axis=0, mode="nearest")
        square = uniform_filter1d((values - mean) ** 2, size, axis=0, mode="nearest")
        still &= np.sqrt(square.mean(axis=1)) < MAX_EXCESS * sigma
        half = uniform_filter1d(values, size // 2, axis=0, mode="nearest")
        drift = np.abs(
            half[np.minimum(index + size // 4, count - 1)] - half[np.maximum(index - size // 4, 0)]
        )
        still &= drift.max(axis=1) < MAX_DRIFT_SIGMAS * sigma * np.sqrt(4 / size)
    least = np.ones(round(MIN_S * rate_hz), dtype=np.bool_)
    opened: Bool = binary_opening(np.pad(still, size, mode="edge"), least)[size:-size]
    return opened


def estimate_at_rest(imu: ImuSamples, first_ns: int, last_ns: int, noise: ImuNoise) -> RestEstimate | Failed:
    """Average gravity and the gyro's bias over the samples in [first_ns, last_ns].

    Failed `imu-units` where the accelerometer's strength is not gravity's (the reason names g where that
    fits), `not-still` where the body moves or the interval is shorter than 0.2 s or holds fewer than 8
    samples.
    """
    begin, end = np.searchsorted(imu.stamp_ns, (first_ns, last_ns + 1))
    part = ImuSamples(imu.stamp_ns[begin:end], imu.gyro_radps[begin:end], imu.accel_mps2[begin:end])
    seconds = (last_ns - first_ns) / NS_PER_S
    if part.stamp_ns.size < 8 or seconds < 0.2:
        return Failed("not-still", f"only {part.stamp_ns.size} samples to start from")
    mean = part.accel_mps2.mean(axis=0)
    strength = float(np.linalg.norm(mean))
    if not STRENGTH_RANGE_MPS2[0] < strength < STRENGTH_RANGE_MPS2[1]:
        unit = " (is it in g?)" if 0.8 < strength < 1.2 else ""
        return Failed("imu-units", f"the accelerometer shows {strength:.2f} m/s^2 at the start{unit}")
    share = float(stands_still(part, noise).mean())
    if share < 0.8:
        return Failed("not-still", f"the body moves in {100 * (1 - share):.0f} % of the {seconds:.1f} s")
    up = mean / strength
    root = float(np.sqrt(seconds))
    return RestEstimate(
        up,
        ImuBias(part.gyro_radps.mean(axis=0), (strength - GRAVITY_MPS2) * up),
        noise.gyro_density / root,
        noise.accel_density / root / GRAVITY_MPS2,
        seconds,
    )
