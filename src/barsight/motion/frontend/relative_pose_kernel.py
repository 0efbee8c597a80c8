"""Form one step's normal equations point by point, where a frame's consensus spends its iterations."""

from __future__ import annotations

import numpy as np

from barsight.core.arrays import Float64, kernel

NEAREST_M = 0.1
HUBER_SIGMAS = 1.5
MAX_SIGMAS = 5.0


@kernel()
def step_equations(
    points: Float64, by_old_places: Float64, target: Float64, turn: Float64, place: Float64, lens: Float64,
    variance: float, distance: Float64, normal: Float64, gradient: Float64,
) -> None:  # fmt: skip
    """Compute distance (N,), each point's residual in its own sigmas (infinite behind the camera), and the
    normal matrix (6, 6) and gradient (6,) of a small turn, then shift, in the new frame's axes.

    points (N, 3) in the old frame; by_old_places (N, 3, 3) their Jacobian in m per px of the coordinates they
    were triangulated from; target (N, 3) u, v, right u; turn (3, 3), place (3,) new from old. lens: (5,)
    focal px, cx, cy, focal times baseline (px m), doffs px. variance: px^2 of one coordinate. Weights are
    Huber's, and zero beyond 5 sigma.
    """
    moved, residual, pull = np.empty(3), np.empty(3), np.empty(3)
    by_point, carried, spread = np.zeros((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    information, jacobian, weighted = np.empty((3, 3)), np.empty((3, 6)), np.empty((3, 6))
    normal[:], gradient[:] = 0.0, 0.0
    for n in range(points.shape[0]):
        for i in range(3):
            moved[i] = place[i]
            for j in range(3):
                moved[i] += turn[i, j] * points[n, j]
        x, y, z = moved
        if not z > NEAREST_M:
            distance[n] = np.inf
            continue
        by_point[0, 0] = by_point[1, 1] = by_point[2, 0] = lens[0] / z
        by_point[0, 2], by_point[1, 2] = -lens[0] * x / z**2, -lens[0] * y / z**2
        by_point[2, 2] = by_point[0, 2] + lens[3] / z**2
        u = lens[0] * x / z + lens[1]
        residual[0], residual[1] = target[n, 0] - u, target[n, 1] - lens[0] * y / z - lens[2]
        residual[2] = target[n, 2] - u + lens[3] / z - lens[4]
        _product(by_point, turn, carried)
        _product(carried, by_old_places[n], spread)
        for i in range(3):
            for j in range(3):
                total = 1.0 if i == j else 0.0
                for k in range(3):
                    total += spread[i, k] * spread[j, k]
                carried[i, j] = variance * total
        _inverse(carried, information)
        square = 0.0
        for i in range(3):
            pull[i] = 0.0
            for j in range(3):
                pull[i] += information[i, j] * residual[j]
            square += pull[i] * residual[i]
        distance[n] = np.sqrt(square)
        if distance[n] >= MAX_SIGMAS:
            continue
        weight = min(1.0, HUBER_SIGMAS / max(distance[n], 1e-9))
        for i in range(3):
            a, b, c = by_point[i, 0], by_point[i, 1], by_point[i, 2]
            jacobian[i, 0], jacobian[i, 1], jacobian[i, 2] = c * y - b * z, a * z - c * x, b * x - a * y
            jacobian[i, 3], jacobian[i, 4], jacobian[i, 5] = a, b, c
        _product(information, jacobian, weighted)
        for i in range(6):
            for k in range(3):
                gradient[i] += weight * jacobian[k, i] * pull[k]
                for j in range(6):
                    normal[i, j] += weight * jacobian[k, i] * weighted[k, j]


@kernel()
def _product(a: Float64, b: Float64, result: Float64) -> None:
    """Multiply a (3, 3) by b (3, M)."""
    for i in range(3):
        for j in range(b.shape[1]):
            result[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]


@kernel()
def _inverse(m: Float64, result: Float64) -> None:
    """Invert a (3, 3) matrix by its cofactors."""
    for i in range(3):
        for j in range(3):
            a, b, c, d = (i + 1) % 3, (i + 2) % 3, (j + 1) % 3, (j + 2) % 3
            result[j, i] = m[a, c] * m[b, d] - m[a, d] * m[b, c]
    determinant = m[0, 0] * result[0, 0] + m[0, 1] * result[1, 0] + m[0, 2] * result[2, 0]
    for i in range(3):
        for j in range(3):
            result[i, j] /= determinant
