"""Average over square windows in one pass that writes nothing but the result.

Beyond its ends the image is mirrored at the last pixel, as in OpenCV's filters. A band is processed row by
row: each column's sum over a window's rows adds the row ahead and subtracts the one behind (`roll_*`), and
`slide_window` adds up the columns. The loops are this short, with one array written in each, because the
compiler vectorises no others.
"""

from __future__ import annotations

import numpy as np

from barsight.core.arrays import Float32, Float64, kernel
from barsight.core.parallel import parallel_bands

BAND_ROWS = 128


def window_means(images: Float32, weight: Float32, side: int, every: int) -> Float32:
    """Average weight times each of the images (K, H, W) over windows of side x side pixels, centred on
    every `every`th row and column from the first on; returns (K, N, M).
    """
    _, height, width = images.shape
    sums = np.empty((len(images), -(-height // every), -(-width // every)), dtype=np.float32)

    def add(first: int, end: int) -> None:
        _window_means(images, weight, side // 2, every, sums, first, end)

    parallel_bands(add, sums.shape[1], 8)
    return sums


@kernel()
def mirror_index(place: int, count: int) -> int:
    """Mirror `place` into 0...count - 1."""
    while count > 1 and (place < 0 or place >= count):
        place = -place if place < 0 else 2 * (count - 1) - place
    return place if count > 1 else 0


@kernel()
def allocate_columns(count: int, width: int, reach: int) -> Float64:
    """Allocate columns' sums (N, W + 2 reach + 2) for N of the roll_* functions below, initially zero."""
    return np.zeros((count, width + 2 * reach + 2))


@kernel()
def roll_sum(column: Float64, reach: int, ahead: Float32, behind: Float32) -> None:
    """Update the columns' sums: add the row ahead, subtract the row behind.

    column: (W + 2 reach + 2,), a row of `allocate_columns`, of which column[reach : reach + W] changes.
    ahead, behind: (W,).
    """
    inner = column[reach : reach + ahead.shape[0]]
    for x in range(ahead.shape[0]):
        inner[x] += np.float64(ahead[x]) - np.float64(behind[x])


@kernel()
def roll_product(
    column: Float64, reach: int, ahead: Float32, ahead_other: Float32, behind: Float32, behind_other: Float32
) -> None:
    """Update the columns' sums of products: add those of the rows ahead, subtract those behind. See
    `roll_sum`; rows (W,).
    """
    inner = column[reach : reach + ahead.shape[0]]
    for x in range(ahead.shape[0]):
        inner[x] += np.float64(ahead[x] * ahead_other[x]) - np.float64(behind[x] * behind_other[x])


@kernel()
def roll_square(
    column: Float64, reach: int, ahead: Float32, ahead_other: Float32, behind: Float32, behind_other: Float32
) -> None:
    """Update the columns' sums of the first row times the square of the other. See `roll_sum`; rows (W,)."""
    inner = column[reach : reach + ahead.shape[0]]
    for x in range(ahead.shape[0]):
        coming = ahead[x] * ahead_other[x] * ahead_other[x]
        inner[x] += np.float64(coming) - np.float64(behind[x] * behind_other[x] * behind_other[x])


@kernel()
def _add_columns(column: Float64, threes: Float32, side: int, mean: Float32) -> None:
    """Average (W,) over `side` columns each: sum in threes first, so that each column is read a third as
    often.

    column: at least (W + side - 1,) sums. threes: scratch, 2 shorter than column.
    """
    count, width = side // 3, mean.shape[0]
    one, two, three = column[:-2], column[1:-1], column[2:]
    for x in range(threes.shape[0]):
        threes[x] = np.float32(one[x] + two[x] + three[x])
    mean[:] = 0
    done = 0
    for _ in range(count // 3):
        # Three at once, in the same order: the mean is written a third as often.
        ahead = threes[done : done + width + 6]
        for x in range(width):
            mean[x] = mean[x] + ahead[x] + ahead[x + 3] + ahead[x + 6]
        done += 9
    for step in range(done, 3 * count, 3):
        ahead = threes[step : step + width]
        for x in range(width):
            mean[x] += ahead[x]
    for step in range(3 * count, side):
        last = column[step : step + width]
        for x in range(width):
            mean[x] += np.float32(last[x])
    scale = np.float32(1.0 / (side * side))
    for x in range(width):
        mean[x] *= scale


@kernel()
def slide_window(column: Float64, reach: int, mean: Float32) -> None:
    """Average (W,) over windows of 2 reach + 1 columns, with the sums in column[reach : reach + W]."""
    width, side = mean.shape[0], 2 * reach + 1
    for step in range(1, reach + 1):
        column[reach - step] = column[reach + mirror_index(-step, width)]
        column[reach + width - 1 + step] = column[reach + mirror_index(width - 1 + step, width)]
    _add_columns(column, np.empty(len(column) - 2, dtype=np.float32), side, mean)


@kernel()
def _window_means(
    images: Float32, weight: Float32, reach: int, every: int, sums: Float32, first: int, end: int
) -> None:
    """Average weighted images over square windows, rows first...end of the result.

    images: (K, H, W); weight: (H, W). Windows are 2 reach + 1 px wide, with mirrored borders and their
    centres `every` px apart. Fills sums (K, ceil(H / every), ceil(W / every)).
    """
    count, height, width = images.shape
    scale = np.float32(1.0 / (2 * reach + 1) ** 2)
    columns = np.empty((count, width), dtype=np.float32)
    for i in range(first, end):
        columns[:] = 0
        for step in range(-reach, reach + 1):
            y = mirror_index(i * every + step, height)
            for part in range(count):
                row = columns[part]
                for x in range(width):
                    row[x] += weight[y, x] * images[part, y, x]
        for j in range(sums.shape[2]):
            for part in range(count):
                total = np.float32(0)
                for step in range(-reach, reach + 1):
                    total += columns[part, mirror_index(j * every + step, width)]
                sums[part, i, j] = scale * total
