"""Evaluate one segment of a uniform cumulative B-spline on SO(3) x R3 with Jacobians, compiled.

Control point m is a rotation R_m and a place p_m. Within a segment,
R(u) = R_i Exp(l_1(u) d_1) ... Exp(l_5(u) d_5) with d_j = Log(R_{i+j-1}^T R_{i+j}) [Kim 1995]. The turn rate
and all derivatives with respect to small rotations R_m Exp(x) follow from the recursion of [Sommer 2020].
"""

from __future__ import annotations

from math import comb, factorial
from typing import NamedTuple

import numpy as np

from barsight.core.arrays import Float64, kernel

ORDER = 6
"""Control points per segment. Six, as in Kalibr, make the acceleration a cubic and the jerk smooth."""
DEGREE = ORDER - 1
SMALL = 1e-5


class ControlPoints(NamedTuple):
    """M control points, step_s apart: rotations (M, 3, 3) and places_m (M, 3) of world_from_body.

    steps: (M - 1, 3) rotations d_j between them, rad; inverse: (M - 1, 3, 3) their inverse right Jacobians.
    """

    step_s: float
    rotations: Float64
    places_m: Float64
    steps: Float64
    inverse: Float64


def _blending() -> Float64:
    """Compute the blending matrix (ORDER, ORDER) of a uniform B-spline, control points by powers of u."""
    k = ORDER
    matrix = np.zeros((k, k))
    for s in range(k):
        for n in range(k):
            total = sum((-1) ** (i - s) * comb(k, i - s) * (k - 1 - i) ** (k - 1 - n) for i in range(s, k))
            matrix[s, n] = comb(k - 1, n) / factorial(k - 1) * total
    return matrix


BLENDING = _blending()
CUMULATIVE = np.cumsum(BLENDING[::-1], axis=0)[::-1].copy()


@kernel()
def weights(u: float, step_s: float, matrix: Float64, out: Float64) -> None:
    """Fill out (3, ORDER) with the weights at u in [0, 1) and their first two time derivatives."""
    for row in range(ORDER):
        value, slope, bend = 0.0, 0.0, 0.0
        for n in range(ORDER - 1, -1, -1):
            bend = bend * u + 2 * slope
            slope = slope * u + value
            value = value * u + matrix[row, n]
        out[0, row] = value
        out[1, row] = slope / step_s
        out[2, row] = bend / step_s**2


@kernel()
def exp_so3(v: Float64, scale: float, rotation: Float64, right: Float64) -> None:
    """Fill rotation (3, 3) with Exp(scale v) and right (3, 3) with its right Jacobian."""
    x, y, z = scale * v[0], scale * v[1], scale * v[2]
    square = x * x + y * y + z * z
    angle = np.sqrt(square)
    if angle < SMALL:
        a, b, c = 1 - square / 6, 0.5 - square / 24, 1 / 6 - square / 120
    else:
        a, b = np.sin(angle) / angle, (1 - np.cos(angle)) / square
        c = (1 - a) / square
    w = (x, y, z)
    for i in range(3):
        for j in range(3):
            outer = w[i] * w[j]
            rotation[i, j] = b * outer
            right[i, j] = c * outer
        rotation[i, i] += 1 - b * square
        right[i, i] += 1 - c * square
    for i, j, value in ((2, 1, x), (0, 2, y), (1, 0, z)):
        rotation[i, j] += a * value
        rotation[j, i] -= a * value
        right[i, j] -= b * value
        right[j, i] += b * value


@kernel()
def _times(a: Float64, b: Float64, transposed: bool, out: Float64) -> None:
    """Fill out with a @ b, or with a^T @ b, all (3, 3)."""
    for i in range(3):
        for j in range(3):
            total = 0.0
            for k in range(3):
                total += (a[k, i] if transposed else a[i, k]) * b[k, j]
            out[i, j] = total


