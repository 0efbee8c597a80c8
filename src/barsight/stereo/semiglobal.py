"""Semi-global matching [Hirschmueller 2008] on a cost that neither gain nor single bright pixels upset.

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
from numba import prange

from barsight.core.arrays import Float32, UInt8, kernel
from barsight.core.errors import ConfigError
from barsight.stereo.semiglobal_cost import (
    Int16,
    UInt32,
    census_codes,
    reversed_rows,
    row_costs,
    row_gradient,
)

_OVERLAP_ROWS = 20
_STRIPE_BYTES = 128 * 2**20
_EDGE_GREY = 8
_BORDER = np.int16(10000)
_FAR = np.float32(-1e6)
_WORST = np.int32(2**31 - 1)


@dataclass(frozen=True)
class SemiGlobalSettings:
    """Semi-global matching."""

    small_jump: int = 22
    """Penalty of a change by one candidate between neighbours."""
    large_jump: int = 150
    """Penalty of a larger change where the image is flat; an edge of 8 grey levels halves it."""
    least_jump: int = 28
    """Penalty of a larger change across a strong image edge."""

    def __post_init__(self) -> None:
        if not 0 < self.small_jump <= self.least_jump <= self.large_jump <= 2000:
            raise ConfigError("the penalties must be 0 < small_jump <= least_jump <= large_jump <= 2000")


@dataclass(frozen=True, eq=False)
class Match:
    """Disparities of both images, (H, W) float32: left_px to a fraction, right_px in whole pixels.

    right_px is -1e6 where no candidate falls into the left image.
    """

    left_px: Float32
    right_px: Float32


def match(left: UInt8, right: UInt8, lowest_px: int, count: int, settings: SemiGlobalSettings) -> Match:
    """The best of `count` candidates from lowest_px on for every pixel, by semi-global matching.

    Memory: at most about 130 MB per thread, or 40 rows' cost volume if that is more.
    """
    height, width = left.shape
    left_px, right_px = np.empty((2, height, width), dtype=np.float32)
    threads = numba.get_num_threads()
    affordable = max(_STRIPE_BYTES // (3 * width * count) - 2 * _OVERLAP_ROWS, 16)
    stripes = threads * -(-height // (threads * min(affordable, 256)))
    _match_stripes(
        census_codes(left), reversed_rows(census_codes(right)),
        row_gradient(left), reversed_rows(row_gradient(right)),
        left.astype(np.int16), reversed_rows(right.astype(np.int16)), lowest_px, count,
        settings.small_jump, settings.large_jump, settings.least_jump, -(-height // stripes), threads,
        left_px, right_px,
    )  # fmt: skip
    return Match(left_px, right_px)


@kernel()
def _extend_path(
    cost: UInt8,
    before: Int16,
    least_before: Any,
    small: int,
    jump: Any,
    path: Int16,
    total: Int16,
    places: tuple[int, int, int],
    count: int,
) -> np.int16:
    """One pixel further along a path [Hirschmueller 2008, Eq. 13]; the path's least cost there.

    places: where the pixel's candidates begin in cost and total, in before, and in path, all flat: with flat
    arrays and unsigned places, since slices and signs cost more than the few vector instructions in between.
    """
    at, at_before, at_path = np.uint64(places[0]), np.uint64(places[1]), np.uint64(places[2])
    one, two = np.uint64(1), np.uint64(2)
    least = np.int16(32000)
    ceiling = np.int16(least_before + jump)
    step, base = np.int16(small), np.int16(least_before)
    for candidate in range(count):
        d = np.uint64(candidate)
        best = np.int16(min(before[at_before + d], before[at_before + d + two]) + step)
        best = min(min(best, before[at_before + d + one]), ceiling)
        value = np.int16(np.int16(best - base) + np.int16(cost[at + d]))
        path[at_path + d + one] = value
        total[at + d] = np.int16(total[at + d] + value)
        least = min(least, value)
    return least


@kernel()
def _sweep(
    cost: UInt8, total: Int16, grey: Int16, small: int, large: int, least_jump: int, upwards: bool
) -> None:
    """Adds four of the eight paths: along the row and from the three neighbours in the row before."""
    height, width, count = cost.shape
    costs, totals = cost.reshape(-1), total.reshape(-1)
    side = count + 2
    paths = np.full(6 * width * side, _BORDER, dtype=np.int16)
    leasts = np.zeros((2, 3, width), dtype=np.int16)
    along = np.full(2 * side, _BORDER, dtype=np.int16)
    fresh = np.zeros(side, dtype=np.int16)
    fresh[0] = _BORDER
    fresh[count + 1] = _BORDER
    jumps = np.empty(256, dtype=np.int16)
    for contrast in range(256):
        jumps[contrast] = max(large * _EDGE_GREY // (_EDGE_GREY + contrast), least_jump)
    for i in range(height):
        y = height - 1 - i if upwards else i
        y_before = y + 1 if upwards else y - 1
        new, old = i & 1, 1 - (i & 1)
        least_along = np.int16(0)
        for j in range(width):
            x = width - 1 - j if upwards else j
            here, at = np.int32(grey[y, x]), (y * width + x) * count
            place = (at, (1 - (j & 1)) * side, (j & 1) * side)
            if j == 0:
                place = (at, 0, 0)
                least_along = _extend_path(costs, fresh, 0, small, large, along, totals, place, count)
            else:
                jump = jumps[abs(here - np.int32(grey[y, x + 1 if upwards else x - 1]))]
                least_along = _extend_path(
                    costs, along, least_along, small, jump, along, totals, place, count
                )
            for r in range(3):
                x_before = x + r - 1
                at_path = ((new * 3 + r) * width + x) * side
                if i == 0 or x_before < 0 or x_before >= width:
                    place = (at, 0, at_path)
                    leasts[new, r, x] = _extend_path(
                        costs, fresh, 0, small, large, paths, totals, place, count
                    )
                    continue
                place = (at, ((old * 3 + r) * width + x_before) * side, at_path)
                jump = jumps[abs(here - np.int32(grey[y_before, x_before]))]
                leasts[new, r, x] = _extend_path(
                    costs, paths, leasts[old, r, x_before], small, jump, paths, totals, place, count
                )


@kernel()
def _choose(total: Int16, lowest: int, left_px: Float32, right_px: Float32) -> None:
    """Winners of one row for both images; the left one to a fraction with the equiangular line fit, which
    suits a cost that rises linearly [Shimizu 2002]. A sum and its candidate share one number, so that the
    least number is the winner. The right ones are kept reversed meanwhile, so that a left pixel's candidates
    meet them in memory's order."""
    width, count = total.shape
    sums = total.reshape(-1)
    right_least = np.full(width, _WORST, dtype=np.int32)
    for x in range(width):
        at, least = np.uint64(x * count), _WORST
        for candidate in range(count):
            key = np.int32(np.int32(sums[at + np.uint64(candidate)]) << 16 | candidate)
            least = min(least, key)
        winner = least & 0xFFFF
        fraction = np.float32(0)
        if 0 < winner < count - 1:
            middle = least >> 16
            below, above = (
                np.float32(total[x, winner - 1] - middle),
                np.float32(total[x, winner + 1] - middle),
            )
            steeper = max(below, above)
            if steeper > 0:
                fraction = np.float32(0.5) * (below - above) / steeper
        left_px[x] = np.float32(winner + lowest) + fraction
        base = width - 1 - x + lowest
        first, end = max(0, -base), min(count, width - base)
        at_right = np.uint64(base + first)
        for candidate in range(end - first):
            k = np.uint64(candidate)
            key = np.int32(np.int32(sums[at + np.uint64(first) + k]) << 16 | (first + candidate))
            right_least[at_right + k] = min(right_least[at_right + k], key)
    for x in range(width):
        found = right_least[width - 1 - x]
        right_px[x] = np.float32((found & 0xFFFF) + lowest) if found < _WORST else _FAR


