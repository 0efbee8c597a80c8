"""Aggregate along the paths of semi-global matching [Hirschmueller 2008], four at once, in bytes.

A path's values stay below its minimum plus the largest penalty, and each step subtracts the minimum, so they
fit into a byte. Candidates are padded to whole vectors with places that no path takes.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import NDArray

from barsight.core.arrays import UInt8, kernel
from barsight.stereo.direct.kernels.vectors import HALF_LANES, LANES, Vectors, bytes_of, shorts_of

UInt16 = NDArray[np.uint16]


class Penalties(NamedTuple):
    """small: P1, for a change of one candidate. jumps: (256,) P2, see `p2_table`."""

    small: int
    jumps: UInt8


_EDGE_GRAY = 8
_PATHS = 4


@intrinsic  # type: ignore[untyped-decorator]
def _extend_paths(
    _: Any, cost: Any, at: Any, paths: Any, before: Any, after: Any, minima: Any, ceiling: Any, small: Any,
    sums: Any, places: Any,
) -> Any:  # fmt: skip
    """Advance four paths by one pixel [Hirschmueller 2008, Eq. 13]; returns the minimum of each.

    cost: the pixel's `places` costs from `at` on; the sum of the four is written to `sums` there. before,
    after: where each path's values at the previous and the current pixel begin in `paths`, with one place
    before the first. minima, ceiling: each path's previous minimum, and the same plus the largest penalty.
    All arrays flat.

    It uses vector instructions: plain Numba takes four times as long here, a fifth more for all of stereo.
    The four paths of a pixel are a few vectors of bytes, and checks for overlap cost more than the steps.
    """
    four = types.Tuple((types.uint8,) * _PATHS)
    signature = four(cost, at, paths, before, after, minima, ceiling, small, sums, places)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        v = Vectors(context, builder, signature, arguments)
        starts, ends = v.members(3), v.members(4)
        lowest = {
            lanes: [cgutils.alloca_once_value(builder, v.all(255, bytes_of(lanes))) for _ in range(_PATHS)]
            for lanes in (LANES, HALF_LANES)
        }

        def extend(offset: Any, lanes: int) -> None:
            kind = bytes_of(lanes)
            base, ceilings = [v.all(b, kind) for b in v.members(5)], [v.all(c, kind) for c in v.members(6)]
            own = v.load(v.data(0), builder.add(arguments[1], offset), kind)
            total, step = v.all(0, shorts_of(lanes)), v.all(arguments[7], kind)
            for k in range(_PATHS):
                below = builder.add(starts[k], offset)
                same, above = (builder.add(below, below.type(i)) for i in (1, 2))
                beside = v.min_each(v.load(v.data(2), below, kind), v.load(v.data(2), above, kind))
                best = v.min_each(v.load(v.data(2), same, kind), builder.add(beside, step))
                value = builder.add(builder.sub(v.min_each(best, ceilings[k]), base[k]), own)
                place = builder.add(ends[k], offset)
                v.store(value, v.data(2), builder.add(place, place.type(1)))
                builder.store(v.min_each(builder.load(lowest[lanes][k]), value), lowest[lanes][k])
                total = builder.add(total, builder.zext(value, total.type))
            v.store(total, v.data(8), builder.add(arguments[1], offset))

        v.by_chunks(arguments[9], extend)
        found = [
            v.min_each(*(v.min_of(builder.load(lowest[lanes][k])) for lanes in (LANES, HALF_LANES)))
            for k in range(_PATHS)
        ]
        return context.make_tuple(builder, signature.return_type, found)

    return signature, generate


@kernel()
def p2_table(large: int, min_p2: int) -> UInt8:
    """Tabulate the penalty P2 (256,) by the difference in gray levels between the neighbours."""
    jumps = np.empty(256, dtype=np.uint8)
    for contrast in range(256):
        jumps[contrast] = max(large * _EDGE_GRAY // (_EDGE_GRAY + contrast), min_p2)
    return jumps


@kernel()
def allocate_paths(width: int, places: int, small: int) -> UInt8:
    """Allocate the values (N,) of `extend_row`: three paths in two rows, one path in two pixels, and zeros
    for the start of a path; each with a place on either side that no path takes. N: (6 width + 3) *
    (places + 2).
    """
    side = places + 2
    paths = np.full((6 * width + 3) * side, 255 - small, dtype=np.uint8)
    paths[(6 * width + 2) * side :] = 0
    return paths


@kernel()
def extend_row(
    cost: UInt8, gray: UInt8, gray_before: UInt8, penalties: Penalties, is_first: bool, is_odd: bool,
    backwards: bool, paths: UInt8, leasts: UInt8, sums: UInt16,
) -> None:  # fmt: skip
    """Extend four paths through one row: along it and from the three neighbours in the previous row.

    cost: (W, places). gray, gray_before: (W,) of this row and the previous one. paths (`allocate_paths`),
    leasts (2, W, 3): kept from row to row. Fills sums (W, places).
    """
    small, jumps = penalties
    width, places = cost.shape
    side = places + 2
    costs, totals = cost.reshape(-1), sums.reshape(-1)
    new, old = (1, 0) if is_odd else (0, 1)
    along, begin = 6 * width * side, (6 * width + 2) * side
    zero = np.uint8(0)
    min_along, dearest = zero, jumps[0]
    for j in range(width):
        x = width - 1 - j if backwards else j
        here, at = np.int32(gray[x]), x * places
        start_a, base_a, top_a = begin, zero, dearest
        if j > 0:
            start_a, base_a = along + (1 - (j & 1)) * side, min_along
            top_a = np.uint8(base_a + jumps[abs(here - np.int32(gray[x + 1 if backwards else x - 1]))])
        start_l, base_l, top_l = begin, zero, dearest
        if not is_first and x > 0:
            start_l, base_l = ((old * 3) * width + x - 1) * side, leasts[old, x - 1, 0]
            top_l = np.uint8(base_l + jumps[abs(here - np.int32(gray_before[x - 1]))])
        start_m, base_m, top_m = begin, zero, dearest
        if not is_first:
            start_m, base_m = ((old * 3 + 1) * width + x) * side, leasts[old, x, 1]
            top_m = np.uint8(base_m + jumps[abs(here - np.int32(gray_before[x]))])
        start_r, base_r, top_r = begin, zero, dearest
        if not is_first and x < width - 1:
            start_r, base_r = ((old * 3 + 2) * width + x + 1) * side, leasts[old, x + 1, 2]
            top_r = np.uint8(base_r + jumps[abs(here - np.int32(gray_before[x + 1]))])
        ends = (
            along + (j & 1) * side, (new * 3 * width + x) * side,
            ((new * 3 + 1) * width + x) * side, ((new * 3 + 2) * width + x) * side,
        )  # fmt: skip
        found = _extend_paths(
            costs, at, paths, (start_a, start_l, start_m, start_r), ends, (base_a, base_l, base_m, base_r),
            (top_a, top_l, top_m, top_r), np.uint8(small), totals, places,
        )  # fmt: skip
        min_along = found[0]
        leasts[new, x, 0], leasts[new, x, 1], leasts[new, x, 2] = found[1], found[2], found[3]
