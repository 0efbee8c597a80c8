"""Where points must be seen in both cameras, and how that goes with poses, points and the rig.

Errors are predicted minus seen; poses move as GTSAM's do, by a small turn and shift in body axes. A point has
four unknowns: its place, and how it slides (`slides`), a turn of its image about the camera's axis.
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
    stereo (N, 3) u, v, right u; weight (N,) 1 / sigma. piece: (T,) which piece of the yard a point is of;
    tight: (T,) 1 / rad, how it is held to the piece's slide. scale: 1 where the rig's scale is seen, else 0.
    """

    first: Int64
    node: Int64
    used: Bool
    stereo: Float64
    weight: Float64
    piece: Int64
    tight: Float64
    scale: float


class Guess(NamedTuple):
    """Where the unknowns are: turn (M, 3, 3), place (M, 3) of the body; points (T, 4); shared (S + 2,): the
    slides of S pieces of the yard, then the rig's drift.
    """

    turn: Float64
    place: Float64
    points: Float64
    shared: Float64


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
    shift = by_drift[0] * guess.shared[-2] + by_drift[1] * guess.shared[-1]
    error[2] = u - rig.lens[3] / q[2] + rig.lens[4] + shift - sights.stereo[k, 2]
    along, down = -point[3] * rig.lens[0] * q[1] / q[2], point[3] * rig.lens[0] * q[0] / q[2]
    error[0] += along
    error[1] += down
    error[2] += along
    return True


@kernel(fastmath=True)
def slide_off(sights: Sights, guess: Guess, t: int) -> float:
    """How much further a point slides than its piece, rad."""
    common = guess.shared[sights.piece[t]] if len(guess.shared) > 2 else 0.0
    off: float = guess.points[t, 3] - common
    return off


@kernel(fastmath=True)
def residuals(rig: Rig, sights: Sights, guess: Guess, result: Float64) -> float:
    """Seen minus predicted (N, 3) px of the used sightings; returns their robust cost."""
    error, body, q, by_drift, cost = np.empty(3), np.empty(3), np.empty(3), np.empty(2), 0.0
    for t in range(len(sights.first) - 1):
        seen = False
        for k in range(sights.first[t], sights.first[t + 1]):
            if not sights.used[k]:
                continue
            seen = True
            if not _error(rig, sights, guess, k, t, error, body, q, by_drift):
                error[:] = BEHIND_SIGMAS / sights.weight[k]
            total = 0.0
            for i in range(3):
                result[k, i] = -error[i]
                total += error[i] ** 2
            size = np.sqrt(total) * sights.weight[k]
            cost += size**2 / 2 if size < rig.huber else rig.huber * (size - rig.huber / 2)
        if seen:
            cost += (sights.tight[t] * slide_off(sights, guess, t)) ** 2 / 2
    return cost


@kernel(fastmath=True)
def rows(
    rig: Rig, sights: Sights, guess: Guess, k: int, t: int, error: Float64, by_pose: Float64,
    by_point: Float64, by_drift: Float64, room: Float64,
) -> None:  # fmt: skip
    """The whitened error (3,) of a sighting and its derivatives: by_pose (3, 6), by_point (3, 4), by_drift
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
        by_point[i, 3] = f * q[0] / z if i == 1 else -f * q[1] / z
        by_pose[i, 0] = b * body[2] - c * body[1]
        by_pose[i, 1] = c * body[0] - a * body[2]
        by_pose[i, 2] = a * body[1] - b * body[0]
        by_pose[i, 3], by_pose[i, 4], by_pose[i, 5] = -a, -b, -c
        error[i] *= weight
    by_drift[0] *= weight
    by_drift[1] *= weight
