"""Build cross-shaped support regions and average the cost over them [Zhang 2009, Mei 2011].

Each pixel has four arms that end where the gray value differs too much from the pixel's own; its region is
the union of the horizontal arms of all pixels on its vertical arms (or the other way round).
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from barsight.core.arrays import Float32, UInt8, kernel

Arms = NDArray[np.int16]


@dataclass(frozen=True, eq=False)
class CrossRegions:
    """arms: (4, H, W) int16 lengths in px, to the left, right, up, down; the pixel itself isn't counted."""

    arms: Arms


@dataclass(frozen=True, eq=False)
class CrossFilter:
    """Aggregates (K, H, W) float32 slices in place when called.

    shares: (2, H, W) float32, one over the number of pixels in the region whose horizontal arms (0) or
    vertical arms (1) are summed first. rounds: number of rounds, which alternate between the two kinds of
    region.
    """

    regions: CrossRegions
    shares: Float32
    rounds: int

    def __call__(self, slices: Float32) -> Float32:
        """Replace each cost by the mean over its region, `rounds` times; returns `slices`."""
        _aggregate(slices, self.regions.arms, self.shares, self.rounds)
        return slices


def cross_filter(regions: CrossRegions, rounds: int) -> CrossFilter:
    """Create the aggregation over `regions`."""
    sizes = np.ones((2, *regions.arms.shape[1:]), dtype=np.float32)
    total = np.empty((sizes.shape[1] + 1, sizes.shape[2]), dtype=np.float32)
    _along_rows(sizes[0], regions.arms)
    _along_columns(sizes[0], regions.arms, total)
    _along_columns(sizes[1], regions.arms, total)
    _along_rows(sizes[1], regions.arms)
    return CrossFilter(regions, (1 / sizes).astype(np.float32), rounds)


def cross_regions(
    guide: UInt8, long_px: int, short_px: int, loose_gray: int, tight_gray: int
) -> CrossRegions:
    """Grow arms up to long_px while the gray value stays within loose_gray of the pixel and of the
    previous one, and beyond short_px within tight_gray of the pixel [Mei 2011, section 3.2]. An arm is at
    least one pixel long.
    """
    arms = np.zeros((4, *guide.shape), dtype=np.int16)
    _grow(guide, long_px, short_px, loose_gray, tight_gray, arms)
    return CrossRegions(arms)


@kernel(parallel=True)
def _grow(guide: UInt8, long: int, short: int, loose: int, tight: int, arms: Arms) -> None:
    """Grow the four arms of each pixel's cross [Mei 2011, section 3.2].

    guide: (H, W). long, short: px; loose, tight: gray levels, see `cross_regions`. Fills arms (4, H, W), px
    to the left, right, up, down.
    """
    height, width = guide.shape
    for row in numba.prange(height):
        for column in range(width):
            here = np.int32(guide[row, column])
            for arm in range(4):
                step_x = (-1, 1, 0, 0)[arm]
                step_y = (0, 0, -1, 1)[arm]
                before, reached = here, 0
                y, x = row + step_y, column + step_x
                while reached < long and 0 <= y < height and 0 <= x < width:
                    now = np.int32(guide[y, x])
                    limit = loose if reached < short else tight
                    if reached > 0 and (abs(now - here) > limit or abs(now - before) > loose):
                        break
                    before = now
                    reached += 1
                    y += step_y
                    x += step_x
                arms[arm, row, column] = reached


@kernel(parallel=True)
def _aggregate(slices: Float32, arms: Arms, shares: Float32, rounds: int) -> None:
    """Average costs over the cross-shaped regions, in place [Zhang 2009].

    slices: (K, H, W). arms: (4, H, W) px. shares: (2, H, W), one over the regions' sizes. Rounds 0, 2, ...
    sum over the horizontal arms first, the others over the vertical ones.
    """
    for index in numba.prange(slices.shape[0]):
        total = np.empty((slices.shape[1] + 1, slices.shape[2]), dtype=np.float32)
        for turn in range(rounds):
            if turn % 2 == 0:
                _along_rows(slices[index], arms)
                _along_columns(slices[index], arms, total)
            else:
                _along_columns(slices[index], arms, total)
                _along_rows(slices[index], arms)
            _scale(slices[index], shares[turn % 2])


@kernel()
def _along_rows(cost: Float32, arms: Arms) -> None:
    """Sum over the horizontal arms, in place.

    cost: (H, W). arms: (4, H, W) px.
    """
    height, width = cost.shape
    total = np.zeros(width + 1, dtype=np.float32)
    for row in range(height):
        costs, left, right = cost[row], arms[0, row], arms[1, row]
        for x in range(width):
            total[x + 1] = total[x] + costs[x]
        for x in range(width):
            costs[x] = total[x + right[x] + 1] - total[x - left[x]]


@kernel()
def _along_columns(cost: Float32, arms: Arms, total: Float32) -> None:
    """Sum over the vertical arms, in place. total: (H + 1, W) scratch."""
    height, width = cost.shape
    total[0] = 0
    for row in range(height):
        below, above, costs = total[row + 1], total[row], cost[row]
        for x in range(width):
            below[x] = above[x] + costs[x]
    for row in range(height):
        costs, up, down = cost[row], arms[2, row], arms[3, row]
        for x in range(width):
            costs[x] = total[row + down[x] + 1, x] - total[row - up[x], x]


@kernel()
def _scale(cost: Float32, share: Float32) -> None:
    """Scale cost (H, W) by share (H, W), in place."""
    for row in range(cost.shape[0]):
        costs, shares = cost[row], share[row]
        for x in range(cost.shape[1]):
            costs[x] *= shares[x]
