"""Project points into both cameras, with Jacobians by pose, point and rig, compiled.

Errors are predicted minus seen; poses move as GTSAM's do, by a small turn and shift in body axes. A point has
four unknowns: its position and its slide (`apparent_motion`), a turn of its image about the camera's axis.
The inner functions take plain arrays, no slices and no tuples of arrays: these would be reference-counted,
which costs more than the arithmetic.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from barsight.core.arrays import Bool, Float64, Int64, kernel

NEAREST_M = 0.05
BEHIND_SIGMAS = 100.0
"""Error, in sigma, that a point behind the camera counts with on each coordinate."""


class Rig(NamedTuple):
    """lens: (5,) focal px, cx, cy, focal times baseline (px m) and doffs px. mount: (3, 4) the left camera's
    axes and position in the body. huber: threshold on a whitened error's length of Huber's loss.
    """

    lens: Float64
    mount: Float64
    huber: float


class Observations(NamedTuple):
    """N sightings of T points, in the points' order. first: (T + 1,) the start of each point's sightings;
    node, used (N,); stereo (N, 3) u, v, right u; weight (N,) 1 / sigma. piece: (T,) the piece of the yard
    that a point belongs to; tight: (T,) 1 / rad, how tightly it is held to its piece's slide. scale: 1 where
    the rig's scale is observable, else 0.
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
    points (T, 4); shared (2 S + 2,): the slides of S pieces of the yard, their disparity biases (px), then
    the rig's drift.
    """

    camera: Float64
    points: Float64
    shared: Float64


class PointTerms(NamedTuple):
    """Values that a point's sightings share. huber, scale: as in `Rig` and `Observations`; off_px: disparity
    bias of its piece; yaw, drift: the rig's drift (rad, ratio).
    """

    huber: float
    scale: float
    off_px: float
    yaw: float
    drift: float


POINT, POSE, PLACE, SHARED = 1, 2, 8, 12
"""Columns of a sighting's rows (3, 13). Column 0: error, predicted minus seen; then the point in the left
camera; derivatives by the pose (6) and by the point (4); the last column holds, one below the other, those of
the right column by the piece's disparity bias and by the rig's drift.
"""


@kernel(inline=True)
def empty_rows() -> Float64:
    """Allocate a sighting's rows (3, 13)."""
    return np.empty((3, SHARED + 1))


@kernel(inline=True)
def _error(
    lens: Float64, camera: Float64, points: Float64, stereo: Float64, given: PointTerms, node: int,
    k: int, t: int, rows: Float64,
) -> bool:  # fmt: skip
    """Compute the error (px) of sighting k, of point t, in node's camera, the point there, and the
    derivatives by the shared unknowns. Returns False behind the camera.

    lens: (5,), see `Rig`. camera: (M, 3, 4), points: (T, 4), see `LinearisationPoint`. stereo: (N, 3), see
    `Observations`. Fills rows (3, 13).
    """
    x, y, z = points[t, 0], points[t, 1], points[t, 2]
    for i in range(3):
        rows[i, POINT] = (
            camera[node, i, 0] * x + camera[node, i, 1] * y + camera[node, i, 2] * z + camera[node, i, 3]
        )
    if rows[2, POINT] < NEAREST_M:
        return False
    z = 1 / rows[2, POINT]
    x, y = rows[0, POINT] * z, rows[1, POINT] * z
    slide = points[t, 3] * lens[0]
    u = lens[0] * x + lens[1]
    # By the predicted position: by the seen one, a scale would be favoured for shrinking the noise.
    across = x - lens[3] / lens[0] * z
    rows[0, SHARED] = -1.0
    rows[1, SHARED] = -lens[0] * (1 + across**2)
    rows[2, SHARED] = -given.scale * lens[3] * z
    shift = rows[1, SHARED] * given.yaw + rows[2, SHARED] * given.drift - given.off_px
    rows[0, 0] = u - slide * y - stereo[k, 0]
    rows[1, 0] = lens[0] * y + lens[2] + slide * x - stereo[k, 1]
    rows[2, 0] = u - slide * y - lens[3] * z + lens[4] + shift - stereo[k, 2]
    return True


@kernel(inline=True)
def slide_offset(points: Float64, shared: Float64, piece: Int64, t: int) -> float:
    """Subtract the piece's slide from a point's, rad.

    points: (T, 4), shared: (2 S + 2,), see `LinearisationPoint`; piece: (T,), see `Observations`.
    """
    off: float = points[t, 3]
    if len(shared) > 2:
        off -= shared[piece[t]]
    return off


