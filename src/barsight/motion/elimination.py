"""Points taken out of the normal equations: what is left binds poses and what is shared only.

A point is seen from a few nodes and binds only these, so its four unknowns are eliminated where it stands
(Schur's complement), which costs a few hundred products a sighting.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from barsight.core.arrays import Float64, kernel
from barsight.motion.point_kernels import Guess, Rig, Sights, rows, slide_off


class Reduced(NamedTuple):
    """Normal equations of poses and what is shared. band: (M, R, 6, 6) of node k with node k + r; gradient
    (M, 6); side (M, 6, S + 2) with what is shared; corner (S + 2, S + 2), corner_gradient (S + 2,) of itself.
    """

    band: Float64
    gradient: Float64
    side: Float64
    corner: Float64
    corner_gradient: Float64


@kernel(fastmath=True)
def _inverse(m: Float64, result: Float64) -> None:
    """Of a symmetric (4, 4): its first three rows' inverse, and the fourth by its Schur complement."""
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
    own = m[3, 3]
    for i in range(3):
        result[3, i] = result[i, 0] * m[0, 3] + result[i, 1] * m[1, 3] + result[i, 2] * m[2, 3]
        own -= result[3, i] * m[i, 3]
    result[3, 3] = 1 / own
    for i in range(3):
        for j in range(3):
            result[i, j] += result[3, i] * result[3, j] / own
    for i in range(3):
        result[3, i] /= -own
        result[i, 3] = result[3, i]


@kernel(fastmath=True)
def eliminate(rig: Rig, sights: Sights, guess: Guess, result: Reduced) -> None:
    """Adds all used sightings to `result`."""
    most = 1
    for t in range(len(sights.first) - 1):
        most = max(most, sights.first[t + 1] - sights.first[t])
    error, by_pose, by_point, by_drift = np.empty(3), np.empty((3, 6)), np.empty((3, 4)), np.empty(2)
    room, nodes = np.empty((3, 3)), np.empty(most, np.int64)
    # A point's share of the rows of poses and of what is shared: (6, 4) a node, and its inverse times these.
    cross, solved, shared_cross = np.empty((most, 6, 4)), np.empty((6, 4)), np.empty((3, 4))
    normal, inverse, gradient, best = np.empty((4, 4)), np.empty((4, 4)), np.empty(4), np.empty(4)
    last = len(guess.shared) - 1
    begin = 0 if last > 1 else 1
    at = np.array([0, last - 1, last])
    for t in range(len(sights.first) - 1):
        normal[:] = 0
        gradient[:] = 0
        shared_cross[:] = 0
        count = 0
        for k in range(sights.first[t], sights.first[t + 1]):
            if not sights.used[k]:
                continue
            rows(rig, sights, guess, k, t, error, by_pose, by_point, by_drift, room)
            node = sights.node[k]
            nodes[count] = node
            block = result.band[node, 0]
            for a in range(6):
                for b in range(6):
                    block[a, b] += (
                        by_pose[0, a] * by_pose[0, b] + by_pose[1, a] * by_pose[1, b]
                        + by_pose[2, a] * by_pose[2, b]
                    )  # fmt: skip
                for b in range(4):
                    cross[count, a, b] = (
                        by_pose[0, a] * by_point[0, b] + by_pose[1, a] * by_point[1, b]
                        + by_pose[2, a] * by_point[2, b]
                    )  # fmt: skip
                result.gradient[node, a] += (
                    by_pose[0, a] * error[0] + by_pose[1, a] * error[1] + by_pose[2, a] * error[2]
                )
                for i in range(2):
                    result.side[node, a, at[i + 1]] += by_drift[i] * by_pose[2, a]
            for a in range(4):
                for i in range(3):
                    gradient[a] += by_point[i, a] * error[i]
                    for b in range(4):
                        normal[a, b] += by_point[i, a] * by_point[i, b]
                for i in range(2):
                    shared_cross[i + 1, a] += by_drift[i] * by_point[2, a]
            for i in range(2):
                result.corner_gradient[at[i + 1]] += by_drift[i] * error[2]
                for j in range(2):
                    result.corner[at[i + 1], at[j + 1]] += by_drift[i] * by_drift[j]
            count += 1
        if count == 0 or normal[0, 0] == 0:
            continue
        held = sights.tight[t] ** 2
        off = slide_off(sights, guess, t)
        normal[3, 3] += held
        gradient[3] += held * off
        if begin == 0:
            at[0] = sights.piece[t]
            shared_cross[0, 3] = -held
            result.corner[at[0], at[0]] += held
            result.corner_gradient[at[0]] -= held * off
        _inverse(normal, inverse)
        best[:] = 0
        for a in range(4):
            for b in range(4):
                best[a] += inverse[a, b] * gradient[b]
        for i in range(begin, 3):
            for a in range(4):
                result.corner_gradient[at[i]] -= shared_cross[i, a] * best[a]
                for b in range(4):
                    for j in range(begin, 3):
                        result.corner[at[i], at[j]] -= shared_cross[i, a] * inverse[a, b] * shared_cross[j, b]
        for i in range(count):
            for a in range(6):
                for b in range(4):
                    solved[a, b] = (
                        cross[i, a, 0] * inverse[0, b] + cross[i, a, 1] * inverse[1, b]
                        + cross[i, a, 2] * inverse[2, b] + cross[i, a, 3] * inverse[3, b]
                    )  # fmt: skip
                for b in range(4):
                    result.gradient[nodes[i], a] -= cross[i, a, b] * best[b]
                    for j in range(begin, 3):
                        result.side[nodes[i], a, at[j]] -= solved[a, b] * shared_cross[j, b]
            for j in range(i + 1):
                block = result.band[nodes[j], nodes[i] - nodes[j]]
                for a in range(6):
                    for b in range(6):
                        block[a, b] -= (
                            cross[j, a, 0] * solved[b, 0] + cross[j, a, 1] * solved[b, 1]
                            + cross[j, a, 2] * solved[b, 2] + cross[j, a, 3] * solved[b, 3]
                        )  # fmt: skip


