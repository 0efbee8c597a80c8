"""Aggregate over a minimum spanning tree of the image, exactly and in two passes [Yang, CVPR 2012].

The pixels are the nodes; neighbours in the row and column are joined by edges weighted by their gray
difference, and the tree keeps the lightest edges. Two pixels support one another by exp(-D / sigma), where D
is the sum of the edges on the only path between them in the tree. Two visits of each node give every pixel
the support of all others.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from barsight.core.arrays import Float32, Int32, UInt8, kernel

_LANES = 8
_TILE = 16
_HEAVIEST = 256


@dataclass(frozen=True, eq=False)
class SpanningTree:
    """node: (N,) int32 flat pixel indices, each after its parent, neighbours mostly in sequence
    (preorder). parent: (N,) int32 flat pixel index of node's parent; the root is its own. weight: (N,)
    uint8 of the edge between them.
    """

    node: Int32
    parent: Int32
    weight: UInt8


@dataclass(frozen=True, eq=False)
class TreeFilter:
    """Aggregates (K, H, W) float32 slices in place when called.

    similarity: (N,) float32 support between a node and its parent, in the order of `tree.node`.
    """

    tree: SpanningTree
    similarity: Float32

    def __call__(self, slices: Float32) -> Float32:
        """Aggregate `slices` in place and return them. Memory: the same amount again."""
        groups = -(-slices.shape[0] // _LANES)
        lanes = np.empty((groups, slices.shape[1] * slices.shape[2], _LANES), dtype=np.float32)
        _aggregate(slices, self.tree.node, self.tree.parent, self.similarity, lanes)
        return slices


def tree_filter(tree: SpanningTree, sigma_gray: float) -> TreeFilter:
    """Create the aggregation over `tree` with support exp(-D / sigma_gray), D in gray levels."""
    table = np.exp(-np.arange(_HEAVIEST) / sigma_gray).astype(np.float32)
    return TreeFilter(tree, table[tree.weight])


def spanning_tree(guide: UInt8) -> SpanningTree:
    """Build the minimum spanning tree of the 4-connected (H, W) image [Kruskal 1956]; edges are sorted
    with a counting sort.
    """
    size = guide.size
    node, parent = np.empty(size, dtype=np.int32), np.empty(size, dtype=np.int32)
    weight = np.empty(size, dtype=np.uint8)
    _walk(guide, _tree_edges(guide), node, parent, weight)
    return SpanningTree(node, parent, weight)


@kernel()
def _tree_edges(guide: UInt8) -> UInt8:
    """Select edges (H, W) uint8: 1 where the tree keeps the edge to the right neighbour, plus 2 for the one
    below.
    """
    height, width = guide.shape
    starts = np.zeros(_HEAVIEST + 1, dtype=np.int64)
    for y in range(height):
        for x in range(width):
            here = np.int32(guide[y, x])
            if x + 1 < width:
                starts[abs(here - np.int32(guide[y, x + 1])) + 1] += 1
            if y + 1 < height:
                starts[abs(here - np.int32(guide[y + 1, x])) + 1] += 1
    for step in range(_HEAVIEST):
        starts[step + 1] += starts[step]
    edges = np.empty(starts[_HEAVIEST], dtype=np.int32)
    for y in range(height):
        for x in range(width):
            here = np.int32(guide[y, x])
            if x + 1 < width:
                across = abs(here - np.int32(guide[y, x + 1]))
                edges[starts[across]] = 2 * (y * width + x)
                starts[across] += 1
            if y + 1 < height:
                down = abs(here - np.int32(guide[y + 1, x]))
                edges[starts[down]] = 2 * (y * width + x) + 1
                starts[down] += 1
    chief = np.arange(height * width).astype(np.int32)
    kept = np.zeros((height, width), dtype=np.uint8)
    missing = height * width - 1
    for edge in edges:
        first, is_down = edge >> 1, edge & 1
        one = _chief_of(chief, first)
        other = _chief_of(chief, first + (width if is_down else 1))
        if one != other:
            chief[max(one, other)] = min(one, other)
            kept[first // width, first % width] |= np.uint8(2 if is_down else 1)
            missing -= 1
            if missing == 0:
                break
    return kept


@kernel()
def _chief_of(chief: Int32, member: int) -> int:
    """Find the root of a pixel's set, halving the path to it [Tarjan & van Leeuwen 1984].

    chief: (N,) flat pixel index of another member, a root's own; paths are shortened in place.
    """
    here = member
    while chief[here] != here:
        chief[here] = chief[chief[here]]
        here = int(chief[here])
    return here


@kernel()
def _walk(guide: UInt8, kept: UInt8, node: Int32, parent: Int32, weight: UInt8) -> None:
    """Order the nodes in preorder from the central pixel, so that a node's parent is mostly still in the
    cache.

    guide, kept: (H, W), of `_tree_edges`. Fills node, parent (flat pixel indices) and weight (gray difference
    between the two), all (H * W,).
    """
    height, width = guide.shape
    gray, edges = guide.ravel(), kept.ravel()
    stack = np.empty(height * width, dtype=np.int32)
    origin = np.empty(height * width, dtype=np.int32)
    root = (height // 2) * width + width // 2
    stack[0], origin[root], waiting = root, root, 1
    for place in range(height * width):
        waiting -= 1
        here = stack[waiting]
        came = origin[here]
        node[place], parent[place] = here, came
        weight[place] = abs(np.int32(gray[here]) - np.int32(gray[came]))
        for turn in range(4):
            if turn == 0:
                there, joined = here + 1, edges[here] & 1
            elif turn == 1:
                there, joined = here + width, edges[here] & 2
            elif turn == 2:
                there = here - 1
                joined = edges[there] & 1 if here % width > 0 else np.uint8(0)
            else:
                there = here - width
                joined = edges[there] & 2 if there >= 0 else np.uint8(0)
            if joined and there != came:
                origin[there] = here
                stack[waiting] = there
                waiting += 1


@kernel(parallel=True)
def _aggregate(slices: Float32, node: Int32, parent: Int32, similarity: Float32, lanes: Float32) -> None:
    """Aggregate costs over the spanning tree, `_LANES` slices at a time [Yang, CVPR 2012].

    slices: (K, H, W), in place. node, parent, similarity: (N,), see `SpanningTree` and `TreeFilter`. lanes:
    (ceil(K / _LANES), N, _LANES) scratch.
    """
    for group in numba.prange(lanes.shape[0]):
        first = group * _LANES
        used = min(_LANES, slices.shape[0] - first)
        _to_lanes(slices[first : first + used], lanes[group])
        _two_passes(node, parent, similarity, lanes[group], used)
        _from_lanes(lanes[group], slices[first : first + used])


@kernel()
def _two_passes(node: Int32, parent: Int32, similarity: Float32, costs: Float32, used: int) -> None:
    """Aggregate costs from the leaves to the root and back, in place [Yang, CVPR 2012].

    node, parent: (N,) flat pixel indices, parents first; similarity: (N,) of a node and its parent. costs:
    (N, _LANES) by pixel, of which `used` lanes are filled.
    """
    size = node.shape[0]
    for place in range(size - 1, 0, -1):
        share = similarity[place]
        mine, upper = costs[node[place]], costs[parent[place]]
        for lane in range(used):
            upper[lane] += share * mine[lane]
    for place in range(1, size):
        share = similarity[place]
        rest = np.float32(1) - share * share
        mine, upper = costs[node[place]], costs[parent[place]]
        for lane in range(used):
            mine[lane] = share * upper[lane] + rest * mine[lane]


@kernel()
def _to_lanes(slices: Float32, costs: Float32) -> None:
    """Transpose (K, H, W) to (H * W, lanes), tile by tile within a row so that each cache line is read
    once.
    """
    count, height, width = slices.shape
    for y in range(height):
        for start in range(0, width, _TILE):
            end = min(start + _TILE, width)
            for lane in range(count):
                for x in range(start, end):
                    costs[y * width + x, lane] = slices[lane, y, x]


@kernel()
def _from_lanes(costs: Float32, slices: Float32) -> None:
    """Transpose (H * W, lanes) back to slices (K, H, W), in the order of `_to_lanes`."""
    count, height, width = slices.shape
    for y in range(height):
        for start in range(0, width, _TILE):
            end = min(start + _TILE, width)
            for lane in range(count):
                for x in range(start, end):
                    slices[lane, y, x] = costs[y * width + x, lane]
