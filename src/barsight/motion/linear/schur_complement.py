"""Form the Schur complement of the points, which leaves poses and shared unknowns only.

A point is seen from a few nodes and coupled only to these, so its unknowns (three where nothing may slide,
else four) are eliminated point by point. With L L^T the point's own matrix, the equations of the unknowns
coupled to it lose U^T U, where U is L's inverse times the coupling: products along rows as long as its track,
which the processor computes four at a time.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from barsight.core.arrays import Float64, Int64, kernel
from barsight.core.linalg.skyline import Skyline
from barsight.motion.linear.reprojection_kernels import (
    PLACE,
    POSE,
    SHARED,
    LinearisationPoint,
    Observations,
    Rig,
    disparity_offset,
    empty_rows,
    given_of,
    slide_offset,
    whitened_rows,
)

NO_PIECES = np.empty((0, 2), np.int64)


class ReducedSystem(NamedTuple):
    """Reduced normal equations of poses and shared unknowns. band: (M, 6, 6 R) each pose with those of the
    nodes k - R + 1...k, of its own block the lower half; gradient (6 M,). The equations of the slide and
    disparity of S pieces (one where there are none) and of the rig's drift, from the piece's points: side (S,
    4, 6 Q) with the Q poses from node `first` (S,) on; corner (S, 4, 4), corner_gradient (S, 4) of
    themselves.
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


class Span(NamedTuple):
    """Location of a point in a reduced system. begun: the first node that sees it; piece, since: its piece,
    and the node at which that piece's side begins; begin: index from which the piece's slide, disparity and
    the drift count; size: number of the point's unknowns, 3 or 4.
    """

    begun: int
    piece: int
    since: int
    begin: int
    size: int


@kernel(inline=True)
def _factorise(m: Float64, size: int) -> None:
    """Replace the lower half of a symmetric matrix by its Cholesky factor with inverted diagonal.

    m: (4, 4), of which the first `size` rows and columns count.
    """
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


@kernel(inline=True)
def _add_point(rows: Float64, size: int, normal: Float64, gradient: Float64) -> None:
    """Add a sighting to its point's own equations: normal (4, 4), the lower half, and gradient (4,)."""
    for a in range(size):
        x, y, z = rows[0, PLACE + a], rows[1, PLACE + a], rows[2, PLACE + a]
        gradient[a] += x * rows[0, 0] + y * rows[1, 0] + z * rows[2, 0]
        for b in range(a + 1):
            normal[a, b] += x * rows[0, PLACE + b] + y * rows[1, PLACE + b] + z * rows[2, PLACE + b]


@kernel(inline=True)
def _add_pose(
    rows: Float64, span: Span, node: int, band: Float64, gradient: Float64, side: Float64, bound: Float64
) -> None:
    """Add a sighting to its pose's own equations and to those with the shared unknowns; write its coupling of
    pose and point to bound (4, 6 R).
    """
    own, first = band.shape[2] - 6, 6 * (node - span.begun)
    for a in range(6):
        x, y, z = rows[0, POSE + a], rows[1, POSE + a], rows[2, POSE + a]
        for b in range(a + 1):
            band[node, a, own + b] += x * rows[0, POSE + b] + y * rows[1, POSE + b] + z * rows[2, POSE + b]
        gradient[6 * node + a] += x * rows[0, 0] + y * rows[1, 0] + z * rows[2, 0]
        for c in range(max(span.begin, 1), 4):
            side[span.piece, c, 6 * (node - span.since) + a] += rows[c - 1, SHARED] * z
        for b in range(span.size):
            bound[b, first + a] = x * rows[0, PLACE + b] + y * rows[1, PLACE + b] + z * rows[2, PLACE + b]


@kernel(borrows=True)
def _take_out(
    bound: Float64, width: int, rest: Float64, factor: Float64, span: Span, result: ReducedSystem
) -> None:
    """Subtract U^T U, where U is the factor's inverse times the point's coupling: bound (4, width) with
    poses, rest (4, 5) with the piece's slide and disparity, the drift and the gradient.
    """
    band, gradient, side = result.band, result.gradient, result.side[span.piece]
    corner, corner_gradient = result.corner[span.piece], result.corner_gradient[span.piece]
    size, begun, begin, since = span.size, span.begun, span.begin, span.since
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
            line = band[begun + i, a, band.shape[2] - 6 * (i + 1) :]
            if size == 3:
                for b in range(len(line)):
                    line[b] -= x * b0[b] + y * b1[b] + z * b2[b]
            else:
                for b in range(len(line)):
                    line[b] -= x * b0[b] + y * b1[b] + z * b2[b] + w * b3[b]
    for c in range(begin, 5):
        x, y, z, w = rest[0, c], rest[1, c], rest[2, c], rest[3, c]
        whole, left = (gradient, begun) if c == 4 else (side[c], begun - since)
        line = whole[6 * left : 6 * left + width]
        for a in range(len(line)):
            line[a] -= x * b0[a] + y * b1[a] + z * b2[a] + w * b3[a]
    for c in range(begin, 4):
        for k in range(4):
            corner_gradient[c] -= rest[k, c] * rest[k, 4]
            for d in range(begin, 4):
                corner[c, d] -= rest[k, c] * rest[k, d]


