"""Order the unknowns of the normal equations.

The unknowns go node by node (pose, with an IMU velocity and biases). Those of a piece of the yard
(`apparent_motion`) are coupled to the nodes that see it and follow the last of these. So the equations form a
band, however long the travel is: a pose's row begins at the first node that saw a point which the pose sees,
a velocity's and a bias's at the node before, a piece's at the first node that sees it.
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
    """size: number of unknowns per node. node: (K,) index of each node's first unknown; piece: (S,) index of
    each piece's slide, which its disparity follows. seen: (S, 2) the first and last node that see a piece.
    first: (n,) as in `Skyline`. reach: number of nodes that the longest track spans.
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
        """Return the indices (2 S,) of the pieces' slides, followed by those of their disparities."""
        return np.concatenate([self.piece, self.piece + 1])

    def zeros(self) -> Skyline:
        """Allocate a skyline matrix of zeros for all unknowns."""
        return skyline.empty_skyline(self.first)


def order_unknowns(size: int, nodes: int, begin: Int64, end: Int64, piece: Int64 | None) -> Ordering:
    """Order the unknowns.

    begin, end: (T,) the nodes of each point's first and last sighting; piece: (T,) as in `Pieces`.
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
    earliest = np.minimum.accumulate(earliest[::-1])[::-1]  # a track couples all nodes between its ends
    first = np.zeros(size * nodes + 2 * len(seen), np.int64)
    for k in range(size):
        first[node + k] = node[earliest if k < 6 else nearest]
    first[own], first[own + 1] = node[seen[:, 0]], node[seen[:, 0]]
    return Ordering(size, node, own, seen, first, int((index - earliest).max(initial=0)) + 1)
