"""Sums over square windows, with nothing but the result written: what several box filters would do in turn.

Beyond the image's ends it goes on mirrored at the last pixel, as OpenCV's filters have it.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from barsight.core.arrays import Float32, Float64, kernel

_BAND_ROWS = 128


def equalised_difference(
    left: Float32, right: Float32, usable: Float32, side: int, contrast_floor: np.float32
) -> Float32:
    """(H, W) left minus right after the means and contrasts of what is `usable` (0...1) in a window of
    side x side pixels are made equal. contrast_floor: power, grey levels^2, added to both contrasts.
    """
    difference = np.empty_like(left)
    _equalise(left, right, usable, side // 2, contrast_floor, difference)
    return difference


def window_means(images: Float32, weight: Float32, side: int, every: int) -> Float32:
    """(K, N, M) means of weight times each of the images (K, H, W) over windows of side x side pixels whose
    middles are every so-manieth row and column, from the first on.
    """
    _, height, width = images.shape
    sums = np.empty((len(images), -(-height // every), -(-width // every)), dtype=np.float32)
    _window_means(images, weight, side // 2, every, sums)
    return sums


@kernel()
def _mirrored(place: int, count: int) -> int:
    while count > 1 and (place < 0 or place >= count):
        place = -place if place < 0 else 2 * (count - 1) - place
    return place if count > 1 else 0


@kernel()
def _add_row(left: Float32, right: Float32, usable: Float32, sign: np.float32, columns: Float64) -> None:
    for x in range(left.shape[0]):
        share = sign * usable[x]
        one, other = share * left[x], share * right[x]
        columns[0, x] += share
        columns[1, x] += one
        columns[2, x] += other
        columns[3, x] += one * left[x]
        columns[4, x] += other * right[x]


@kernel()
def _slide(columns: Float64, reach: int, means: Float32) -> None:
    """Means over windows of each of five rows, out of the sums of its columns."""
    width = columns.shape[1]
    scale = 1.0 / (2 * reach + 1) ** 2
    for part in range(5):
        row, total = columns[part], 0.0
        for step in range(-reach, reach + 1):
            total += row[_mirrored(step, width)]
        means[part, 0] = total * scale
        for x in range(1, width):
            ahead, behind = x + reach, x - reach - 1
            total += row[ahead] if ahead < width else row[_mirrored(ahead, width)]
            total -= row[behind] if behind >= 0 else row[_mirrored(behind, width)]
            means[part, x] = total * scale


@kernel(parallel=True)
def _equalise(
    left: Float32, right: Float32, usable: Float32, reach: int, floor: np.float32, difference: Float32
) -> None:
    height, width = left.shape
    plus, minus, zero = np.float32(1), np.float32(-1), np.float32(0)
    for band in prange((height + _BAND_ROWS - 1) // _BAND_ROWS):
        columns = np.zeros((5, width), dtype=np.float64)
        means = np.empty((5, width), dtype=np.float32)
        first = band * _BAND_ROWS
        for y in range(first - reach, first + reach):
            there = _mirrored(y, height)
            _add_row(left[there], right[there], usable[there], plus, columns)
        for y in range(first, min(height, first + _BAND_ROWS)):
            there = _mirrored(y + reach, height)
            _add_row(left[there], right[there], usable[there], plus, columns)
            _slide(columns, reach, means)
            for x in range(width):
                share = means[0, x] + np.float32(1e-6)
                left_mean, right_mean = means[1, x] / share, means[2, x] / share
                left_power = max(means[3, x] / share - left_mean * left_mean, zero) + floor
                right_power = max(means[4, x] / share - right_mean * right_mean, zero) + floor
                gain = np.sqrt(left_power / right_power)
                difference[y, x] = (left[y, x] - left_mean) - gain * (right[y, x] - right_mean)
            there = _mirrored(y - reach, height)
            _add_row(left[there], right[there], usable[there], minus, columns)


@kernel(parallel=True, fastmath=True)
def _window_means(images: Float32, weight: Float32, reach: int, every: int, sums: Float32) -> None:
    count, height, width = images.shape
    scale = np.float32(1.0 / (2 * reach + 1) ** 2)
    for i in prange(sums.shape[1]):
        columns = np.empty((count, width), dtype=np.float32)
        columns[:] = 0
        for step in range(-reach, reach + 1):
            y = _mirrored(i * every + step, height)
            for part in range(count):
                row = columns[part]
                for x in range(width):
                    row[x] += weight[y, x] * images[part, y, x]
        for j in range(sums.shape[2]):
            for part in range(count):
                total = np.float32(0)
                for step in range(-reach, reach + 1):
                    total += columns[part, _mirrored(j * every + step, width)]
                sums[part, i, j] = scale * total
