"""Form the Schur complement of the points: what is left binds poses and shared unknowns only.

A point is seen from a few nodes and binds only these, so its unknowns (three where nothing may slide, else
four) are eliminated where it stands (Schur's complement). With L L^T its own matrix, what it binds loses
U^T U, U being L's inverse times what it shares with each: products along rows as long as its track, which
the processor takes four at a time.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from barsight.core.arrays import Float64, Int64, kernel
from barsight.core.linalg.skyline import Skyline
from barsight.motion.linear.reprojection_kernels import (
    LinearisationPoint,
    Observations,
    Rig,
    disparity_offset,
    slide_offset,
    whitened_rows,
)

NO_PIECES = np.empty((0, 2), np.int64)


class ReducedSystem(NamedTuple):
    """Reduced normal equations of poses and what is shared. band: (M, 6, 6 R) of each pose with those of the
    nodes k - R + 1...k, of its own block the lower half; gradient (6 M,). What points of S pieces (one where
    there are none) say of their piece's slide and disparity and of the rig's drift: side (S, 4, 6 Q) with the
    Q poses from node `first` (S,) on; corner (S, 4, 4), corner_gradient (S, 4) of itself.
    """

    band: Float64
    gradient: Float64
    first: Int64
    side: Float64
    corner: Float64
    corner_gradient: Float64

    @classmethod
    def empty(cls, nodes: int, reach: int, seen: Int64 = NO_PIECES) -> ReducedSystem:
        """Allocate zeros. seen: (S, 2) the first and last node that see a piece."""
        first, longest = np.zeros(1, np.int64), nodes
        if len(seen):
            first, longest = seen[:, 0].copy(), int((seen[:, 1] - seen[:, 0]).max()) + 1
        return cls(
            np.zeros((nodes, 6, 6 * reach)), np.zeros(6 * nodes), first,
            np.zeros((len(first), 4, 6 * longest)), np.zeros((len(first), 4, 4)), np.zeros((len(first), 4)),
        )  # fmt: skip


@kernel(fastmath=True, inline=True)
def _factorise(m: Float64, size: int) -> None:
    """Replace a symmetric matrix's lower half by its Cholesky factor, the diagonal by that one's inverse."""
    for i in range(size):
        for j in range(i):
            total = m[i, j]
            for k in range(j):
                total -= m[i, k] * m[j, k]
            m[i, j] = total * m[j, j]
        own = m[i, i]
        for k in range(i):
            own -= m[i, k] * m[i, k]
        m[i, i] = 1 / np.sqrt(own)


@kernel(fastmath=True, inline=True)
def _add_point(error: Float64, by_point: Float64, size: int, normal: Float64, gradient: Float64) -> None:
    """Add a sighting's part of its point's own equations; of the matrix the lower half."""
    for a in range(size):
        gradient[a] += by_point[0, a] * error[0] + by_point[1, a] * error[1] + by_point[2, a] * error[2]
        for b in range(a + 1):
            normal[a, b] += (
                by_point[0, a] * by_point[0, b] + by_point[1, a] * by_point[1, b]
                + by_point[2, a] * by_point[2, b]
            )  # fmt: skip


@kernel(fastmath=True, inline=True)
def _add_pose(
    error: Float64, by_pose: Float64, by_point: Float64, by_shared: Float64, node: int, first: int,
    piece: int, since: int, begin: int, band: Float64, gradient: Float64, side: Float64, size: int,
    bound: Float64,
) -> None:  # fmt: skip
    """Add a sighting's part of its pose's own equations and of those with what is shared (since, begin: as
    `_take_out` has them); bound (4, 6 R) from column `first` on with its point.
    """
    own = band.shape[2] - 6
    for a in range(6):
        x, y, z = by_pose[0, a], by_pose[1, a], by_pose[2, a]
        for b in range(a + 1):
            band[node, a, own + b] += x * by_pose[0, b] + y * by_pose[1, b] + z * by_pose[2, b]
        gradient[6 * node + a] += x * error[0] + y * error[1] + z * error[2]
        for c in range(max(begin, 1), 4):
            side[piece, c, 6 * (node - since) + a] += by_shared[c - 1] * z
        for b in range(size):
            bound[b, first + a] = x * by_point[0, b] + y * by_point[1, b] + z * by_point[2, b]


@kernel(fastmath=True)
def _take_out(
    bound: Float64, width: int, first: int, factor: Float64, size: int, rest: Float64, since: int, begin: int,
    band: Float64, gradient: Float64, side: Float64, corner: Float64, corner_gradient: Float64,
) -> None:  # fmt: skip
    """Subtract U^T U, U being the factor's inverse times what the point shares: bound (4, width) with the
    poses of nodes from `first` on, rest (4, 5) with the piece's slide and disparity, drift and gradient; of
    the shared ones those from `begin` on count. side (its first node is `since`), corner, corner_gradient:
    the piece's.
    """
    for i in range(size):
        mine = bound[i, :width]
        for j in range(i):
            share, other = factor[i, j], bound[j, :width]
            for a in range(width):
                mine[a] -= share * other[a]
            for b in range(5):
                rest[i, b] -= share * rest[j, b]
        share = factor[i, i]
        for a in range(width):
            mine[a] *= share
        for b in range(5):
            rest[i, b] *= share
    b0, b1, b2, b3 = bound[0, :width], bound[1, :width], bound[2, :width], bound[3, :width]
    for i in range(width // 6):
        for a in range(6):
            x, y, z, w = b0[6 * i + a], b1[6 * i + a], b2[6 * i + a], b3[6 * i + a]
            line = band[first + i, a, band.shape[2] - 6 * (i + 1) :]
            if size == 3:
                for b in range(len(line)):
                    line[b] -= x * b0[b] + y * b1[b] + z * b2[b]
            else:
                for b in range(len(line)):
                    line[b] -= x * b0[b] + y * b1[b] + z * b2[b] + w * b3[b]
    for c in range(begin, 5):
        x, y, z, w = rest[0, c], rest[1, c], rest[2, c], rest[3, c]
        whole, left = (gradient, first) if c == 4 else (side[c], first - since)
        line = whole[6 * left : 6 * left + width]
        for a in range(len(line)):
            line[a] -= x * b0[a] + y * b1[a] + z * b2[a] + w * b3[a]
    for c in range(begin, 4):
        for k in range(4):
            corner_gradient[c] -= rest[k, c] * rest[k, 4]
            for d in range(begin, 4):
                corner[c, d] -= rest[k, c] * rest[k, d]


@kernel(fastmath=True)
def eliminate_points(
    rig: Rig, sights: Observations, guess: LinearisationPoint, result: ReducedSystem
) -> None:
    """Form the Schur complement of the points over all used sightings and add it to `result`."""
    lens, mount, huber, scale, tight = rig.lens, rig.mount, rig.huber, sights.scale, sights.tight
    first, node, used, stereo, weight = sights.first, sights.node, sights.used, sights.stereo, sights.weight
    camera, points, shared, piece = guess.camera, guess.points, guess.shared, sights.piece
    band, slope, begun_at, sides, corners, corner_slopes = result
    error, q, by_shared, by_pose, by_point = (
        np.empty(3), np.empty(3), np.empty(3), np.empty((3, 6)), np.empty((3, 4)),
    )  # fmt: skip
    normal, gradient, rest, last = np.empty((4, 4)), np.empty(4), np.empty((4, 5)), len(shared) - 1
    bound = np.empty((4, band.shape[2]))
    begin, size = (0, 4) if last > 1 else (2, 3)
    for t in range(len(first) - 1):
        normal[:], gradient[:], rest[:] = 0.0, 0.0, 0.0
        begun, end, off_px = -1, -1, disparity_offset(shared, piece, t)
        own = piece[t]
        since, corner, corner_slope = begun_at[own], corners[own], corner_slopes[own]
        for k in range(first[t], first[t + 1]):
            if not used[k]:
                continue
            n = node[k]
            if begun < 0:
                begun = n
                bound[:] = 0.0
            end = n + 1
            whitened_rows(
                lens, mount, huber, camera, points, shared, off_px, scale, stereo, weight, n, k, t, error, q,
                by_pose, by_point, by_shared,
            )  # fmt: skip
            _add_point(error, by_point, size, normal, gradient)
            _add_pose(
                error, by_pose, by_point, by_shared, n, 6 * (n - begun), own, since, begin, band, slope,
                sides, size, bound,
            )  # fmt: skip
            for c in range(max(begin, 1), 4):
                corner_slope[c] += by_shared[c - 1] * error[2]
                for d in range(max(begin, 1), 4):
                    corner[c, d] += by_shared[c - 1] * by_shared[d - 1]
                for a in range(size):
                    rest[a, c] += by_shared[c - 1] * by_point[2, a]
        if begun < 0 or normal[0, 0] == 0:
            continue
        if begin == 0:
            held = tight[t] ** 2
            pull = held * slide_offset(points, shared, piece, t)
            normal[3, 3] += held
            gradient[3] += pull
            rest[3, 0] = -held
            corner[0, 0] += held
            corner_slope[0] -= pull
        for a in range(size):
            rest[a, 4] = gradient[a]
        _factorise(normal, size)
        width = 6 * (end - begun)
        side = sides[own]
        _take_out(
            bound, width, begun, normal, size, rest, since, begin, band, slope, side, corner, corner_slope
        )


@kernel(fastmath=True)
def scatter_reduced(
    reduced: ReducedSystem, node: Int64, piece: Int64, rows: Skyline, gradient: Float64, side: Float64,
    corner: Float64, corner_gradient: Float64,
) -> None:  # fmt: skip
    """Scatter `reduced` into the equations of all unknowns, which stand as `Layout` has them; the rig's drift
    is the border's last.
    """
    band, slope, first, sides, corners, corner_slopes = reduced
    values, offset = rows.values, rows.offset
    nodes, reach, last = len(node), band.shape[2] // 6, len(corner) - 2
    for k in range(nodes):
        for a in range(6):
            row = node[k] + a
            gradient[row] += slope[6 * k + a]
            for n in range(max(0, k - reach + 1), k + 1):
                if node[n] < rows.first[row]:
                    continue
                column, begin = offset[row] + node[n], 6 * (reach - 1 - k + n)
                for b in range(a + 1 if n == k else 6):
                    values[column + b] += band[k, a, begin + b]
    for p in range(len(first)):
        for n in range(min(sides.shape[2] // 6, nodes - first[p])):
            at = node[first[p] + n]
            for a in range(6):
                for c in range(2):
                    side[last + c, at + a] += sides[p, 2 + c, 6 * n + a]
                    if len(piece) and at < piece[p]:
                        values[offset[piece[p] + c] + at + a] += sides[p, c, 6 * n + a]
        for c in range(2):
            corner_gradient[last + c] += corner_slopes[p, 2 + c]
            for d in range(2):
                corner[last + c, last + d] += corners[p, 2 + c, 2 + d]
        if len(piece):
            for c in range(2):
                row = piece[p] + c
                gradient[row] += corner_slopes[p, c]
                for d in range(2):
                    side[last + d, row] += corners[p, c, 2 + d]
                    if d <= c:
                        values[offset[row] + piece[p] + d] += corners[p, c, d]


@kernel(fastmath=True)
def back_substitute(
    rig: Rig,
    sights: Observations,
    guess: LinearisationPoint,
    pose_step: Float64,
    shared_step: Float64,
    moved: Float64,
    variance: Float64,
) -> None:
    """Back-substitute the points `moved` (T, 4) after steps (M, 6) of the poses and (2 S + 2,) of what is
    shared; variance (T,) of each point's slide, all else taken as known.
    """
    lens, mount, huber, scale, tight = rig.lens, rig.mount, rig.huber, sights.scale, sights.tight
    first, node, used, stereo, weight = sights.first, sights.node, sights.used, sights.stereo, sights.weight
    camera, points, shared, piece = guess.camera, guess.points, guess.shared, sights.piece
    error, q, by_shared, by_pose, by_point = (
        np.empty(3), np.empty(3), np.empty(3), np.empty((3, 6)), np.empty((3, 4)),
    )  # fmt: skip
    normal, gradient, last = np.empty((4, 4)), np.empty(4), len(shared_step) - 1
    size = 4 if last > 1 else 3
    for t in range(len(first) - 1):
        normal[:], gradient[:], off_px = 0.0, 0.0, disparity_offset(shared, piece, t)
        step = disparity_offset(shared_step, piece, t)
        for k in range(first[t], first[t + 1]):
            if not used[k]:
                continue
            n = node[k]
            whitened_rows(
                lens, mount, huber, camera, points, shared, off_px, scale, stereo, weight, n, k, t, error, q,
                by_pose, by_point, by_shared,
            )  # fmt: skip
            error[2] += by_shared[0] * step + by_shared[1] * shared_step[last - 1]
            error[2] += by_shared[2] * shared_step[last]
            for i in range(3):
                for a in range(6):
                    error[i] += by_pose[i, a] * pose_step[n, a]
            _add_point(error, by_point, size, normal, gradient)
        if normal[0, 0] == 0:
            continue
        if size == 4:
            held, off = tight[t] ** 2, slide_offset(points, shared, piece, t) - shared_step[piece[t]]
            normal[3, 3] += held
            gradient[3] += held * off
        _factorise(normal, size)
        variance[t] = normal[size - 1, size - 1] ** 2
        for i in range(size):
            for j in range(i):
                gradient[i] -= normal[i, j] * gradient[j]
            gradient[i] *= normal[i, i]
        for i in range(size - 1, -1, -1):
            for j in range(i + 1, size):
                gradient[i] -= normal[j, i] * gradient[j]
            gradient[i] *= normal[i, i]
            moved[t, i] -= gradient[i]