@kernel()
def rotation_at(
    first: Float64, steps: Float64, inverse_right: Float64, share: Float64, rotation: Float64, rate: Float64,
    turn_by: Float64, rate_by: Float64,
) -> None:  # fmt: skip
    """Evaluate the rotation and turn rate (body axes) of a segment, with their Jacobians.

    first: (3, 3) R_i. steps: (DEGREE, 3) d_j; inverse_right: (DEGREE, 3, 3) their inverse right Jacobians.
    share: (3, ORDER) cumulative weights. Fills rotation (3, 3), rate (3,), turn_by and rate_by (3, 3 *
    ORDER), the derivatives of rotation (from the right) and rate with respect to small rotations of the
    control points.
    """
    factor, right = np.empty((ORDER, 3, 3)), np.empty((ORDER, 3, 3))
    carried = np.empty((ORDER, 3))
    rate[:] = 0.0
    for j in range(1, ORDER):
        exp_so3(steps[j - 1], share[0, j], factor[j], right[j])
        for i in range(3):
            carried[j, i] = factor[j, 0, i] * rate[0] + factor[j, 1, i] * rate[1] + factor[j, 2, i] * rate[2]
        for i in range(3):
            rate[i] = carried[j, i] + share[1, j] * steps[j - 1, i]
    turn_by[:] = 0.0
    rate_by[:] = 0.0
    rest, other = np.eye(3), np.empty((3, 3))
    turn_step, rate_step = np.empty((3, 3)), np.empty((3, 3))
    for j in range(ORDER - 1, 0, -1):
        _times(rest, right[j], True, turn_step)
        cx, cy, cz = carried[j, 0], carried[j, 1], carried[j, 2]
        scale = share[0, j]
        for i in range(3):
            r0, r1, r2 = right[j, 0, i], right[j, 1, i], right[j, 2, i]
            other[0, i] = scale * (cy * r2 - cz * r1)
            other[1, i] = scale * (cz * r0 - cx * r2)
            other[2, i] = scale * (cx * r1 - cy * r0)
        for i in range(3):
            other[i, i] += share[1, j]
        _times(rest, other, True, rate_step)
        back = inverse_right[j - 1]
        for i in range(3):
            for c in range(3):
                ahead_turn, behind_turn, ahead_rate, behind_rate = 0.0, 0.0, 0.0, 0.0
                for m in range(3):
                    ahead_turn += turn_step[i, m] * back[m, c]
                    behind_turn += turn_step[i, m] * back[c, m]
                    ahead_rate += rate_step[i, m] * back[m, c]
                    behind_rate += rate_step[i, m] * back[c, m]
                turn_by[i, 3 * j + c] += scale * ahead_turn
                turn_by[i, 3 * j - 3 + c] -= scale * behind_turn
                rate_by[i, 3 * j + c] += ahead_rate
                rate_by[i, 3 * j - 3 + c] -= behind_rate
        _times(factor[j], rest, False, other)
        rest[:] = other
    for i in range(3):
        for c in range(3):
            turn_by[i, c] += rest[c, i]
    _times(first, rest, False, rotation)


@kernel()
def place_at(places: Float64, weight: Float64, out: Float64) -> None:
    """Fill out (3, 3) with place, velocity and acceleration of a segment. places: (ORDER, 3)."""
    for derivative in range(3):
        for i in range(3):
            total = 0.0
            for j in range(ORDER):
                total += weight[derivative, j] * places[j, i]
            out[derivative, i] = total


@kernel()
def motion_at(
    points: ControlPoints, i: int, u: float, weight: Float64, share: Float64, rotation: Float64,
    rate: Float64, turn_by: Float64, rate_by: Float64, motion: Float64,
) -> None:  # fmt: skip
    """Evaluate the motion at u in segment i.

    Fills weight and share (3, ORDER), the blending and cumulative weights; rotation, rate, turn_by and
    rate_by as `rotation_at` does; motion (3, 3) as `place_at` does.
    """
    weights(u, points.step_s, BLENDING, weight)
    weights(u, points.step_s, CUMULATIVE, share)
    rotation_at(
        points.rotations[i], points.steps[i : i + DEGREE], points.inverse[i : i + DEGREE], share, rotation,
        rate, turn_by, rate_by,
    )  # fmt: skip
    place_at(points.places_m[i : i + ORDER], weight, motion)
