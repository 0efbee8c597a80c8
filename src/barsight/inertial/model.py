"""Define the IMU's measurement model and the body's state, and remove saturated samples.

The IMU measures turn rate and specific force in `body`, each with a bias that follows a random walk and white
noise: `a~ = a + b_a + n_a`, `w~ = w + b_g + n_g` [paper Eq. 9-10], where `a` is the acceleration minus
gravity. `preintegration` integrates its samples.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from barsight.calibration.geometry.imu_noise import ImuNoise
from barsight.core.arrays import Bool, Float64
from barsight.core.linalg.robust import mad_sigma
from barsight.core.records.sensor_samples import ImuSamples

GRAVITY_MPS2 = 9.80665
SATURATED_SIGMAS = 6.0
SATURATED_SAMPLES = 4
SWING_COUNTS, MIN_COUNT = 4.5, 1e-9
"""A swing's top is left by fewer counts before and after; smaller differences are rounding."""
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

    An axis is saturated where it keeps its highest or lowest value for four samples, far from its usual ones.
    A coarse axis also does so at the top of a slow swing, but reaches and leaves it in single counts.
    """
    wrong = np.zeros(imu.stamp_ns.size, dtype=np.bool_)
    for axis in np.hstack([imu.gyro_radps, imu.accel_mps2]).T:
        for end in (axis.min(initial=np.inf), axis.max(initial=-np.inf)):
            if np.count_nonzero(axis == end) < SATURATED_SAMPLES:  # nearly always, and quickly seen
                continue
            middle, counts = np.median(axis), np.diff(np.unique(axis))
            if abs(end - middle) > SATURATED_SIGMAS * (mad_sigma(axis - middle) + 1e-6):
                count = counts[counts > MIN_COUNT].min(initial=np.inf)
                wrong |= _held(axis, float(end), SWING_COUNTS * float(count))
    kept = ~wrong
    part = ImuSamples(imu.stamp_ns[kept], imu.gyro_radps[kept], imu.accel_mps2[kept])
    return part, int(wrong.sum())


def saturation_sentences(count: int) -> tuple[str, ...]:
    """Tell of so many samples that left."""
    return (f"{count} IMU samples are at the end of their scale and were left out",) if count else ()


def _held(axis: Float64, end: float, min_step: float) -> Bool:
    """Select the samples (N,) that keep a value which an axis comes to and leaves by more than `min_step`."""
    edges = np.flatnonzero(np.diff(np.r_[False, axis == end, False]))
    held = np.zeros(axis.size, np.bool_)
    for first, beyond in zip(edges[::2], edges[1::2], strict=True):
        beside = axis[[max(first - 1, 0), min(beyond, axis.size - 1)]]
        held[first:beyond] = beyond - first >= SATURATED_SAMPLES and np.abs(beside - end).sum() > min_step
    return held
