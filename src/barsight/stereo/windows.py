"""Sums over square windows, with nothing but the result written: what several box filters would do in turn.

Beyond the image's ends it goes on mirrored at the last pixel, as OpenCV's filters have it. A band's rows roll
by: each column's sum over a window's rows takes in the row ahead and lets go of the one behind (`roll_*`),
and `slide` adds the columns up. The loops stay this short, with one array written in each, because the
compiler makes vectors of no others.
"""

from __future__ import annotations

import numpy as np

from barsight.core.arrays import Float32, Float64, kernel
from barsight.core.parallel import in_bands

BAND_ROWS = 128


def window_means(images: Float32, weight: Float32, side: int, every: int) -> Float32:
    """(K, N, M) means of weight times each of the images (K, H, W) over windows of side x side pixels whose
    middles are every so-manieth row and column, from the first on.
    """
    _, height, width = images.shape
    sums = np.empty((len(images), -(-height // every), -(-width // every)), dtype=np.float32)

    def add(first: int, end: int) -> None:
        _window_means(images, weight, side // 2, every, sums, first, end)

    in_bands(add, sums.shape[1], 8)
    return sums


@kernel()
def mirrored(place: int, count: int) -> int:
    """The place inside 0...count - 1 that `place` is a mirror image of."""
    while count > 1 and (place < 0 or place >= count):
        place = -place if place < 0 else 2 * (count - 1) - place
    return place if count > 1 else 0


@kernel()
def roll_sum(column: Float64, reach: int, ahead: Float32, behind: Float32) -> None:
    """column: (W + 2 reach + 1,) sums; a row ahead comes in, one behind goes."""
    for x in range(ahead.shape[0]):
        column[reach + x] += np.float64(ahead[x]) - np.float64(behind[x])


@kernel()
def roll_product(
    column: Float64, reach: int, ahead: Float32, ahead_other: Float32, behind: Float32, behind_other: Float32
) -> None:
    """The same of products."""
    for x in range(ahead.shape[0]):
        column[reach + x] += np.float64(ahead[x] * ahead_other[x]) - np.float64(behind[x] * behind_other[x])


@kernel()
def roll_square(
    column: Float64, reach: int, ahead: Float32, ahead_other: Float32, behind: Float32, behind_other: Float32
) -> None:
    """The same of the first times the square of the other."""
    for x in range(ahead.shape[0]):
        coming = ahead[x] * ahead_other[x] * ahead_other[x]
        column[reach + x] += np.float64(coming) - np.float64(behind[x] * behind_other[x] * behind_other[x])


@kernel()
def slide(column: Float64, reach: int, mean: Float32) -> None:
    """The means (W,) over windows of 2 reach + 1 columns, whose sums are column[reach : reach + W].

    Four quarters of the row go at once: one waits for the sum before.
    """
    width, side = mean.shape[0], 2 * reach + 1
    for step in range(1, reach + 1):
        column[reach - step] = column[reach + mirrored(-step, width)]
        column[reach + width - 1 + step] = column[reach + mirrored(width - 1 + step, width)]
    scale = 1.0 / (side * side)
    quarter = width // 4
    a = b = c = d = 0.0
    for step in range(side):
        a += column[step]
        b += column[quarter + step]
        c += column[2 * quarter + step]
        d += column[3 * quarter + step]
    for x in range(quarter):
        mean[x] = a * scale
        a += column[x + side] - column[x]
        y = quarter + x
        mean[y] = b * scale
        b += column[y + side] - column[y]
        y += quarter
        mean[y] = c * scale
        c += column[y + side] - column[y]
        y += quarter
        mean[y] = d * scale
        d += column[y + side] - column[y]
    for x in range(4 * quarter, width):
        mean[x] = d * scale
        d += column[x + side] - column[x]


@kernel(fastmath=True)
def _window_means(
    images: Float32, weight: Float32, reach: int, every: int, sums: Float32, first: int, end: int
) -> None:
    count, height, width = images.shape
    scale = np.float32(1.0 / (2 * reach + 1) ** 2)
    columns = np.empty((count, width), dtype=np.float32)
    for i in range(first, end):
        columns[:] = 0
        for step in range(-reach, reach + 1):
            y = mirrored(i * every + step, height)
            for part in range(count):
                row = columns[part]
                for x in range(width):
                    row[x] += weight[y, x] * images[part, y, x]
        for j in range(sums.shape[2]):
            for part in range(count):
                total = np.float32(0)
                for step in range(-reach, reach + 1):
                    total += columns[part, mirrored(j * every + step, width)]
                sums[part, i, j] = scale * total
