"""Eliminate nodes between frames, which no picture sees, before all others.

Only the IMU and the encoders constrain them, each by its neighbours: between two frames they form a small
system of their own. The band that remains is as wide as the longest track in frames, not in nodes.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from barsight.core.arrays import Float64, Int64, kernel
from barsight.core.linalg import skyline
from barsight.core.linalg.skyline import Skyline


class Chain(NamedTuple):
    """Normal equations of M nodes with n unknowns each, which are coupled only to their neighbours and to S
    unknowns of the encoders. own (M, n, n): each node's block; link (M, n, n): each node (rows) with the one
    before, 0 for the first; gradient (M, n); side (M, n, S): with the encoders' unknowns; corner (S, S),
    corner_gradient (S,): of these alone.
    """

    own: Float64
    link: Float64
    gradient: Float64
    side: Float64
    corner: Float64
    corner_gradient: Float64

    @classmethod
    def empty(cls, nodes: int, size: int, shared: int) -> Chain:
        """Allocate zeros."""
        blocks, rows = (nodes, size, size), (nodes, size)
        return cls(
            np.zeros(blocks), np.zeros(blocks), np.zeros(rows), np.zeros((*rows, shared)),
            np.zeros((shared, shared)), np.zeros(shared),
        )  # fmt: skip

    def at(self, nodes: Int64 | slice) -> Chain:
        """Select nodes, dropping the coupling of the first one to the node before it."""
        link = self.link[nodes].copy()
        link[:1] = 0.0
        return Chain(
            self.own[nodes], link, self.gradient[nodes], self.side[nodes], self.corner.copy(),
            self.corner_gradient.copy(),
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class EliminatedNodes:
    """Eliminated nodes first...end - 1. answer: (m n, 2 n + S + 1) their linear dependence on the kept nodes
    before and after and on the encoders' unknowns, and a constant.
    """

    first: int
    end: int
    answer: Float64


def eliminate_nodes(chain: Chain, kept: Int64) -> tuple[Chain, tuple[EliminatedNodes, ...]]:
    """Form the Schur complement on the nodes `kept` (K,); also return the eliminated nodes. Raises
    LinAlgError where the sensors leave a node in between undetermined.
    """
    left, gaps = chain.at(kept), []
    for k, (before, after) in enumerate(pairwise([-1, *kept.tolist(), len(chain.own)])):
        if after - before > 1:
            gaps.append(_take_out(chain, before + 1, after, k, left))
    return left, tuple(gaps)


def _take_out(chain: Chain, first: int, end: int, k: int, left: Chain) -> EliminatedNodes:
    """Eliminate the nodes first...end - 1, which lie between the kept nodes k - 1 and k where these exist."""
    size, nodes = chain.own.shape[1], slice(first, end)
    right = np.zeros((end - first, size, 2 * size + len(chain.corner) + 1))
    right[0, :, :size] = chain.link[first]
    if end < len(chain.own):
        right[-1, :, size : 2 * size] = chain.link[end].T
    right[..., 2 * size : -1], right[..., -1] = chain.side[nodes], chain.gradient[nodes]
    right = right.reshape(-1, right.shape[2])
    at = size * np.arange(end - first)
    band = skyline.empty_skyline(np.repeat(np.maximum(at - size, 0), size))
    add_chain(chain.at(nodes), at, band)
    if not skyline.factorise_skyline(band):
        raise np.linalg.LinAlgError("the measurements leave an unknown undetermined")
    skyline.solve_forward(band, right)
    taken = right.T @ right
    skyline.solve_back_dense(band, right)
    for node, part in ((k - 1, slice(size)), (k, slice(size, 2 * size))):
        if 0 <= node < len(left.own):
            left.own[node] -= taken[part, part]
            left.side[node] -= taken[part, 2 * size : -1]
            left.gradient[node] -= taken[part, -1]
    if 0 < k < len(left.own):
        left.link[k] = -taken[size : 2 * size, :size]
    left.corner[:] -= taken[2 * size : -1, 2 * size : -1]
    left.corner_gradient[:] -= taken[2 * size : -1, -1]
    return EliminatedNodes(first, end, right)


@kernel()
def add_chain(chain: Chain, at: Int64, band: Skyline) -> None:
    """Add a chain's nodes to a band matrix, each node's unknowns from at[k] on.

    at: (M,). band: the matrix that they are added to.
    """
    own, link, values, offset, size = chain.own, chain.link, band.values, band.offset, chain.own.shape[1]
    for k in range(len(at)):
        for i in range(size):
            row = at[k] + i
            for j in range(i + 1):
                values[offset[row] + at[k] + j] += own[k, i, j]
            if k > 0:
                for j in range(size):
                    values[offset[row] + at[k - 1] + j] += link[k, i, j]


@kernel()
def add_products(first: Int64, at: Int64, values: Float64, right: Float64, chain: Chain) -> None:
    """Add the normal equations of sparse rows: row r has the right-hand side right[r] and values[k] at
    unknown at[k], where first[r] <= k < first[r + 1]. The encoders' unknowns follow the nodes', from M n on.

    first: (R + 1,); at, values: (E,) elements of R rows; right: (R,).
    """
    own, link, gradient, side, corner, corner_gradient = chain
    size, end = own.shape[1], own.shape[0] * own.shape[1]
    for r in range(len(right)):
        for a in range(first[r], first[r + 1]):
            node, i = at[a] // size, at[a] % size
            if at[a] >= end:
                corner_gradient[at[a] - end] -= values[a] * right[r]
            else:
                gradient[node, i] -= values[a] * right[r]
            for b in range(first[r], first[r + 1]):
                other, j, product = at[b] // size, at[b] % size, values[a] * values[b]
                if at[a] >= end and at[b] >= end:
                    corner[at[a] - end, at[b] - end] += product
                elif at[a] >= end:
                    side[other, j, at[a] - end] += product
                elif at[b] < end and other == node:
                    own[node, i, j] += product
                elif at[b] < end and other == node - 1:
                    link[node, i, j] += product


def back_substitute_nodes(
    step: Float64, shared: Float64, kept: Int64, gaps: tuple[EliminatedNodes, ...], nodes: int
) -> Float64:
    """Back-substitute the step (M, n) of all nodes from those of the kept ones (K, n) and of the encoders'
    unknowns (S,).
    """
    result = np.zeros((nodes, step.shape[1]))
    result[kept] = step
    for gap in gaps:
        none = np.zeros(step.shape[1])
        before = result[gap.first - 1] if gap.first > 0 else none
        after = result[gap.end] if gap.end < nodes else none
        moved = gap.answer @ np.concatenate([before, after, shared, [1.0]])
        result[gap.first : gap.end] = -moved.reshape(-1, step.shape[1])
    return result
