"""Eliminate outliers of whole disparities by region voting [Mei 2011, Peng 2017]."""

from __future__ import annotations

import numba
import numpy as np

from barsight.core.arrays import Bool, Int32, kernel
from barsight.stereo.baselines.cross_aggregation import Arms, CrossRegions


def region_vote(
    values: Int32, reliable: Bool, regions: CrossRegions, fewest: int, share: float, rounds: int
) -> tuple[Int32, Bool]:
    """Replace outliers by the commonest of the reliable values in their region, where it has more than
    `fewest` of them and the commonest more than `share`; they count as reliable in the next round. New
    arrays: values, and reliable with what was voted.
    """
    lowest = int(values.min())
    count = int(values.max()) - lowest + 1
    for _ in range(rounds):
        voted, joined = values.copy(), reliable.copy()
        _vote(values, reliable, regions.arms, fewest, share, lowest, count, voted, joined)
        values, reliable = voted, joined
    return values, reliable


@kernel(parallel=True)
def _vote(
    values: Int32,
    reliable: Bool,
    arms: Arms,
    fewest: int,
    share: float,
    lowest: int,
    count: int,
    voted: Int32,
    joined: Bool,
) -> None:
    """Vote once for each unreliable pixel among its region's reliable values [Mei 2011].

    values: (H, W) px, from `lowest` on, `count` different ones at most; reliable: (H, W); arms: (4, H, W) px.
    More than `fewest` votes are needed, the winner's share over `share`. voted, joined: (H, W), copies of
    values and reliable at the start; what wins is written to them.
    """
    height, width = values.shape
    for row in numba.prange(height):
        votes = np.zeros(count, dtype=np.int32)
        for column in range(width):
            if reliable[row, column]:
                continue
            votes[:] = 0
            total = 0
            for y in range(row - arms[2, row, column], row + arms[3, row, column] + 1):
                for x in range(column - arms[0, y, column], column + arms[1, y, column] + 1):
                    if reliable[y, x]:
                        votes[values[y, x] - lowest] += 1
                        total += 1
            winner = np.argmax(votes)
            if total > fewest and votes[winner] > share * total:
                voted[row, column] = lowest + winner
                joined[row, column] = True
