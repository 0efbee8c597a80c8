"""Interpolate rows with cubic B-splines: an image at fractional columns, with its exact derivative.

Linear or Keys-cubic interpolation damps fine texture by an amount that depends on the fraction, which pulls a
match towards whole or half pixels. A B-spline with its prefilter has almost no such effect [Thevenaz 2000].
The prefilter decays fourfold per pixel, so it can be combined with a blur in a single convolution.
"""

from __future__ import annotations

import math
from functools import lru_cache

import cv2
import numpy as np

from barsight.core.arrays import Float32, UInt8, kernel
from barsight.core.linalg.bspline import sixfold_weights
from barsight.core.parallel import parallel_bands

_POLE = math.sqrt(3.0) - 2.0
_PREFILTER_REACH = 12
_DIFFERENCE = np.array([-0.5, 0, 0.5], dtype=np.float32)
_BAND_ROWS = 64


def row_coefficients(image: Float32 | UInt8, blur_px: float = 0.0) -> Float32:
    """Compute spline coefficients (H, W + 3) of each row of a (H, W) image, mirrored at the ends; if blur_px
    isn't 0, of the image blurred in both directions by blur_px (one sigma).

    Coefficient k of the image is column k + 1, so that reading needs no bounds check.
    """
    inner = cv2.sepFilter2D(image, cv2.CV_32F, *_filters(blur_px))
    coefficients: Float32 = cv2.copyMakeBorder(inner, 0, 0, 1, 2, cv2.BORDER_REFLECT_101)
    return coefficients


def row_slope(image: Float32 | UInt8, blur_px: float = 0.0) -> Float32:
    """Compute the x derivative (H, W), at the pixels, of the spline of `row_coefficients`."""
    along, across = _filters(blur_px)
    slope: Float32 = cv2.sepFilter2D(image, cv2.CV_32F, np.convolve(along, _DIFFERENCE), across)
    return slope


@lru_cache
def _filters(blur_px: float) -> tuple[Float32, Float32]:
    """Build the filter along the rows (blur and prefilter) and the one across them (blur)."""
    around = np.abs(np.arange(-_PREFILTER_REACH, _PREFILTER_REACH + 1))
    prefilter = math.sqrt(3.0) * _POLE**around
    if blur_px == 0:
        return prefilter.astype(np.float32), np.ones(1, dtype=np.float32)
    side = round(8 * blur_px + 1) | 1
    blur = cv2.getGaussianKernel(side, blur_px)[:, 0]
    return np.convolve(blur, prefilter).astype(np.float32), blur.astype(np.float32)


def value_and_slope(coefficients: Float32, disparity: Float32, margin: int = 0) -> tuple[Float32, Float32]:
    """Interpolate the image and its x derivative at column x - disparity of each row, both (H, W) float32.

    Beyond the image's ends, the end column is read. `disparity` has no NaN; its pixel (0, 0) is `margin` rows
    and columns inside.
    """
    shape = len(coefficients), coefficients.shape[1] - 3
    value, slope = np.empty(shape, dtype=np.float32), np.empty(shape, dtype=np.float32)

    def read(first: int, end: int) -> None:
        _read(coefficients, disparity, margin, value, slope, first, end)

    parallel_bands(read, shape[0], _BAND_ROWS)
    return value, slope


@kernel()
def _read(
    coefficients: Float32, disparity: Float32, margin: int, value: Float32, slope: Float32, first_row: int,
    end_row: int,
) -> None:  # fmt: skip
    """Evaluate the cubic B-spline and its x derivative at column x - disparity [Thevenaz 2000].

    coefficients: (H, W + 3), see `row_coefficients`. disparity: px, no NaN, with its pixel (0, 0) `margin`
    rows and columns inside. Fills value and slope (per px), (H, W), in rows first_row...end_row.
    """
    width = value.shape[1]
    one, two, three = np.float32(1), np.float32(2), np.float32(3)
    four, half, sixth = np.float32(4), np.float32(0.5), np.float32(1 / 6)
    last, last_first = np.float32(width - 1), np.int32(max(width - 2, 0))
    for y in range(first_row, end_row):
        row, shift = coefficients[y], disparity[y + margin, margin : margin + width]
        values, slopes = value[y], slope[y]
        for x in range(width):
            place = min(max(np.float32(np.int32(x)) - shift[x], np.float32(0)), last)
            first = min(np.int32(place), last_first)
            t = place - np.float32(first)
            t2 = t * t
            w0, w1, w2, w3 = sixfold_weights(t)
            at = np.uint64(first)
            c0, c1, c2, c3 = row[at], row[at + np.uint64(1)], row[at + np.uint64(2)], row[at + np.uint64(3)]
            values[x] = sixth * (c0 * w0 + c1 * w1 + c2 * w2 + c3 * w3)
            slopes[x] = half * (
                c1 * (three * t2 - four * t)
                - c0 * (one - two * t + t2)
                + c2 * (one + two * t - three * t2)
                + c3 * t2
            )