@kernel(parallel=True)
def _match_stripes(
    left_code: UInt32,
    right_code: UInt32,
    left_slope: Int16,
    right_slope: Int16,
    left_grey: Int16,
    right_grey: Int16,
    lowest: int,
    count: int,
    small: int,
    large: int,
    least_jump: int,
    stripe_rows: int,
    workers: int,
    left_px: Float32,
    right_px: Float32,
) -> None:
    """Each worker takes every so-manieth stripe and uses its two volumes again and again."""
    height, width = left_px.shape
    stripes = (height + stripe_rows - 1) // stripe_rows
    for worker in prange(workers):
        cost = np.empty((stripe_rows + 2 * _OVERLAP_ROWS, width, count), dtype=np.uint8)
        total = np.empty((stripe_rows + 2 * _OVERLAP_ROWS, width, count), dtype=np.int16)
        for stripe in range(worker, stripes, workers):
            start, end = stripe * stripe_rows, min(height, stripe * stripe_rows + stripe_rows)
            above, below = max(0, start - _OVERLAP_ROWS), min(height, end + _OVERLAP_ROWS)
            rows = below - above
            for y in range(above, below):
                row_costs(
                    left_code[y], right_code[y], left_slope[y], right_slope[y], left_grey[y], right_grey[y],
                    lowest, cost[y - above],
                )  # fmt: skip
                total[y - above] = 0
            grey = left_grey[above:below]
            _sweep(cost[:rows], total[:rows], grey, small, large, least_jump, False)
            _sweep(cost[:rows], total[:rows], grey, small, large, least_jump, True)
            for y in range(start, end):
                _choose(total[y - above], lowest, left_px[y], right_px[y])
