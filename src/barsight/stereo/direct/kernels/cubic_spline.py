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
    slope = np.empty((len(coefficients), coefficients.shape[1] - 3), dtype=np.float32)
    return _read_bands(coefficients, disparity, margin, slope), slope


def interpolated_value(coefficients: Float32, disparity: Float32, margin: int = 0) -> Float32:
    """Interpolate the image alone, (H, W), as `value_and_slope` does."""
    return _read_bands(coefficients, disparity, margin, np.empty((0, 0), dtype=np.float32))


def _read_bands(coefficients: Float32, disparity: Float32, margin: int, slope: Float32) -> Float32:
    """Return the values (H, W), and fill the slopes (H, W) unless there are none."""
    value = np.empty((len(coefficients), coefficients.shape[1] - 3), dtype=np.float32)

    def read(first: int, end: int) -> None:
        _read(coefficients, disparity, margin, value, slope, first, end)

    parallel_bands(read, len(value), _BAND_ROWS)
    return value


@kernel()
def _read(
    coefficients: Float32, disparity: Float32, margin: int, value: Float32, slope: Float32, first_row: int,
    end_row: int,
) -> None:  # fmt: skip
    """Evaluate the cubic B-spline and its x derivative at column x - disparity [Thevenaz 2000].

    coefficients: (H, W + 3), see `row_coefficients`. disparity: px, no NaN, with its pixel (0, 0) `margin`
    rows and columns inside. Fills value and slope (per px), (H, W), in rows first_row...end_row; the slope
    may have no rows, then it isn't asked for.
    """
    width = value.shape[1]
    last, last_first = np.float32(width - 1), np.int32(max(width - 2, 0))
    firsts, parts = np.empty(width, dtype=np.int32), np.empty(width, dtype=np.float32)
    near = np.empty((4, width), dtype=np.float32)
    for y in range(first_row, end_row):
        row, shift = coefficients[y], disparity[y + margin, margin : margin + width]
        for x in range(width):
            place = min(max(np.float32(np.int32(x)) - shift[x], np.float32(0)), last)
            first = min(np.int32(place), last_first)
            firsts[x] = first
            parts[x] = place - np.float32(first)
        c0, c1, c2, c3 = near[0], near[1], near[2], near[3]
        # What lies anywhere is gathered apart, so that all else is vector code.
        for x in range(width):
            at = np.uint64(firsts[x])
            c0[x], c1[x] = row[at], row[at + np.uint64(1)]
            c2[x], c3[x] = row[at + np.uint64(2)], row[at + np.uint64(3)]
        _blend(c0, c1, c2, c3, parts, value[y])
        if len(slope) > 0:
            _blend_slopes(c0, c1, c2, c3, parts, slope[y])


@kernel(inline=True)
def _blend(c0: Float32, c1: Float32, c2: Float32, c3: Float32, parts: Float32, values: Float32) -> None:
    """Blend four coefficients (W,) each to the spline's values (W,), `parts` (W,) of a pixel behind the
    second.
    """
    sixth = np.float32(1 / 6)
    for x in range(len(values)):
        w0, w1, w2, w3 = sixfold_weights(parts[x])
        values[x] = sixth * (c0[x] * w0 + c1[x] * w1 + c2[x] * w2 + c3[x] * w3)


@kernel(inline=True)
def _blend_slopes(
    c0: Float32, c1: Float32, c2: Float32, c3: Float32, parts: Float32, slopes: Float32
) -> None:
    """Blend four coefficients (W,) each to the spline's slopes (W,), as `_blend`."""
    one, two, three = np.float32(1), np.float32(2), np.float32(3)
    four, half = np.float32(4), np.float32(0.5)
    for x in range(len(slopes)):
        t = parts[x]
        t2 = t * t
        slopes[x] = half * (
            c1[x] * (three * t2 - four * t)
            - c0[x] * (one - two * t + t2)
            + c2[x] * (one + two * t - three * t2)
            + c3[x] * t2
        )
