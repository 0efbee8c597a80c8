"""Order the unknowns of the normal equations.

Unknowns go node by node (pose, with an IMU velocity and biases). What a piece of the yard has of its own
(`slides`) is bound to the nodes that see it and follows the last of these. So the equations are a band,
however long the way is: a pose's row begins at the first node that saw a point which it sees, a velocity's
and a bias's at the node before, a piece's at the first node that sees it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from barsight.core.arrays import Int64
from barsight.core.linalg import skyline
from barsight.core.linalg.skyline import Skyline


@dataclass(frozen=True, eq=False)
class Ordering:
    """size: unknowns a node. node: (K,) each node's first unknown; piece: (S,) each piece's slide, its
    disparity is the next. seen: (S, 2) the first and last node that see a piece. first: (n,) as `Skyline` has
    it. reach: how many nodes the longest track spans.
    """

    size: int
    node: Int64
    piece: Int64
    seen: Int64
    first: Int64
    reach: int

    @cached_property
    def poses(self) -> Int64:
        """Return the indices (6 K,) of the poses' unknowns."""
        return (self.node[:, None] + np.arange(6)).ravel()

    @cached_property
    def nodes(self) -> Int64:
        """Return the indices (size K,) of the nodes' unknowns."""
        return (self.node[:, None] + np.arange(self.size)).ravel()

    @cached_property
    def pieces(self) -> Int64:
        """Return the indices (2 S,) of the pieces' slides, then their disparities."""
        return np.concatenate([self.piece, self.piece + 1])

    def zeros(self) -> Skyline:
        """Allocate a skyline matrix for all of them."""
        return skyline.empty_skyline(self.first)


def order_unknowns(size: int, nodes: int, begin: Int64, end: Int64, piece: Int64 | None) -> Ordering:
    """Order the unknowns.

    begin, end: (T,) the nodes of each point's first and last sighting; piece: (T,) as `Pieces`.
    """
    index = np.arange(nodes)
    seen = np.empty((0, 2), np.int64)
    if piece is not None:
        seen = np.column_stack([np.full(piece.max() + 1, nodes - 1), np.zeros(piece.max() + 1, np.int64)])
        np.minimum.at(seen[:, 0], piece, begin)
        np.maximum.at(seen[:, 1], piece, end)
    order = np.argsort(seen[:, 1], kind="stable")
    before = np.searchsorted(seen[order, 1], index)
    node = size * index + 2 * before
    own = np.empty(len(seen), np.int64)
    own[order] = size * (seen[order, 1] + 1) + 2 * np.arange(len(seen))
    nearest = np.maximum(index - 1, 0)
    earliest = nearest.copy()
    np.minimum.at(earliest, end, begin)
    earliest = np.minimum.accumulate(earliest[::-1])[::-1]  # a track binds all nodes between its ends
    first = np.zeros(size * nodes + 2 * len(seen), np.int64)
    for k in range(size):
        first[node + k] = node[earliest if k < 6 else nearest]
    first[own], first[own + 1] = node[seen[:, 0]], node[seen[:, 0]]
    return Ordering(size, node, own, seen, first, int((index - earliest).max(initial=0)) + 1)
