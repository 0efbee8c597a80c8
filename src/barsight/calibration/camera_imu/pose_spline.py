"""Model a body's trajectory as a cumulative B-spline of its pose with piecewise linear IMU biases.

This follows Furgale et al. 2013, but with the rotation on SO(3) instead of as a rotation vector. Times are in
seconds since the spline's `start_ns`, on the IMU's clock.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from barsight.calibration.camera_imu.spline_kernels import DEGREE, ORDER, ControlPoints, motion_at
from barsight.core.arrays import Float64, Int64, kernel

STATE = 12
"""Unknowns per control point: small rotation (from the right), place, gyro bias, accelerometer bias."""
BIAS_AT = (ORDER - 2) // 2
"""Index, within a segment, of the control point that holds the biases at its start; the next one holds those
at its end.
"""


@dataclass(frozen=True, eq=False)
class PoseSpline:
    """A spline of M control points and M - 5 segments.

    start_ns: start of the first segment. step_s: knot spacing. rotations (M, 3, 3) and places_m (M, 3):
    world_from_body. gyro_bias_radps, accel_bias_mps2: (M, 3).
    """

    start_ns: int
    step_s: float
    rotations: Float64
    places_m: Float64
    gyro_bias_radps: Float64
    accel_bias_mps2: Float64

    @property
    def segments(self) -> int:
        """Return the number of segments."""
        return len(self.places_m) - DEGREE

    def control_points(self) -> ControlPoints:
        """Compute the rotations between the control points, as the compiled evaluation needs them."""
        steps = Rotation.from_matrix(self.rotations[:-1].transpose(0, 2, 1) @ self.rotations[1:]).as_rotvec()
        return ControlPoints(self.step_s, self.rotations, self.places_m, steps, inverse_right_jacobian(steps))

    def moved(self, step: Float64) -> PoseSpline:
        """Retract a step (M, STATE) of the unknowns."""
        turn = Rotation.from_rotvec(step[:, :3]).as_matrix()
        return replace(
            self, rotations=self.rotations @ turn, places_m=self.places_m + step[:, 3:6],
            gyro_bias_radps=self.gyro_bias_radps + step[:, 6:9],
            accel_bias_mps2=self.accel_bias_mps2 + step[:, 9:],
        )  # fmt: skip

    def at(self, times_s: Float64) -> SplineMotion:
        """Evaluate the motion at given times; times outside the spline are clamped to its ends."""
        segment, u = locate(times_s, self.step_s, self.segments)
        rotation, rate, place = _evaluate(segment, u, self.control_points())
        k, share = segment + BIAS_AT, u[:, None]
        biases = [
            (1 - share) * bias[k] + share * bias[k + 1]
            for bias in (self.gyro_bias_radps, self.accel_bias_mps2)
        ]
        return SplineMotion(rotation, rate, place[:, 0], place[:, 1], place[:, 2], biases[0], biases[1])


@dataclass(frozen=True, eq=False)
class SplineMotion:
    """Motion at N times.

    rotation (N, 3, 3): world_from_body. rate_radps (N, 3): in body axes. place_m, velocity_mps,
    acceleration_mps2 (N, 3): in the world. gyro_bias_radps, accel_bias_mps2: (N, 3).
    """

    rotation: Float64
    rate_radps: Float64
    place_m: Float64
    velocity_mps: Float64
    acceleration_mps2: Float64
    gyro_bias_radps: Float64
    accel_bias_mps2: Float64


def fit_spline(
    start_ns: int, end_s: float, step_s: float, times_s: Float64, rotations: Float64, places_m: Float64
) -> PoseSpline:
    """Fit a spline from time 0 to end_s to poses at increasing times, with zero biases.

    Each control point takes the pose interpolated at the time where its weight is centred. The resulting
    spline cuts corners, as a B-spline does; a least-squares solve that starts from it corrects this.
    """
    count = int(np.ceil(end_s / step_s)) + DEGREE
    centre_s = (np.arange(count) - (ORDER - 2) / 2) * step_s
    centre_s = np.clip(centre_s, times_s[0], times_s[-1])
    after = np.clip(np.searchsorted(times_s, centre_s), 1, times_s.size - 1)
    share = (centre_s - times_s[after - 1]) / (times_s[after] - times_s[after - 1])
    between = Rotation.from_matrix(rotations[after - 1].transpose(0, 2, 1) @ rotations[after]).as_rotvec()
    control_rotations = rotations[after - 1] @ Rotation.from_rotvec(between * share[:, None]).as_matrix()
    placed = np.column_stack([np.interp(centre_s, times_s, places_m[:, i]) for i in range(3)])
    return PoseSpline(start_ns, step_s, control_rotations, placed, np.zeros((count, 3)), np.zeros((count, 3)))


def locate(times_s: Float64, step_s: float, segments: int) -> tuple[Int64, Float64]:
    """Find the segments (N,) and the positions u (N,) within them, in [0, 1]; times outside are clamped to
    the ends.
    """
    scaled = np.clip(times_s / step_s, 0.0, segments)
    segment = np.minimum(scaled.astype(np.int64), segments - 1)
    return segment, scaled - segment


def inverse_right_jacobian(turns: Float64) -> Float64:
    """Compute the inverse right Jacobians (N, 3, 3) of rotation vectors (N, 3) shorter than pi."""
    square = (turns**2).sum(axis=1)
    angle = np.sqrt(np.maximum(square, 1e-12))
    factor = np.where(square < 1e-8, 1 / 12, 1 / angle**2 - (1 + np.cos(angle)) / (2 * angle * np.sin(angle)))
    cross = np.zeros((len(turns), 3, 3))
    x, y, z = turns.T
    cross[:, 2, 1], cross[:, 0, 2], cross[:, 1, 0] = x, y, z
    cross -= cross.transpose(0, 2, 1)
    inverse: Float64 = np.eye(3) + cross / 2 + factor[:, None, None] * (cross @ cross)
    return inverse


@kernel()
def _evaluate(segment: Int64, u: Float64, points: ControlPoints) -> tuple[Float64, Float64, Float64]:
    """Evaluate the pose spline and its time derivatives at K times [Furgale 2013].

    segment: (K,); u: (K,) position within it, 0...1. Returns rotation (K, 3, 3), turn rate (K, 3) in rad/s in
    body axes, and (K, 3, 3) place, velocity and acceleration in m and s.
    """
    count = segment.size
    rotation, rate, place = np.empty((count, 3, 3)), np.empty((count, 3)), np.empty((count, 3, 3))
    weight, share = np.empty((3, ORDER)), np.empty((3, ORDER))
    turn_by, rate_by = np.empty((3, 3 * ORDER)), np.empty((3, 3 * ORDER))
    for n in range(count):
        motion_at(points, segment[n], u[n], weight, share, rotation[n], rate[n], turn_by, rate_by, place[n])
    return rotation, rate, place