@kernel()
def eliminate_points(
    rig: Rig, observations: Observations, guess: LinearisationPoint, result: ReducedSystem
) -> None:
    """Form the Schur complement of the points over all used sightings and add it to `result`."""
    lens, mount, camera, points, shared = rig.lens, rig.mount, guess.camera, guess.points, guess.shared
    first, node, used, stereo, weight = (
        observations.first,
        observations.node,
        observations.used,
        observations.stereo,
        observations.weight,
    )
    band, slope, sides = result.band, result.gradient, result.side
    rows, normal, gradient, rest = empty_rows(), np.empty((4, 4)), np.empty(4), np.empty((4, 5))
    bound = np.empty((4, band.shape[2]))
    begin, size = (0, 4) if len(shared) > 2 else (2, 3)
    for t in range(len(first) - 1):
        normal[:], gradient[:], rest[:] = 0.0, 0.0, 0.0
        begun, end, own, given = -1, -1, observations.piece[t], given_of(rig, observations, shared, t)
        since, corner, corner_slope = result.first[own], result.corner[own], result.corner_gradient[own]
        for k in range(first[t], first[t + 1]):
            if not used[k]:
                continue
            n = node[k]
            if begun < 0:
                begun = n
                bound[:] = 0.0
            end = n + 1
            whitened_rows(lens, mount, camera, points, stereo, weight[k], given, (n, k, t), rows)
            _add_point(rows, size, normal, gradient)
            _add_pose(rows, Span(begun, own, since, begin, size), n, band, slope, sides, bound)
            for c in range(max(begin, 1), 4):
                corner_slope[c] += rows[c - 1, SHARED] * rows[2, 0]
                for d in range(max(begin, 1), 4):
                    corner[c, d] += rows[c - 1, SHARED] * rows[d - 1, SHARED]
                for a in range(size):
                    rest[a, c] += rows[c - 1, SHARED] * rows[2, PLACE + a]
        if begun < 0 or normal[0, 0] == 0:
            continue
        if begin == 0:
            held = observations.tight[t] ** 2
            pull = held * slide_offset(points, shared, observations.piece, t)
            normal[3, 3] += held
            gradient[3] += pull
            rest[3, 0] = -held
            corner[0, 0] += held
            corner_slope[0] -= pull
        for a in range(size):
            rest[a, 4] = gradient[a]
        _factorise(normal, size)
        _take_out(bound, 6 * (end - begun), rest, normal, Span(begun, own, since, begin, size), result)


@kernel()
def scatter_reduced(
    reduced: ReducedSystem, node: Int64, piece: Int64, rows: Skyline, gradient: Float64, side: Float64,
    corner: Float64, corner_gradient: Float64,
) -> None:  # fmt: skip
    """Scatter `reduced` into the equations of all unknowns, in the order of `Ordering`; the rig's drift comes
    last in the border.

    node: (M,) index of each node's first unknown; piece: (S,) of each piece's, empty where there are none.
    Adds to rows, gradient (N,) and, of the border, side (B, N), corner (B, B), corner_gradient (B,).
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


@kernel()
def back_substitute(
    rig: Rig,
    observations: Observations,
    guess: LinearisationPoint,
    pose_step: Float64,
    shared_step: Float64,
    moved: Float64,
    variance: Float64,
) -> None:
    """Back-substitute the points `moved` (T, 4) after steps (M, 6) of the poses and (2 S + 2,) of the shared
    unknowns; variance: (T,) of each point's slide with all else taken as known.
    """
    lens, mount, camera, points, shared = rig.lens, rig.mount, guess.camera, guess.points, guess.shared
    first, node, used, stereo, weight = (
        observations.first,
        observations.node,
        observations.used,
        observations.stereo,
        observations.weight,
    )
    rows, normal, gradient, last = empty_rows(), np.empty((4, 4)), np.empty(4), len(shared_step) - 1
    size = 4 if last > 1 else 3
    for t in range(len(first) - 1):
        normal[:], gradient[:], given = 0.0, 0.0, given_of(rig, observations, shared, t)
        step = disparity_offset(shared_step, observations.piece, t)
        for k in range(first[t], first[t + 1]):
            if not used[k]:
                continue
            n = node[k]
            whitened_rows(lens, mount, camera, points, stereo, weight[k], given, (n, k, t), rows)
            rows[2, 0] += rows[0, SHARED] * step + rows[1, SHARED] * shared_step[last - 1]
            rows[2, 0] += rows[2, SHARED] * shared_step[last]
            for i in range(3):
                for a in range(6):
                    rows[i, 0] += rows[i, POSE + a] * pose_step[n, a]
            _add_point(rows, size, normal, gradient)
        if normal[0, 0] == 0:
            continue
        if size == 4:
            held, off = (
                observations.tight[t] ** 2,
                slide_offset(points, shared, observations.piece, t) - shared_step[observations.piece[t]],
            )
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
