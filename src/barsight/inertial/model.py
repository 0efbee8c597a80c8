"""Define the IMU's measurement model and the body's state, and remove saturated samples.

The IMU measures turn rate and specific force in `body`, each with a bias that follows a random walk and white
noise: `a~ = a + b_a + n_a`, `w~ = w + b_g + n_g` [paper Eq. 9-10], where `a` is the acceleration minus
gravity. `preintegration` integrates its samples.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import binary_opening

from barsight.calibration.geometry.imu_noise import ImuNoise
from barsight.core.arrays import Float64
from barsight.core.linalg.robust import mad_sigma
from barsight.core.records.sensor_samples import ImuSamples

GRAVITY_MPS2 = 9.80665
SATURATED_SIGMAS = 6.0
SATURATED_SAMPLES = 4
MIN_SCALE = (1.0,) * 3 + (1.2 * GRAVITY_MPS2,) * 3
"""Bound, in rad/s and m/s^2, that the range of every IMU exceeds."""
ORDINARY_NOISE = ImuNoise(2.0e-4, 2.0e-5, 2.0e-3, 1.0e-3, 200.0)
"""Noise of a good MEMS IMU (that of EuRoC and of most cameras), for recordings that don't state their own."""


@dataclass(frozen=True, eq=False)
class ImuBias:
    """gyro_radps, accel_mps2: (3,) in `body`, the amounts by which the sensors read too much."""

    gyro_radps: Float64
    accel_mps2: Float64

    @classmethod
    def none(cls) -> ImuBias:
        """Return zero biases."""
        return cls(np.zeros(3), np.zeros(3))


@dataclass(frozen=True, eq=False)
class BodyState:
    """rotation: (3, 3) reference_from_body. position_m, velocity_mps: (3,), Z up in the reference."""

    rotation: Float64
    position_m: Float64
    velocity_mps: Float64


def without_saturation(imu: ImuSamples) -> tuple[ImuSamples, int]:
    """Remove the samples at which an axis is saturated; also return their number.

    An axis is saturated where it keeps its highest or lowest value for four samples, far from its usual ones
    and high enough for a range to end there. A coarse axis also keeps a low one at the top of a slow swing or
    in a constant acceleration, far from the usual ones after a rest.
    """
    wrong = np.zeros(imu.stamp_ns.size, dtype=np.bool_)
    for axis, scale in zip(np.hstack([imu.gyro_radps, imu.accel_mps2]).T, MIN_SCALE, strict=True):
        for end in (axis.min(initial=np.inf), axis.max(initial=-np.inf)):
            held = axis == end
            if abs(end) < scale or np.count_nonzero(held) < SATURATED_SAMPLES:  # nearly always, quickly seen
                continue
            middle = np.median(axis)
            if abs(end - middle) > SATURATED_SIGMAS * (mad_sigma(axis - middle) + 1e-6):
                wrong |= binary_opening(held, np.ones(SATURATED_SAMPLES, np.bool_))
    kept = ~wrong
    part = ImuSamples(imu.stamp_ns[kept], imu.gyro_radps[kept], imu.accel_mps2[kept])
    return part, int(wrong.sum())


def saturation_sentences(count: int) -> tuple[str, ...]:
    """Tell of so many samples that left."""
    return (f"{count} IMU samples are at the end of their scale and were left out",) if count else ()
