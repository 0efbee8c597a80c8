"""Points seen by both cameras taken out of the normal equations: what is left binds poses only.

A point is seen from a few nodes and binds only these, so its three unknowns are eliminated where it stands
(Schur's complement), which costs a few hundred products a sighting. Errors are predicted minus seen; poses
move as GTSAM's do, by a small turn and shift in body axes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from barsight.core.arrays import Bool, Float64, Int64, kernel

NEAREST_M = 0.05
BEHIND_SIGMAS = 100.0
"""What a point behind the camera is off by."""


class Rig(NamedTuple):
    """lens: (5,) focal px, cx, cy, focal times baseline (px m) and doffs px. turn (3, 3), place (3,): of the
    left camera in the body. huber: length of a whitened error from which its pull stays.
    """

    lens: Float64
    turn: Float64
    place: Float64
    huber: float


class Sights(NamedTuple):
    """N sightings of T points, in the points' order. first: (T + 1,) each point's begin; node, used (N,);
    stereo (N, 3) u, v, right u; weight (N,) 1 / sigma. scale: 1 where the rig's scale is seen, else 0.
    """

    first: Int64
    node: Int64
    used: Bool
    stereo: Float64
    weight: Float64
    scale: float


class Guess(NamedTuple):
    """Where the unknowns are: turn (M, 3, 3), place (M, 3) of the body; points (T, 3); drift (2,)."""

    turn: Float64
    place: Float64
    points: Float64
    drift: Float64


class Reduced(NamedTuple):
    """Normal equations of poses and drift. band: (M, S, 6, 6) of node k with node k + s; gradient (M, 6);
    side (M, 6, 2) with the drift; corner (2, 2) and corner_gradient (2,) of the drift itself.
    """

    band: Float64
    gradient: Float64
    side: Float64
    corner: Float64
    corner_gradient: Float64


@kernel(fastmath=True)
def _error(
    rig: Rig, sights: Sights, guess: Guess, k: int, t: int, error: Float64, body: Float64, q: Float64,
    by_drift: Float64,
) -> bool:  # fmt: skip
    """error (3,) px predicted minus seen; the point in the body (3,) and q (3,) in the left camera; by_drift
    (2,) px of the right column. False behind the camera.
    """
    node = sights.node[k]
    turn, place, point = guess.turn[node], guess.place[node], guess.points[t]
    for i in range(3):
        body[i] = 0.0
        for j in range(3):
            body[i] += turn[j, i] * (point[j] - place[j])
    for i in range(3):
        q[i] = 0.0
        for j in range(3):
            q[i] += rig.turn[j, i] * (body[j] - rig.place[j])
    if q[2] < NEAREST_M:
        return False
    u = rig.lens[0] * q[0] / q[2] + rig.lens[1]
    error[0] = u - sights.stereo[k, 0]
    error[1] = rig.lens[0] * q[1] / q[2] + rig.lens[2] - sights.stereo[k, 1]
    # By the predicted place: by the seen one, a scale would shrink the right picture's noise and be liked.
    x = (q[0] - rig.lens[3] / rig.lens[0]) / q[2]
    by_drift[0] = -rig.lens[0] * (1 + x**2)
    by_drift[1] = -sights.scale * rig.lens[3] / q[2]
    shift = by_drift[0] * guess.drift[0] + by_drift[1] * guess.drift[1]
    error[2] = u - rig.lens[3] / q[2] + rig.lens[4] + shift - sights.stereo[k, 2]
    return True


@kernel(fastmath=True)
def residuals(rig: Rig, sights: Sights, guess: Guess, result: Float64) -> float:
    """Seen minus predicted (N, 3) px of the used sightings; returns their robust cost."""
    error, body, q, by_drift, cost = np.empty(3), np.empty(3), np.empty(3), np.empty(2), 0.0
    for t in range(len(sights.first) - 1):
        for k in range(sights.first[t], sights.first[t + 1]):
            if not sights.used[k]:
                continue
            if not _error(rig, sights, guess, k, t, error, body, q, by_drift):
                error[:] = BEHIND_SIGMAS / sights.weight[k]
            total = 0.0
            for i in range(3):
                result[k, i] = -error[i]
                total += error[i] ** 2
            size = np.sqrt(total) * sights.weight[k]
            cost += size**2 / 2 if size < rig.huber else rig.huber * (size - rig.huber / 2)
    return cost


@kernel(fastmath=True)
def _rows(
    rig: Rig, sights: Sights, guess: Guess, k: int, t: int, error: Float64, by_pose: Float64,
    by_point: Float64, by_drift: Float64, room: Float64,
) -> None:  # fmt: skip
    """The whitened error (3,) of a sighting and its derivatives: by_pose (3, 6), by_point (3, 3), by_drift
    (2,) of its third row. room: (3, 3) scratch.
    """
    body, q = room[0], room[1]
    if not _error(rig, sights, guess, k, t, error, body, q, by_drift):
        error[:] = 0
        by_pose[:] = 0
        by_point[:] = 0
        by_drift[:] = 0
        return
    size = np.sqrt(error[0] ** 2 + error[1] ** 2 + error[2] ** 2) * sights.weight[k]
    weight = sights.weight[k] * np.sqrt(min(1.0, rig.huber / max(size, 1e-9)))
    f, z = weight * rig.lens[0], q[2]
    turn = guess.turn[sights.node[k]]
    for i in range(3):
        along = f / z if i != 1 else 0.0
        down = f / z if i == 1 else 0.0
        deep = -f * q[1 if i == 1 else 0] / z**2
        if i == 2:
            deep += weight * rig.lens[3] / z**2
        for j in range(3):
            room[2, j] = along * rig.turn[j, 0] + down * rig.turn[j, 1] + deep * rig.turn[j, 2]
        a, b, c = room[2]
        for j in range(3):
            by_point[i, j] = a * turn[j, 0] + b * turn[j, 1] + c * turn[j, 2]
        by_pose[i, 0] = b * body[2] - c * body[1]
        by_pose[i, 1] = c * body[0] - a * body[2]
        by_pose[i, 2] = a * body[1] - b * body[0]
        by_pose[i, 3], by_pose[i, 4], by_pose[i, 5] = -a, -b, -c
        error[i] *= weight
    by_drift[0] *= weight
    by_drift[1] *= weight


@kernel(fastmath=True)
def _inverse(m: Float64, result: Float64) -> None:
    """Of a symmetric (3, 3)."""
    result[0, 0] = m[1, 1] * m[2, 2] - m[1, 2] * m[1, 2]
    result[0, 1] = m[0, 2] * m[1, 2] - m[0, 1] * m[2, 2]
    result[0, 2] = m[0, 1] * m[1, 2] - m[0, 2] * m[1, 1]
    result[1, 1] = m[0, 0] * m[2, 2] - m[0, 2] * m[0, 2]
    result[1, 2] = m[0, 1] * m[0, 2] - m[0, 0] * m[1, 2]
    result[2, 2] = m[0, 0] * m[1, 1] - m[0, 1] * m[0, 1]
    size = m[0, 0] * result[0, 0] + m[0, 1] * result[0, 1] + m[0, 2] * result[0, 2]
    for i in range(3):
        for j in range(i, 3):
            result[i, j] /= size
            result[j, i] = result[i, j]


@kernel(fastmath=True)
def eliminate(rig: Rig, sights: Sights, guess: Guess, result: Reduced) -> None:
    """Adds all used sightings to `result`."""
    most = 1
    for t in range(len(sights.first) - 1):
        most = max(most, sights.first[t + 1] - sights.first[t])
    error, by_pose, by_point, by_drift = np.empty(3), np.empty((3, 6)), np.empty((3, 3)), np.empty(2)
    room, nodes = np.empty((3, 3)), np.empty(most, np.int64)
    # A point's share of the poses' and the drift's rows: (6, 3) a node, and its inverse times these.
    cross, solved, drift_cross = np.empty((most, 6, 3)), np.empty((6, 3)), np.empty((2, 3))
    normal, inverse, gradient, best = np.empty((3, 3)), np.empty((3, 3)), np.empty(3), np.empty(3)
    for t in range(len(sights.first) - 1):
        normal[:] = 0
        gradient[:] = 0
        drift_cross[:] = 0
        count = 0
        for k in range(sights.first[t], sights.first[t + 1]):
            if not sights.used[k]:
                continue
            _rows(rig, sights, guess, k, t, error, by_pose, by_point, by_drift, room)
            node = sights.node[k]
            nodes[count] = node
            block = result.band[node, 0]
            for a in range(6):
                for b in range(6):
                    block[a, b] += (
                        by_pose[0, a] * by_pose[0, b] + by_pose[1, a] * by_pose[1, b]
                        + by_pose[2, a] * by_pose[2, b]
                    )  # fmt: skip
                for b in range(3):
                    cross[count, a, b] = (
                        by_pose[0, a] * by_point[0, b] + by_pose[1, a] * by_point[1, b]
                        + by_pose[2, a] * by_point[2, b]
                    )  # fmt: skip
                result.gradient[node, a] += (
                    by_pose[0, a] * error[0] + by_pose[1, a] * error[1] + by_pose[2, a] * error[2]
                )
                for i in range(2):
                    result.side[node, a, i] += by_drift[i] * by_pose[2, a]
            for a in range(3):
                for i in range(3):
                    gradient[a] += by_point[i, a] * error[i]
                    for b in range(3):
                        normal[a, b] += by_point[i, a] * by_point[i, b]
                for i in range(2):
                    drift_cross[i, a] += by_drift[i] * by_point[2, a]
            for i in range(2):
                result.corner_gradient[i] += by_drift[i] * error[2]
                for j in range(2):
                    result.corner[i, j] += by_drift[i] * by_drift[j]
            count += 1
        if count == 0 or normal[0, 0] == 0:
            continue
        _inverse(normal, inverse)
        for a in range(3):
            best[a] = inverse[a, 0] * gradient[0] + inverse[a, 1] * gradient[1] + inverse[a, 2] * gradient[2]
        for i in range(2):
            for a in range(3):
                result.corner_gradient[i] -= drift_cross[i, a] * best[a]
                for b in range(3):
                    for j in range(2):
                        result.corner[i, j] -= drift_cross[i, a] * inverse[a, b] * drift_cross[j, b]
        for i in range(count):
            for a in range(6):
                for b in range(3):
                    solved[a, b] = (
                        cross[i, a, 0] * inverse[0, b] + cross[i, a, 1] * inverse[1, b]
                        + cross[i, a, 2] * inverse[2, b]
                    )  # fmt: skip
                for b in range(3):
                    result.gradient[nodes[i], a] -= cross[i, a, b] * best[b]
                    for j in range(2):
                        result.side[nodes[i], a, j] -= solved[a, b] * drift_cross[j, b]
            for j in range(i + 1):
                block = result.band[nodes[j], nodes[i] - nodes[j]]
                for a in range(6):
                    for b in range(6):
                        block[a, b] -= (
                            cross[j, a, 0] * solved[b, 0] + cross[j, a, 1] * solved[b, 1]
                            + cross[j, a, 2] * solved[b, 2]
                        )  # fmt: skip


@kernel(fastmath=True)
def substitute(
    rig: Rig, sights: Sights, guess: Guess, pose_step: Float64, drift_step: Float64, points: Float64
) -> None:
    """The points (T, 3) after steps (M, 6) of the poses and (2,) of the drift."""
    error, by_pose, by_point, by_drift = np.empty(3), np.empty((3, 6)), np.empty((3, 3)), np.empty(2)
    room, normal, inverse, gradient = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    for t in range(len(sights.first) - 1):
        normal[:] = 0
        gradient[:] = 0
        for k in range(sights.first[t], sights.first[t + 1]):
            if not sights.used[k]:
                continue
            _rows(rig, sights, guess, k, t, error, by_pose, by_point, by_drift, room)
            error[2] += by_drift[0] * drift_step[0] + by_drift[1] * drift_step[1]
            for i in range(3):
                for a in range(6):
                    error[i] += by_pose[i, a] * pose_step[sights.node[k], a]
            for a in range(3):
                for i in range(3):
                    gradient[a] += by_point[i, a] * error[i]
                    for b in range(3):
                        normal[a, b] += by_point[i, a] * by_point[i, b]
        if normal[0, 0] == 0:
            continue
        _inverse(normal, inverse)
        for a in range(3):
            for b in range(3):
                points[t, a] -= inverse[a, b] * gradient[b]