@kernel(fastmath=True)
def substitute(
    rig: Rig, sights: Sights, guess: Guess, pose_step: Float64, shared_step: Float64, points: Float64,
    variance: Float64,
) -> None:  # fmt: skip
    """The points (T, 4) after steps (M, 6) of the poses and (S + 2,) of what is shared; variance (T,) of each
    point's slide, all else taken as known.
    """
    error, by_pose, by_point, by_drift = np.empty(3), np.empty((3, 6)), np.empty((3, 4)), np.empty(2)
    room, normal, inverse, gradient = np.empty((3, 3)), np.empty((4, 4)), np.empty((4, 4)), np.empty(4)
    for t in range(len(sights.first) - 1):
        normal[:] = 0
        gradient[:] = 0
        for k in range(sights.first[t], sights.first[t + 1]):
            if not sights.used[k]:
                continue
            rows(rig, sights, guess, k, t, error, by_pose, by_point, by_drift, room)
            error[2] += by_drift[0] * shared_step[-2] + by_drift[1] * shared_step[-1]
            for i in range(3):
                for a in range(6):
                    error[i] += by_pose[i, a] * pose_step[sights.node[k], a]
            for a in range(4):
                for i in range(3):
                    gradient[a] += by_point[i, a] * error[i]
                    for b in range(4):
                        normal[a, b] += by_point[i, a] * by_point[i, b]
        if normal[0, 0] == 0:
            continue
        held, off = sights.tight[t] ** 2, slide_off(sights, guess, t)
        if len(shared_step) > 2:
            off -= shared_step[sights.piece[t]]
        normal[3, 3] += held
        gradient[3] += held * off
        _inverse(normal, inverse)
        variance[t] = inverse[3, 3]
        for a in range(4):
            for b in range(4):
                points[t, a] -= inverse[a, b] * gradient[b]
