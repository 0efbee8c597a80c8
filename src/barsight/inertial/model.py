"""Define the IMU's measurement model and kinematics as a slow reference; `preintegration` is the fast way.

Measured are the turn rate and the specific force in `body`, each with a bias that walks and white noise:
`a~ = a + b_a + n_a`, `w~ = w + b_g + n_g` [paper Eq. 9-10], where `a` is the acceleration minus gravity.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import binary_opening
from scipy.spatial.transform import Rotation

from barsight.calibration.geometry.imu_noise import ImuNoise
from barsight.core.arrays import Float64
from barsight.core.stamps import NS_PER_S, interpolate_at
from barsight.core.types import ImuSamples

GRAVITY_MPS2 = 9.80665
SATURATED_SIGMAS = 6.0
SATURATED_SAMPLES = 4
ORDINARY_NOISE = ImuNoise(2.0e-4, 2.0e-5, 2.0e-3, 1.0e-3, 200.0)
"""A good MEMS IMU's (those of EuRoC and of most cameras), for recordings that don't state their own."""


@dataclass(frozen=True, eq=False)
class ImuBias:
    """gyro_radps, accel_mps2: (3,) in `body`, what the sensors read too much."""

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


def subtract_bias(imu: ImuSamples, bias: ImuBias) -> ImuSamples:
    """Subtract the bias from the samples [paper Eq. 9-10]."""
    return ImuSamples(imu.stamp_ns, imu.gyro_radps - bias.gyro_radps, imu.accel_mps2 - bias.accel_mps2)


def without_saturation(imu: ImuSamples) -> tuple[ImuSamples, int]:
    """Remove the samples at which an axis stands at its end of scale; also how many.

    An axis that keeps its highest or lowest value for four samples, far from its usual ones, can't follow.
    """
    wrong = np.zeros(imu.stamp_ns.size, dtype=np.bool_)
    for axis in np.hstack([imu.gyro_radps, imu.accel_mps2]).T:
        middle = np.median(axis)
        usual = 1.4826 * np.median(np.abs(axis - middle)) + 1e-6
        for end in (axis.min(initial=np.inf), axis.max(initial=-np.inf)):
            if axis.size and abs(end - middle) > SATURATED_SIGMAS * usual:
                there = axis == end
                wrong |= binary_opening(there, np.ones(SATURATED_SAMPLES, np.bool_))
    kept = ~wrong
    part = ImuSamples(imu.stamp_ns[kept], imu.gyro_radps[kept], imu.accel_mps2[kept])
    return part, int(wrong.sum())


def integrate_reference(
    imu: ImuSamples, start_ns: int, end_ns: int, state: BodyState, bias: ImuBias,
    gravity_mps2: float = GRAVITY_MPS2, steps: int = 2000,
) -> BodyState:  # fmt: skip
    """Integrate the state to `end_ns` by many small steps of [paper Eq. 11] in the reference frame.

    The readings between samples are interpolated linearly and taken at each step's middle. For tests: it is
    exact as `steps` grows, and slow. Samples must enclose both stamps.
    """
    edges = np.linspace(0, end_ns - start_ns, steps + 1)
    middle = start_ns + ((edges[1:] + edges[:-1]) / 2).round().astype(np.int64)
    clean = subtract_bias(imu, bias)
    rate = interpolate_at(middle, imu.stamp_ns, clean.gyro_radps)
    force = interpolate_at(middle, imu.stamp_ns, clean.accel_mps2)
    rotation, position, velocity = state.rotation, state.position_m, state.velocity_mps
    gravity = np.array([0.0, 0.0, -gravity_mps2])
    dt = (end_ns - start_ns) / NS_PER_S / steps
    for w, a in zip(rate, force, strict=True):
        half = rotation @ Rotation.from_rotvec(w * dt / 2).as_matrix()
        acceleration = half @ a + gravity
        position = position + velocity * dt + acceleration * dt**2 / 2
        velocity = velocity + acceleration * dt
        rotation = rotation @ Rotation.from_rotvec(w * dt).as_matrix()
    return BodyState(rotation, position, velocity)
