"""Record details of a motion estimate besides the poses, for reports."""

from __future__ import annotations

from dataclasses import dataclass

from barsight.core.arrays import Float64, Int64


@dataclass(frozen=True, eq=False)
class NormalisedResiduals:
    """Normalised residuals of a sensor: measured minus estimated, over its stated sigma.

    stamp_ns: (K,) cam0's clock. values: (K, C), one column for each of `names`. One value should scatter
    by 1; a root mean square of many stands for them where there are many at a stamp.
    """

    names: tuple[str, ...]
    stamp_ns: Int64
    values: Float64


@dataclass(frozen=True, eq=False)
class InertialStates:
    """Velocity (reference axes) and the IMU's biases (body axes), (F, 3) each, with one sigma of each."""

    stamp_ns: Int64
    velocity_mps: Float64
    velocity_sigma_mps: Float64
    gyro_bias_radps: Float64
    gyro_bias_sigma_radps: Float64
    accel_bias_mps2: Float64
    accel_bias_sigma_mps2: Float64


@dataclass(frozen=True, eq=False)
class RelativePoses:
    """Covariance of each frame's pose relative to the one before. covariance: (F - 1, 6, 6) of its pose
    there, rotation (rad) then translation (m) of a small motion that follows it, in its own body axes; NaN
    where the two are too far apart to tell.
    """

    covariance: Float64


@dataclass(frozen=True, eq=False)
class MotionDetail:
    """inertial: None without IMU. pictures: u, v and right u of each frame, RMS over its points; imu: turn,
    way and speed between neighbours, RMS over the axes; encoders: x, y, z of each place, those left out
    included. points: (F, 2) of each frame of `pictures`: used, and refused as ambiguous. innovations: turn
    and way of `rect0` since the frame before, as pictures find them, against what other sensors predicted.
    """

    inertial: InertialStates | None
    pictures: NormalisedResiduals | None
    imu: NormalisedResiduals | None
    encoders: NormalisedResiduals | None
    points: Int64
    relative: RelativePoses | None = None
    innovations: NormalisedResiduals | None = None
