"""Compute the Jacobian rows of a camera-IMU calibration for pictures and IMU readings, compiled."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from barsight.calibration.camera_imu.arrowhead_system import LOCAL, ROWS
from barsight.calibration.camera_imu.pose_spline import BIAS_AT, STATE
from barsight.calibration.camera_imu.spline_kernels import ORDER, ControlPoints, motion_at
from barsight.core.arrays import Float64, Int64, kernel

Rows = tuple[Int64, Float64, Float64, Float64]


class InertialReadings(NamedTuple):
    """Readings of a gyro (rad/s) or an accelerometer (m/s^2): values (K, 3) = matrix @ truth + bias.

    bias: (M, 3) at the control points. matrix: (3, 3). sigma: (K,).
    """

    values: Float64
    bias: Float64
    matrix: Float64
    sigma: Float64


@kernel()
def sum_corners(
    frame: Int64, points: Float64, by_point: Float64, by_lens: Float64, residual: Float64, weight: Float64,
    frames: int,
) -> tuple[Float64, Float64]:  # fmt: skip
    """Sum the information (F, 6 + L, 6 + L) and gradient (F, 6 + L) of each frame's pose and the lens.

    The first six parameters are (a, b): a point X in the camera's frame moves by X x a + b. points (N, 3),
    by_point (N, 2, 3); by_lens (N, 2, L), with L zero where the lens is fixed.
    """
    size = 6 + by_lens.shape[2]
    whole, pull = np.zeros((frames, size, size)), np.zeros((frames, size))
    row = np.empty(size)
    for n in range(frame.size):
        f = frame[n]
        x, y, z = points[n]
        for c in range(2):
            a, b, d = by_point[n, c]
            row[0], row[1], row[2] = b * z - d * y, d * x - a * z, a * y - b * x
            row[3], row[4], row[5] = a, b, d
            row[6:] = by_lens[n, c]
            for i in range(size):
                scaled = weight[n] * row[i]
                pull[f, i] += scaled * residual[n, c]
                for j in range(size):
                    whole[f, i, j] += scaled * row[j]
    return whole, pull


@kernel()
def _cross(v: Float64, out: Float64) -> None:
    """Fill out (3, 3) with the skew-symmetric matrix of v (3,): out @ w is the cross product of v and w."""
    out[:] = 0.0
    out[0, 1], out[0, 2], out[1, 2] = -v[2], v[1], -v[0]
    out[1, 0], out[2, 0], out[2, 1] = v[2], -v[1], v[0]


@kernel()
def _whiten(whole: Float64, pull: Float64, factor: Float64, residual: Float64) -> None:
    """Whiten normal equations: factor (C, C) is upper triangular with factor^T factor = whole, and
    residual = factor^-T pull.
    """
    factor[:] = 0.0
    residual[:] = 0.0
    for i in range(pull.size):
        for j in range(i, pull.size):
            total = whole[i, j]
            for m in range(i):
                total -= factor[m, i] * factor[m, j]
            if i == j:
                if total <= 1e-12 * whole[i, i]:
                    break
                factor[i, i] = np.sqrt(total)
            else:
                factor[i, j] = total / factor[i, i]
        if factor[i, i] > 0:
            total = pull[i]
            for m in range(i):
                total -= factor[m, i] * residual[m]
            residual[i] = total / factor[i, i]


@kernel()
def frame_rows(
    segment: Int64, u: Float64, points: ControlPoints, whole: Float64, pull: Float64, mount: Float64,
    mount_place: Float64, at: int, lens_at: int, width: int,
) -> Rows:  # fmt: skip
    """Form the rows of one camera's frames; `at`, `lens_at`: indices of its parameters among the common ones.

    A frame whose lens is unknown too has more than six rows and becomes several samples. segment, u: (K,)
    each frame's position on the spline. whole: (K, C, C) information, pull: (K, C) gradient, of
    `sum_corners`. mount: (3, 3) body_from_cam, mount_place: (3,) m. width: number of common parameters.
    """
    count, size = segment.size, whole.shape[1]
    split = -(-size // ROWS)
    first = np.empty(count * split, np.int64)
    residual, by_chain = np.zeros((count * split, ROWS)), np.zeros((count * split, ROWS, LOCAL))
    by_common = np.zeros((count * split, ROWS, width))
    weight, share, motion = np.empty((3, ORDER)), np.empty((3, ORDER)), np.empty((3, 3))
    rotation, rate = np.empty((3, 3)), np.empty(3)
    turn_by, rate_by = np.empty((3, 3 * ORDER)), np.empty((3, 3 * ORDER))
    factor, whitened, lever = np.zeros((size, size)), np.zeros(size), np.empty((3, 3))
    chain, common = np.zeros((6, LOCAL)), np.zeros((6, 7))
    back = np.ascontiguousarray(mount.T)
    _cross(mount_place, lever)
    arm = back @ lever
    for k in range(count):
        i = segment[k]
        motion_at(points, i, u[k], weight, share, rotation, rate, turn_by, rate_by, motion)
        to_camera = back @ rotation.T
        turned, armed = back @ turn_by, arm @ turn_by
        for j in range(ORDER):
            for c in range(3):
                for r in range(3):
                    chain[r, STATE * j + c] = turned[r, 3 * j + c]
                    chain[3 + r, STATE * j + c] = armed[r, 3 * j + c]
                    chain[3 + r, STATE * j + 3 + c] = -to_camera[r, c] * weight[0, j]
        for r in range(3):
            common[r, 6], common[3 + r, 6] = 0.0, 0.0
            for c in range(3):
                common[r, c] = back[r, c]
                common[3 + r, 3 + c] = -back[r, c]
                common[r, 6] += back[r, c] * rate[c]
                common[3 + r, 6] += arm[r, c] * rate[c] - to_camera[r, c] * motion[1, c]
        _whiten(whole[k], pull[k], factor, whitened)
        by_pose = np.ascontiguousarray(factor[:, :6])
        of_chain, of_common = by_pose @ chain, by_pose @ common
        first[k * split : (k + 1) * split] = i
        for row in range(size):
            n, r = k * split + row // ROWS, row % ROWS
            residual[n, r] = whitened[row]
            by_chain[n, r] = of_chain[row]
            by_common[n, r, at : at + 7] = of_common[row]
            by_common[n, r, lens_at : lens_at + size - 6] = factor[row, 6:]
    return first, residual, by_chain, by_common


@kernel()
def imu_rows(
    segment: Int64, u: Float64, points: ControlPoints, gyro: InertialReadings, accel: InertialReadings,
    gravity: Float64, axes: Float64, at: int, scales: bool, width: int,
) -> Rows:  # fmt: skip
    """Form the rows of the IMU's readings: three for the gyro, then three for the accelerometer [Eq. 9-10].

    segment, u: (K,) each reading's position on the spline. gravity: (3,) in the board's frame; axes: (3, 2)
    about which it rotates. `at`: index of gravity's two parameters among the `width` common ones; with
    `scales`, those of the accelerometer's and the gyro's matrix follow.
    """
    count = segment.size
    residual, by_chain = np.zeros((count, ROWS)), np.zeros((count, ROWS, LOCAL))
    by_common = np.zeros((count, ROWS, width))
    weight, share, motion = np.empty((3, ORDER)), np.empty((3, ORDER)), np.empty((3, 3))
    rotation, rate = np.empty((3, 3)), np.empty(3)
    turn_by, rate_by = np.empty((3, 3 * ORDER)), np.empty((3, 3 * ORDER))
    cross = np.empty((3, 3))
    _cross(gravity, cross)
    gravity_by = -(cross @ axes)
    for k in range(count):
        i = segment[k]
        gyro_sigma, accel_sigma = gyro.sigma[k], accel.sigma[k]
        motion_at(points, i, u[k], weight, share, rotation, rate, turn_by, rate_by, motion)
        force = rotation.T @ (motion[2] - gravity)
        _cross(force, cross)
        seen_rate, seen_force = gyro.matrix @ rate_by, accel.matrix @ (cross @ turn_by)
        to_body = accel.matrix @ rotation.T
        fall = to_body @ gravity_by
        here, there = i + BIAS_AT, i + BIAS_AT + 1
        for r in range(3):
            rate_seen, force_seen = 0.0, 0.0
            for c in range(3):
                rate_seen += gyro.matrix[r, c] * rate[c]
                force_seen += accel.matrix[r, c] * force[c]
            rate_seen += (1 - u[k]) * gyro.bias[here, r] + u[k] * gyro.bias[there, r]
            force_seen += (1 - u[k]) * accel.bias[here, r] + u[k] * accel.bias[there, r]
            residual[k, r] = (gyro.values[k, r] - rate_seen) / gyro_sigma
            residual[k, 3 + r] = (accel.values[k, r] - force_seen) / accel_sigma
            for j in range(ORDER):
                for c in range(3):
                    by_chain[k, r, STATE * j + c] = seen_rate[r, 3 * j + c] / gyro_sigma
                    by_chain[k, 3 + r, STATE * j + c] = seen_force[r, 3 * j + c] / accel_sigma
                    by_chain[k, 3 + r, STATE * j + 3 + c] = to_body[r, c] * weight[2, j] / accel_sigma
            for offset, part in ((BIAS_AT, 1 - u[k]), (BIAS_AT + 1, u[k])):
                by_chain[k, r, STATE * offset + 6 + r] = part / gyro_sigma
                by_chain[k, 3 + r, STATE * offset + 9 + r] = part / accel_sigma
            for c in range(2):
                by_common[k, 3 + r, at + c] = -fall[r, c] / accel_sigma
        if scales:
            column = at + 2
            for r in range(3):
                for c in range(r + 1):
                    by_common[k, 3 + r, column] = force[c] / accel_sigma
                    column += 1
            for r in range(3):
                for c in range(3):
                    by_common[k, r, column] = rate[c] / gyro_sigma
                    column += 1
    return segment, residual, by_chain, by_common
