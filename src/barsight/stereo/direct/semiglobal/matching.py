"""Match semi-globally [Hirschmueller 2008] on a cost that neither gain nor single bright pixels upset.

Cost of a candidate: Hamming distance of the 5x5 census [Zabih 1994], plus truncated differences of the x
gradient and of the grey value. Eight paths; the penalty of a jump falls where the image has an edge. The
image is worked through in stripes of rows, each with its own cost volume, so memory doesn't grow with the
height.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from barsight.core.arrays import Float32, Int32, UInt8, kernel
from barsight.core.errors import ConfigError
from barsight.core.parallel import parallel_bands
from barsight.stereo.direct.kernels.vectors import HALF_LANES, NUMBER, Vectors, shorts_of
from barsight.stereo.direct.semiglobal.cost import (
    BESIDE_COST,
    Int16,
    describe_pixels,
    reverse_rows,
    row_costs,
)
from barsight.stereo.direct.semiglobal.paths import UInt16, allocate_paths, extend_row, p2_table

_OVERLAP_ROWS = 20
_STRIPE_BYTES = 128 * 2**20
_FAR = np.float32(-1e6)
_WORST = np.int32(2**31 - 1)
_LARGEST_BYTE = 255


@dataclass(frozen=True)
class SemiGlobalSettings:
    """Settings of semi-global matching."""

    p1: int = 22
    """Penalty of a change by one candidate between neighbours."""
    p2: int = 150
    """Penalty of a larger change where the image is flat; an edge of 8 grey levels halves it."""
    min_p2: int = 28
    """Penalty of a larger change across a strong image edge."""

    def __post_init__(self) -> None:
        if not 0 < self.p1 <= self.min_p2 <= self.p2:
            raise ConfigError("the penalties must be 0 < p1 <= min_p2 <= p2")
        if self.p1 + self.p2 > _LARGEST_BYTE - BESIDE_COST:
            raise ConfigError(f"p1 + p2 can't exceed {_LARGEST_BYTE - BESIDE_COST}")


@dataclass(frozen=True, eq=False)
class SemiGlobalMatch:
    """Disparities of both images, (H, W) float32: left_px to a fraction, right_px in whole pixels.

    right_px is -1e6 where no candidate falls into the left image.
    """

    left_px: Float32
    right_px: Float32


def match_semiglobal(
    left: UInt8, right: UInt8, lowest_px: int, count: int, settings: SemiGlobalSettings
) -> SemiGlobalMatch:
    """Match every pixel among `count` candidates from lowest_px on by semi-global matching.

    Memory: at most about 130 MB per thread, or 40 rows' cost volume if that is more.
    """
    height, width = left.shape
    left_px, right_px = np.empty((2, height, width), dtype=np.float32)
    threads, places = numba.get_num_threads(), -(-count // HALF_LANES) * HALF_LANES
    affordable = max(_STRIPE_BYTES // (3 * width * places) - 2 * _OVERLAP_ROWS, 16)
    stripes = threads * -(-height // (threads * min(affordable, 256)))
    rows = -(-height // stripes)
    volume = (min(height, rows + 2 * _OVERLAP_ROWS), width, places)
    rooms = [(np.empty(volume, dtype=np.uint8), np.empty(volume, dtype=np.uint16)) for _ in range(threads)]
    seen, others = describe_pixels(left), reverse_rows(describe_pixels(right), lowest_px, places)

    def work(first: int, end: int) -> None:
        room = rooms.pop()
        _match_stripe(
            seen.codes, seen.slope, seen.grey, others.codes, others.slope, others.grey, lowest_px, count,
            settings.p1, settings.p2, settings.min_p2, *room, left_px, right_px, first,
            end,
        )  # fmt: skip
        rooms.append(room)

    parallel_bands(work, height, rows)
    return SemiGlobalMatch(left_px, right_px)


@intrinsic  # type: ignore[untyped-decorator]
def _compete(
    _: Any, downs: Any, ups: Any, at: Any, count: Any, places: Any, least: Any, right: Any
) -> Any:  # fmt: skip
    """Find the least key of one left pixel.

    Its keys are written to `least` where they are less, that of candidate k at `right` + k. A key is a
    candidate's sum and below it, in 16 bits, the candidate: the least number is the winner. downs, ups: flat,
    the pixel's sums from `at` on.
    """
    signature = types.int32(downs, ups, at, count, places, least, right)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        v = Vectors(context, builder, signature, arguments)
        kind = ir.VectorType(NUMBER, HALF_LANES)
        worst = v.all(int(_WORST), kind)
        lanes = ir.Constant(kind, list(range(HALF_LANES)))
        end = v.all(builder.trunc(arguments[3], NUMBER), kind)
        winner = cgutils.alloca_once_value(builder, worst)

        def smaller(one: Any, other: Any) -> Any:
            return builder.select(builder.icmp_signed("<", one, other), one, other)

        chunks = builder.udiv(arguments[4], arguments[4].type(HALF_LANES))
        with cgutils.for_range(builder, chunks) as loop:
            offset = builder.mul(loop.index, loop.index.type(HALF_LANES))
            place = builder.add(arguments[2], offset)
            down, up = (
                builder.zext(v.load(v.data(part), place, shorts_of(HALF_LANES)), kind) for part in (0, 1)
            )
            candidate = builder.add(lanes, v.all(builder.trunc(offset, NUMBER), kind))
            key = builder.or_(builder.shl(builder.add(down, up), v.all(16, kind)), candidate)
            key = builder.select(builder.icmp_signed("<", candidate, end), key, worst)
            builder.store(smaller(builder.load(winner), key), winner)
            there = builder.add(arguments[6], offset)
            v.store(smaller(v.load(v.data(5), there, kind), key), v.data(5), there)
        return v.min_number(builder.load(winner))

    return signature, generate


@kernel()
def _choose(
    down: UInt16, up: UInt16, count: int, lowest: int, least: Int32, left_px: Float32, right_px: Float32
) -> None:
    """Choose winners of one row for both images; the left one to a fraction with the equiangular line fit,
    which suits a cost that rises linearly [Shimizu 2002]. The right ones are kept reversed meanwhile, so that
    a left pixel's candidates meet them in memory's order. down, up: (W, places) sums of four paths each.
    least:
    for use inside, with a margin on both sides that takes what falls beside the right image."""
    width, places = down.shape
    downs, ups = down.reshape(-1), up.reshape(-1)
    margin = (len(least) - width) // 2
    least[:] = _WORST
    for x in range(width):
        at = x * places
        winner = _compete(downs, ups, at, count, places, least, margin + width - 1 - x + lowest)
        best = winner & 0xFFFF
        fraction = np.float32(0)
        if 0 < best < count - 1:
            here, one = np.uint64(at + best), np.uint64(1)
            middle = winner >> 16
            below = np.float32(np.int32(downs[here - one]) + np.int32(ups[here - one]) - middle)
            above = np.float32(np.int32(downs[here + one]) + np.int32(ups[here + one]) - middle)
            steeper = max(below, above)
            if steeper > 0:
                fraction = np.float32(0.5) * (below - above) / steeper
        left_px[x] = np.float32(best + lowest) + fraction
    for x in range(width):
        found = least[margin + width - 1 - x]
        right_px[x] = np.float32((found & 0xFFFF) + lowest) if found < _WORST else _FAR


@kernel()
def _match_stripe(
    code: UInt8, slope: Int16, grey: UInt8, codes: UInt8, slopes: Int16, greys: UInt8, lowest: int,
    count: int, small: int, large: int, min_p2: int, cost: UInt8, down: UInt16, left_px: Float32,
    right_px: Float32, start: int, end: int,
) -> None:  # fmt: skip
    """Match a stripe: once down, where the costs are made, and once up, where the winners are chosen row by
    row. cost, down:
    volumes for use inside."""
    height, width = left_px.shape
    places = cost.shape[2]
    jumps = p2_table(large, min_p2)
    paths = allocate_paths(width, places, small)
    leasts = np.empty((2, width, 3), dtype=np.uint8)
    up = np.empty((width, places), dtype=np.uint16)
    least = np.empty(width + 2 * (abs(lowest) + places), dtype=np.int32)
    above, below = max(0, start - _OVERLAP_ROWS), min(height, end + _OVERLAP_ROWS)
    for y in range(above, below):
        here = cost[y - above]
        row_costs(code[y], slope[y], grey[y], codes[y], slopes[y], greys[y], lowest, count, here)
        extend_row(
            here, grey[y], grey[max(y - 1, 0)], small, jumps, y == above, (y & 1) == 1, False, paths, leasts,
            down[y - above],
        )  # fmt: skip
    for y in range(below - 1, start - 1, -1):
        extend_row(
            cost[y - above], grey[y], grey[min(y + 1, height - 1)], small, jumps, y == below - 1,
            (y & 1) == 1, True, paths, leasts, up,
        )  # fmt: skip
        if y < end:
            _choose(down[y - above], up, count, lowest, least, left_px[y], right_px[y])
