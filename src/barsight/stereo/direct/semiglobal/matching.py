"""Match semi-globally [Hirschmueller 2008] with a cost that is robust to gain and to single bright pixels.

Cost of a candidate: Hamming distance of the 5x5 census [Zabih 1994], plus truncated differences of the x
gradient and of the gray value. There are eight paths; the penalty of a jump is reduced where the image has an
edge. The image is processed in stripes of rows, each with its own cost volume, so memory doesn't grow with
the height.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from barsight.core.arrays import Float32, Int32, UInt8, kernel
from barsight.core.errors import ConfigError
from barsight.core.parallel import parallel_bands
from barsight.stereo.direct.semiglobal.cost import (
    BESIDE_COST,
    LANES,
    PixelDescriptors,
    describe_pixels,
    reverse_rows,
    row_costs,
)
from barsight.stereo.direct.semiglobal.paths import Penalties, UInt16, allocate_paths, extend_row, p2_table

_OVERLAP_ROWS = 20
_STRIPE_BYTES = 128 * 2**20
_FAR = np.float32(-1e6)
_WORST = np.int32(2**31 - 1)
_LARGEST_BYTE = 255


@dataclass(frozen=True)
class SemiGlobalSettings:
    """Settings of semi-global matching."""

    p1: int = 22
    """Penalty for a change of one candidate between neighbours."""
    p2: int = 150
    """Penalty for a larger change where the image is flat; an edge of 8 gray levels halves it."""
    min_p2: int = 28
    """Minimum penalty for a larger change, reached across a strong image edge."""

    def __post_init__(self) -> None:
        if not 0 < self.p1 <= self.min_p2 <= self.p2:
            raise ConfigError("semiglobal: the penalties must be 0 < p1 <= min_p2 <= p2")
        if self.p1 + self.p2 > _LARGEST_BYTE - BESIDE_COST:
            raise ConfigError(f"semiglobal: p1 + p2 can't exceed {_LARGEST_BYTE - BESIDE_COST}")


@dataclass(frozen=True, eq=False)
class SemiGlobalMatch:
    """Disparities of both images, (H, W) float32: left_px with subpixels, right_px in whole pixels.

    right_px is -1e6 where no candidate lies in the left image.
    """

    left_px: Float32
    right_px: Float32


def match_semiglobal(
    left: UInt8, right: UInt8, lowest_px: int, count: int, settings: SemiGlobalSettings
) -> SemiGlobalMatch:
    """Match every pixel among `count` candidates from lowest_px on with semi-global matching.

    Memory: at most about 130 MB per thread, or 40 rows' cost volume if that is more.
    """
    height, width = left.shape
    left_px, right_px = np.empty((2, height, width), dtype=np.float32)
    threads, places = numba.get_num_threads(), -(-count // LANES) * LANES
    affordable = max(_STRIPE_BYTES // (3 * width * places) - 2 * _OVERLAP_ROWS, 16)
    # Paths end where a stripe ends, so stripes must not depend on the machine's threads: they suit two.
    stripes = 2 * -(-height // (2 * min(affordable, 256)))
    rows = -(-height // stripes)
    volume = (min(height, rows + 2 * _OVERLAP_ROWS), width, places)
    rooms = [(np.empty(volume, dtype=np.uint8), np.empty(volume, dtype=np.uint16)) for _ in range(threads)]
    seen, others = describe_pixels(left), reverse_rows(describe_pixels(right), lowest_px, places)
    penalties = Penalties(settings.p1, p2_table(settings.p2, settings.min_p2))

    def work(first: int, end: int) -> None:
        room = rooms.pop()
        _match_stripe(seen, others, lowest_px, count, penalties, room, (left_px, right_px), first, end)
        rooms.append(room)

    parallel_bands(work, height, rows)
    return SemiGlobalMatch(left_px, right_px)


@kernel()
def _compete(
    down: UInt16, up: UInt16, at: int, count: int, minima: Int32, right: int
) -> np.int32:  # fmt: skip
    """Find the smallest key of one left pixel; its keys replace larger ones in `minima`, the key of candidate
    k at `right` + k.

    A key holds a candidate's sum and, in the lower 16 bits, the candidate: the smallest number wins. down,
    up: flat, the pixel's sums of four paths each from `at` on. minima: (W,) with a margin on both sides.
    """
    winner = np.int32(_WORST)
    # Unsigned: a loop whose index might be negative, and count from the end, isn't vectorised.
    first, there = np.uint64(at), np.uint64(right)
    for i in range(count):
        k = np.uint64(i)
        total = np.int32(np.int32(down[first + k]) + np.int32(up[first + k]))
        key = np.int32(np.int32(total << np.int32(16)) | np.int32(i))
        winner = key if key < winner else winner
        other = minima[there + k]
        minima[there + k] = key if key < other else other
    return winner


@kernel()
def _choose(
    down: UInt16, up: UInt16, count: int, lowest: int, minima: Int32, left_px: Float32, right_px: Float32
) -> None:
    """Choose the winners of one row for both images; the left ones get subpixels from the equiangular line
    fit, which suits a cost that rises linearly [Shimizu 2002]. The right ones are stored reversed in between,
    so that a left pixel's candidates are contiguous in memory. down, up: (W, places) sums of four paths each.
    minima: scratch, with a margin on both sides for candidates outside the right image.

    Fills left_px and right_px (W,).
    """
    width, places = down.shape
    downs, ups = down.reshape(-1), up.reshape(-1)
    margin = (len(minima) - width) // 2
    minima[:] = _WORST
    for x in range(width):
        at = x * places
        winner = _compete(downs, ups, at, count, minima, margin + width - 1 - x + lowest)
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
        found = minima[margin + width - 1 - x]
        right_px[x] = np.float32((found & 0xFFFF) + lowest) if found < _WORST else _FAR


@kernel()
def _match_stripe(
    left: PixelDescriptors, right: PixelDescriptors, lowest: int, count: int, penalties: Penalties,
    room: tuple[UInt8, UInt16], px: tuple[Float32, Float32], start: int, end: int,
) -> None:  # fmt: skip
    """Match rows start...end: once downwards, where the costs are computed, and once upwards, where the
    winners are chosen row by row.

    right: reversed, see `reverse_rows`. room: volumes (rows, W, places) as scratch. Fills px, the disparities
    (H, W) of the left and the right image.
    """
    cost, down = room
    left_px, right_px = px
    gray = left.gray
    height, width = gray.shape
    places = cost.shape[2]
    paths = allocate_paths(width, places, penalties.small)
    leasts = np.empty((2, width, 3), dtype=np.uint8)
    up = np.empty((width, places), dtype=np.uint16)
    minima = np.empty(width + 2 * (abs(lowest) + places), dtype=np.int32)
    above, below = max(0, start - _OVERLAP_ROWS), min(height, end + _OVERLAP_ROWS)
    for y in range(above, below):
        here = cost[y - above]
        row_costs(left, right, y, lowest, count, here)
        extend_row(
            here, gray[y], gray[max(y - 1, 0)], penalties, y == above, (y & 1) == 1, False, paths, leasts,
            down[y - above],
        )  # fmt: skip
    for y in range(below - 1, start - 1, -1):
        extend_row(
            cost[y - above], gray[y], gray[min(y + 1, height - 1)], penalties, y == below - 1, (y & 1) == 1,
            True, paths, leasts, up,
        )  # fmt: skip
        if y < end:
            _choose(down[y - above], up, count, lowest, minima, left_px[y], right_px[y])
