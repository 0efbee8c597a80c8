"""Select the winner over slices of costs as they arrive, with a subpixel parabola [paper Eq. 4].

Only the best cost, its neighbours and the last slice are stored instead of a cost volume: memory is five
float32 images whatever the number of candidates.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numba
import numpy as np

from barsight.core.arrays import Float32, Int32, kernel
from barsight.core.records.disparity import DisparityRange

_BLOCK = 16


@dataclass(frozen=True, eq=False)
class Winners:
    """The best candidate of each pixel so far, all (H, W); updated by `take_slices`.

    candidate_px: int32, whole. cost, below, above: its cost and those of the candidates one lower and one
    higher, inf where there was none. last: the costs of the last candidate seen.
    """

    candidate_px: Int32
    cost: Float32
    below: Float32
    above: Float32
    last: Float32


def no_winners(height: int, width: int) -> Winners:
    """Initialise winners before the first slice."""
    shape = (height, width)
    cost, below, above, last = (np.full(shape, np.inf, dtype=np.float32) for _ in range(4))
    return Winners(np.zeros(shape, dtype=np.int32), cost, below, above, last)


def take_slices(winners: Winners, slices: Float32, lowest_px: int) -> None:
    """Update the winners with (K, H, W) slices of the candidates lowest_px..., which must directly follow
    the previous ones.
    """
    _compete(
        slices,
        lowest_px,
        winners.candidate_px,
        winners.cost,
        winners.below,
        winners.above,
        winners.last,
    )


def sweep(
    shape: tuple[int, ...], candidates: DisparityRange, fill: Callable[[int, Float32], None]
) -> Winners:
    """Select the winners of all candidates; `fill(lowest_px, slices)` writes the costs of the next K of them.

    shape: of the image, (H, W). K is at most 16: the memory of the sweep is 21 float32 images.
    """
    height, width = shape
    winners = no_winners(height, width)
    block = np.empty((min(_BLOCK, candidates.count), height, width), dtype=np.float32)
    for first in range(candidates.lowest_px, candidates.highest_px, _BLOCK):
        slices = block[: min(_BLOCK, candidates.highest_px - first)]
        fill(first, slices)
        take_slices(winners, slices, first)
    return winners


def subpixel_winners(winners: Winners) -> Float32:
    """Interpolate the winners (H, W) float32 to subpixels with the parabola through three costs [paper Eq.
    4].

    The result is whole where a neighbour is missing or the costs don't curve upwards, and never moves by more
    than half a pixel.
    """
    complete = np.isfinite(winners.below) & np.isfinite(winners.above)
    below, above = (np.where(complete, one, 0) for one in (winners.below, winners.above))
    bend = below + above - 2 * winners.cost
    usable = complete & (bend > 0)
    offset = np.where(usable, below - above, 0) / np.where(usable, 2 * bend, 1)
    between: Float32 = (winners.candidate_px + offset.clip(-0.5, 0.5)).astype(np.float32)
    return between


@kernel(parallel=True)
def _compete(
    slices: Float32,
    lowest: int,
    candidate: Int32,
    cost: Float32,
    below: Float32,
    above: Float32,
    last: Float32,
) -> None:
    """Update the winners with slices (K, H, W) of the candidates from `lowest` px on.

    Of equal costs the first wins. candidate: px; cost, below, above, last: costs; all (H, W), in place, see
    `Winners`. above is inf until the winner's next candidate has been seen.
    """
    count, height, width = slices.shape
    for row in numba.prange(height):
        for index in range(count):
            shift = np.int32(lowest + index)
            for column in range(width):
                now = slices[index, row, column]
                won = now < cost[row, column]
                if candidate[row, column] == shift - 1:
                    above[row, column] = now
                if won:
                    below[row, column] = last[row, column]
                    above[row, column] = np.inf
                    candidate[row, column] = shift
                    cost[row, column] = now
                last[row, column] = now
