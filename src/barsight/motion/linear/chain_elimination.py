"""Eliminate nodes between frames, which no picture sees, before all others.

Only the IMU and the encoders bind them, each to its neighbours: between two frames they are a small system of
their own. The band of what is left is as wide as the longest track in frames, not in nodes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from barsight.core.arrays import Float64, Int64
from barsight.core.linalg import skyline


@dataclass(eq=False)
class Chain:
    """Normal equations of M nodes that bind their neighbours and the latency only. rows: (M n, 2 n) a band;
    gradient (M n,); side (M n,) with the latency; corner, corner_gradient of the latency itself.
    """

    rows: Float64
    gradient: Float64
    side: Float64
    corner: float
    corner_gradient: float

    @property
    def size(self) -> int:
        """Return the number of unknowns a node."""
        return int(self.rows.shape[1]) // 2

    def at(self, nodes: Int64) -> Int64:
        """Return the indices of the nodes' unknowns."""
        return (nodes[:, None] * self.size + np.arange(self.size)).ravel()


@dataclass(frozen=True, eq=False)
class EliminatedNodes:
    """Eliminated nodes first...end - 1. answer: (m n, 2 n + 2) by which they follow the kept nodes before and
    after, the latency, and nothing at all.
    """

    first: int
    end: int
    answer: Float64


def eliminate_nodes(chain: Chain, kept: Int64) -> tuple[Chain, tuple[EliminatedNodes, ...]]:
    """Form the Schur complement on the nodes `kept` (K,), and what was taken out. Raises LinAlgError where
    the sensors leave a node between undetermined.
    """
    nodes, at = len(chain.rows) // chain.size, chain.at(kept)
    left = replace(chain, rows=chain.rows[at], gradient=chain.gradient[at], side=chain.side[at])
    gaps = []
    for k, (before, after) in enumerate(pairwise([-1, *kept.tolist(), nodes])):
        if after - before > 1:
            gaps.append(_take_out(chain, before + 1, after, k, left))
    return left, tuple(gaps)


def _take_out(chain: Chain, first: int, end: int, k: int, left: Chain) -> EliminatedNodes:
    """Eliminate the nodes first...end - 1, between the kept nodes k - 1 and k where there are such."""
    size = chain.size
    here = slice(first * size, end * size)
    right = np.zeros(((end - first) * size, 2 * size + 2))
    if first > 0:
        right[:size, :size] = _link(chain.rows, first)
    if end * size < len(chain.rows):
        right[-size:, size:-2] = _link(chain.rows, end).T
    right[:, -2], right[:, -1] = chain.side[here], chain.gradient[here]
    factor = skyline.uniform_band(chain.rows[here].copy())
    if not skyline.factorise_skyline(factor):
        raise np.linalg.LinAlgError("the measurements leave an unknown undetermined")
    skyline.solve_forward(factor, right)
    taken = np.empty((right.shape[1], right.shape[1]))
    skyline.gram_matrix(right, taken)
    skyline.solve_back_dense(factor, right)
    row, column = np.tril_indices(size)
    for node, part in ((k - 1, slice(size)), (k, slice(size, 2 * size))):
        if 0 <= node * size < len(left.rows):
            own = slice(node * size, (node + 1) * size)
            left.rows[own][row, 2 * size - 1 - row + column] -= taken[part, part][row, column]
            left.side[own] -= taken[part, -2]
            left.gradient[own] -= taken[part, -1]
    if first > 0 and end * size < len(chain.rows):
        row, column = np.indices((size, size))
        left.rows[k * size : (k + 1) * size][row, size - 1 - row + column] = -taken[size:-2, :size]
    left.corner -= taken[-2, -2]
    left.corner_gradient -= taken[-2, -1]
    return EliminatedNodes(first, end, right)


def _link(rows: Float64, node: int) -> Float64:
    """Extract how a node (rows) is bound to the one before (n, n)."""
    size = rows.shape[1] // 2
    row, column = np.indices((size, size))
    link: Float64 = rows[node * size : (node + 1) * size][row, size - 1 - row + column]
    return link


def back_substitute_nodes(
    step: Float64, latency: float, kept: Int64, gaps: tuple[EliminatedNodes, ...], nodes: int
) -> Float64:
    """Back-substitute the step (M, n) of all nodes from that of the kept ones (K, n) and of the latency."""
    result = np.zeros((nodes, step.shape[1]))
    result[kept] = step
    for gap in gaps:
        none = np.zeros(step.shape[1])
        before = result[gap.first - 1] if gap.first > 0 else none
        after = result[gap.end] if gap.end < nodes else none
        moved = gap.answer @ np.concatenate([before, after, [latency, 1.0]])
        result[gap.first : gap.end] = -moved.reshape(-1, step.shape[1])
    return result
