"""Project points to both cameras with Jacobians by pose, point and rig, compiled.

Errors are predicted minus seen; poses move as GTSAM's do, by a small turn and shift in body axes. A point has
four unknowns: its place, and how it slides (`slides`), a turn of its image about the camera's axis. The inner
functions take plain arrays and no slices of them: each view would be counted, which costs more than the sums.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from barsight.core.arrays import Bool, Float64, Int64, kernel

NEAREST_M = 0.05
BEHIND_SIGMAS = 100.0
"""What a point behind the camera is off by."""


class Rig(NamedTuple):
    """lens: (5,) focal px, cx, cy, focal times baseline (px m) and doffs px. mount: (3, 4) the left camera's
    axes and place in the body. huber: length of a whitened error from which its pull stays.
    """

    lens: Float64
    mount: Float64
    huber: float


class Observations(NamedTuple):
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


class LinearisationPoint(NamedTuple):
    """Linearisation point of the unknowns. camera: (M, 3, 4) left camera from reference, turn and shift;
    points (T, 4); shared (2 S + 2,): the slides of S pieces of the yard, what their disparity is too large by
    (px), then the rig's drift.
    """

    camera: Float64
    points: Float64
    shared: Float64


@kernel(fastmath=True, inline=True)
def _error(
    lens: Float64, camera: Float64, points: Float64, shared: Float64, off_px: float, scale: float,
    stereo: Float64, node: int, k: int, t: int, error: Float64, q: Float64, by_shared: Float64,
) -> bool:  # fmt: skip
    """Compute error (3,) px predicted minus seen; q (3,) the point in the left camera; by_shared (3,) how the
    right column goes with the piece's disparity, which is off_px too large, and the rig's drift. False behind
    the camera.
    """
    x, y, z = points[t, 0], points[t, 1], points[t, 2]
    for i in range(3):
        q[i] = camera[node, i, 0] * x + camera[node, i, 1] * y + camera[node, i, 2] * z + camera[node, i, 3]
    if q[2] < NEAREST_M:
        return False
    z, last = 1 / q[2], len(shared) - 1
    x, y = q[0] * z, q[1] * z
    slide = points[t, 3] * lens[0]
    u = lens[0] * x + lens[1]
    # By the predicted place: by the seen one, a scale would shrink the right picture's noise and be liked.
    across = x - lens[3] / lens[0] * z
    by_shared[0] = -1.0
    by_shared[1] = -lens[0] * (1 + across**2)
    by_shared[2] = -scale * lens[3] * z
    shift = by_shared[1] * shared[last - 1] + by_shared[2] * shared[last] - off_px
    error[0] = u - slide * y - stereo[k, 0]
    error[1] = lens[0] * y + lens[2] + slide * x - stereo[k, 1]
    error[2] = u - slide * y - lens[3] * z + lens[4] + shift - stereo[k, 2]
    return True


@kernel(fastmath=True, inline=True)
def slide_offset(points: Float64, shared: Float64, piece: Int64, t: int) -> float:
    """Subtract the piece's slide from a point's, rad."""
    off: float = points[t, 3]
    if len(shared) > 2:
        off -= shared[piece[t]]
    return off


@kernel(fastmath=True, inline=True)
def disparity_offset(shared: Float64, piece: Int64, t: int) -> float:
    """Return what a point's disparity is too large by with all of its piece, px."""
    pieces = (len(shared) - 2) // 2
    off: float = shared[pieces + piece[t]] if pieces > 0 else 0.0
    return off


@kernel(fastmath=True)
def residuals(rig: Rig, sights: Observations, guess: LinearisationPoint, result: Float64) -> float:
    """Compute residuals (N, 3) px, seen minus predicted, of the used sightings; returns their robust cost."""
    lens, huber, scale = rig.lens, rig.huber, sights.scale
    first, node, used, stereo, weight = sights.first, sights.node, sights.used, sights.stereo, sights.weight
    camera, points, shared = guess.camera, guess.points, guess.shared
    error, q, by_shared, cost = np.empty(3), np.empty(3), np.empty(3), 0.0
    for t in range(len(first) - 1):
        seen, off_px = False, disparity_offset(shared, sights.piece, t)
        for k in range(first[t], first[t + 1]):
            if not used[k]:
                continue
            seen = True
            if not _error(
                lens, camera, points, shared, off_px, scale, stereo, node[k], k, t, error, q, by_shared
            ):
                error[:] = BEHIND_SIGMAS / weight[k]
            total = 0.0
            for i in range(3):
                result[k, i] = -error[i]
                total += error[i] ** 2
            size = np.sqrt(total) * weight[k]
            cost += size**2 / 2 if size < huber else huber * (size - huber / 2)
        if seen:
            cost += (sights.tight[t] * slide_offset(points, shared, sights.piece, t)) ** 2 / 2
    return cost


@kernel(fastmath=True, inline=True)
def whitened_rows(
    lens: Float64, mount: Float64, huber: float, camera: Float64, points: Float64, shared: Float64,
    off_px: float, scale: float, stereo: Float64, weights: Float64, node: int, k: int, t: int, error: Float64,
    q: Float64, by_pose: Float64, by_point: Float64, by_shared: Float64,
) -> None:  # fmt: skip
    """Compute the whitened error (3,) of a sighting and its Jacobians: by_pose (3, 6), by_point (3, 4),
    by_shared (3,) of a sighting and its derivatives: by_pose (3, 6), by_point (3, 4), by_shared (3,) of its
    third row. q: (3,) scratch.
    """
    if not _error(lens, camera, points, shared, off_px, scale, stereo, node, k, t, error, q, by_shared):
        error[:] = 0
        by_pose[:] = 0
        by_point[:] = 0
        by_shared[:] = 0
        return
    weight = weights[k]
    square = (error[0] ** 2 + error[1] ** 2 + error[2] ** 2) * weight**2
    if square > huber**2:
        weight *= np.sqrt(huber / np.sqrt(square))
    x = mount[0, 0] * q[0] + mount[0, 1] * q[1] + mount[0, 2] * q[2] + mount[0, 3]
    y = mount[1, 0] * q[0] + mount[1, 1] * q[1] + mount[1, 2] * q[2] + mount[1, 3]
    z = mount[2, 0] * q[0] + mount[2, 1] * q[1] + mount[2, 2] * q[2] + mount[2, 3]
    flat = 1 / q[2]
    along, slope = weight * lens[0] * flat, weight * flat**2
    for i in range(3):
        axis = 1 if i == 1 else 0
        deep = -slope * lens[0] * q[axis]
        if i == 2:
            deep += slope * lens[3]
        a = along * mount[0, axis] + deep * mount[0, 2]
        b = along * mount[1, axis] + deep * mount[1, 2]
        c = along * mount[2, axis] + deep * mount[2, 2]
        by_pose[i, 0], by_pose[i, 1], by_pose[i, 2] = b * z - c * y, c * x - a * z, a * y - b * x
        by_pose[i, 3], by_pose[i, 4], by_pose[i, 5] = -a, -b, -c
        for j in range(3):
            by_point[i, j] = along * camera[node, axis, j] + deep * camera[node, 2, j]
        by_point[i, 3] = along * q[0] if i == 1 else -along * q[1]
        error[i] *= weight
    for c in range(3):
        by_shared[c] *= weight
