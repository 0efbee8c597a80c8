"""Cubic B-splines along the rows: an image read at fractional columns, with its exact derivative.

Linear or Keys-cubic reading damps fine texture by an amount that depends on the fraction, and that pulls a
match towards whole or half pixels. A B-spline with its prefilter nearly doesn't [Thevenaz 2000].
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from barsight.core.arrays import Float32, kernel

_POLE = math.sqrt(3.0) - 2.0
_TAIL = 16


def row_coefficients(image: Float32) -> Float32:
    """(H, W + 3) spline coefficients of each row of a (H, W) image, mirrored at the ends.

    Coefficient k of the image is column k + 1, so that a reader needs no bounds check.
    """
    coefficients = np.empty((image.shape[0], image.shape[1] + 3), dtype=np.float32)
    _prefilter(image, coefficients)
    return coefficients


def value_and_slope(coefficients: Float32, disparity: Float32) -> tuple[Float32, Float32]:
    """The image and its x derivative at column x - disparity of each row, both (H, W) float32.

    Beyond the image's ends the end column is read. `disparity` has no NaN.
    """
    value = np.empty(disparity.shape, dtype=np.float32)
    slope = np.empty(disparity.shape, dtype=np.float32)
    _read(coefficients, disparity, value, slope)
    return value, slope


@kernel(parallel=True, fastmath=True)
def _prefilter(image: Float32, coefficients: Float32) -> None:
    height, width = image.shape
    pole = np.float32(_POLE)
    for y in prange(height):
        forward = np.empty(width, dtype=np.float32)
        start = np.float32(0)
        power = np.float32(1)
        for x in range(min(width, _TAIL)):
            start += power * image[y, x]
            power *= pole
        forward[0] = start
        for x in range(1, width):
            forward[x] = image[y, x] + pole * forward[x - 1]
        last = width - 1
        before = forward[last - 1] if width > 1 else forward[0]
        forward[last] = (pole / (pole * pole - 1)) * (forward[last] + pole * before)
        for x in range(width - 2, -1, -1):
            forward[x] = pole * (forward[x + 1] - forward[x])
        for x in range(width):
            coefficients[y, x + 1] = np.float32(6) * forward[x]
        coefficients[y, 0] = coefficients[y, min(2, width)]
        coefficients[y, width + 1] = coefficients[y, max(width - 1, 1)]
        coefficients[y, width + 2] = coefficients[y, max(width - 2, 1)]


@kernel(parallel=True, fastmath=True)
def _read(coefficients: Float32, disparity: Float32, value: Float32, slope: Float32) -> None:
    height, width = disparity.shape
    one, two, three = np.float32(1), np.float32(2), np.float32(3)
    four, six, half, sixth = np.float32(4), np.float32(6), np.float32(0.5), np.float32(1 / 6)
    for y in prange(height):
        row = coefficients[y]
        for x in range(width):
            place = min(max(np.float32(x) - disparity[y, x], np.float32(0)), np.float32(width - 1))
            first = min(int(place), max(width - 2, 0))
            t = place - np.float32(first)
            t2 = t * t
            t3 = t2 * t
            c0, c1, c2, c3 = row[first], row[first + 1], row[first + 2], row[first + 3]
            value[y, x] = sixth * (
                c0 * (one - three * t + three * t2 - t3)
                + c1 * (four - six * t2 + three * t3)
                + c2 * (one + three * t + three * t2 - three * t3)
                + c3 * t3
            )
            slope[y, x] = half * (
                c1 * (three * t2 - four * t)
                - c0 * (one - two * t + t2)
                + c2 * (one + two * t - three * t2)
                + c3 * t2
            )