@kernel(inline=True)
def disparity_offset(shared: Float64, piece: Int64, t: int) -> float:
    """Return the disparity bias of a point's piece, px.

    shared: (2 S + 2,), see `LinearisationPoint`; piece: (T,), see `Observations`.
    """
    pieces = (len(shared) - 2) // 2
    off: float = shared[pieces + piece[t]] if pieces > 0 else 0.0
    return off


@kernel(inline=True)
def given_of(rig: Rig, observations: Observations, shared: Float64, t: int) -> PointTerms:
    """Collect the values that the sightings of point t share.

    shared: (2 S + 2,), see `LinearisationPoint`.
    """
    last = len(shared) - 1
    off_px = disparity_offset(shared, observations.piece, t)
    return PointTerms(rig.huber, observations.scale, off_px, shared[last - 1], shared[last])


@kernel()
def residuals(rig: Rig, observations: Observations, guess: LinearisationPoint, result: Float64) -> float:
    """Compute residuals (N, 3) px, seen minus predicted, of the used sightings; return their robust cost."""
    lens, camera, points, shared = rig.lens, guess.camera, guess.points, guess.shared
    first, node, used, stereo, weight = (
        observations.first,
        observations.node,
        observations.used,
        observations.stereo,
        observations.weight,
    )
    rows, cost = empty_rows(), 0.0
    for t in range(len(first) - 1):
        seen, given = False, given_of(rig, observations, shared, t)
        for k in range(first[t], first[t + 1]):
            if not used[k]:
                continue
            seen = True
            if not _error(lens, camera, points, stereo, given, node[k], k, t, rows):
                rows[:, 0] = BEHIND_SIGMAS / weight[k]
            total = 0.0
            for i in range(3):
                result[k, i] = -rows[i, 0]
                total += rows[i, 0] ** 2
            size = np.sqrt(total) * weight[k]
            cost += size**2 / 2 if size < given.huber else given.huber * (size - given.huber / 2)
        if seen:
            cost += (observations.tight[t] * slide_offset(points, shared, observations.piece, t)) ** 2 / 2
    return cost


@kernel(inline=True)
def whitened_rows(
    lens: Float64, mount: Float64, camera: Float64, points: Float64, stereo: Float64, weight: float,
    given: PointTerms, at: tuple[int, int, int], rows: Float64,
) -> None:  # fmt: skip
    """Compute the whitened rows of a sighting; weight: its 1 / sigma; at: its node, its own index and its
    point's. All are 0 behind the camera.

    lens: (5,), mount: (3, 4), see `Rig`. camera: (M, 3, 4), points: (T, 4), see `LinearisationPoint`. stereo:
    (N, 3), see `Observations`. Fills rows (3, 13).
    """
    node, k, t = at
    if not _error(lens, camera, points, stereo, given, node, k, t, rows):
        rows[:] = 0
        return
    square = (rows[0, 0] ** 2 + rows[1, 0] ** 2 + rows[2, 0] ** 2) * weight**2
    if square > given.huber**2:
        weight *= np.sqrt(given.huber / np.sqrt(square))
    u, v, w = rows[0, POINT], rows[1, POINT], rows[2, POINT]
    x = mount[0, 0] * u + mount[0, 1] * v + mount[0, 2] * w + mount[0, 3]
    y = mount[1, 0] * u + mount[1, 1] * v + mount[1, 2] * w + mount[1, 3]
    z = mount[2, 0] * u + mount[2, 1] * v + mount[2, 2] * w + mount[2, 3]
    flat = 1 / w
    along, slope = weight * lens[0] * flat, weight * flat**2
    for i in range(3):
        axis = 1 if i == 1 else 0
        deep = -slope * lens[0] * rows[axis, POINT]
        if i == 2:
            deep += slope * lens[3]
        a = along * mount[0, axis] + deep * mount[0, 2]
        b = along * mount[1, axis] + deep * mount[1, 2]
        c = along * mount[2, axis] + deep * mount[2, 2]
        rows[i, POSE], rows[i, POSE + 1], rows[i, POSE + 2] = b * z - c * y, c * x - a * z, a * y - b * x
        rows[i, POSE + 3], rows[i, POSE + 4], rows[i, POSE + 5] = -a, -b, -c
        for j in range(3):
            rows[i, PLACE + j] = along * camera[node, axis, j] + deep * camera[node, 2, j]
        rows[i, PLACE + 3] = along * u if i == 1 else -along * v
        rows[i, 0] *= weight
        rows[i, SHARED] *= weight
