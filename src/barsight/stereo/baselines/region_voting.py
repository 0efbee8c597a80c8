"""Eliminate outliers of whole disparities by region voting [Mei 2011, Peng 2017]."""

from __future__ import annotations

import numba
import numpy as np

from barsight.core.arrays import Bool, Int32, kernel
from barsight.stereo.baselines.cross_aggregation import Arms, CrossRegions


def region_vote(
    values: Int32, reliable: Bool, regions: CrossRegions, fewest: int, share: float, rounds: int
) -> tuple[Int32, Bool]:
    """Replace outliers by the most frequent of the reliable values in their region, if it has more than
    `fewest` of them and the most frequent has more than `share` of the votes; replaced values count as
    reliable in the next round. Returns new arrays: values, and reliable including the replaced ones.
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

    values: (H, W) px, from `lowest` on, at most `count` different ones; reliable: (H, W); arms: (4, H, W) px.
    More than `fewest` votes are needed, and a share over `share` for the winner. voted, joined: (H, W),
    initially copies of values and reliable, updated with the winners.
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
