"""Compute a noise-tolerant Census transform and its Hamming distance as a matching cost [Peng et al. 2017].

The neighbours are compared with a weighted mean of the central 3x3 pixels instead of the central pixel, and
count as equal within a tolerance: each of the 62 neighbours of the 9x7 window yields two bits, brighter and
darker. The distance of two codes is the number of bits that differ, 0...124.
"""

from __future__ import annotations

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from barsight.core.arrays import Bool, Float32, UInt8, kernel

UInt64 = NDArray[np.uint64]
WIDTH_PX, HEIGHT_PX = 9, 7
WORST = 2 * (WIDTH_PX * HEIGHT_PX - 1)


def census_codes(image: UInt8, tolerance: float) -> UInt64:
    """Encode (2, H, W) uint64: the bits `brighter` and `darker` of each pixel's window, with replicated
    borders.

    tolerance: in gray levels; a neighbour counts as brighter or darker if it differs from the reference by
    more.
    """
    gray = image.astype(np.float32)
    reference = cv2.GaussianBlur(gray, (3, 3), 0, borderType=cv2.BORDER_REPLICATE)
    margins = (HEIGHT_PX // 2, HEIGHT_PX // 2, WIDTH_PX // 2, WIDTH_PX // 2)
    padded = cv2.copyMakeBorder(gray, *margins, cv2.BORDER_REPLICATE)
    codes = np.zeros((2, *image.shape), dtype=np.uint64)
    _encode(padded, reference, np.float32(tolerance), codes)
    return codes


def census_cost(
    left: UInt64, right: UInt64, left_valid: Bool, right_valid: Bool, lowest_px: int, slices: Float32
) -> None:
    """Fill (K, H, W) slices with the distances of the candidates lowest_px...; half of `WORST`, the
    expected distance of two unrelated codes, where either pixel is invalid or outside.
    """
    _distances(left, right, left_valid, right_valid, lowest_px, np.float32(WORST / 2), slices)


@kernel()
def _ones(word: np.uint64) -> np.uint64:
    """Count set bits in pairs, fours and bytes, and add up the bytes with a multiplication [Warren 2012]."""
    pairs = word - ((word >> np.uint64(1)) & np.uint64(0x5555555555555555))
    fours = (pairs & np.uint64(0x3333333333333333)) + (
        (pairs >> np.uint64(2)) & np.uint64(0x3333333333333333)
    )
    octets = (fours + (fours >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return np.uint64((octets * np.uint64(0x0101010101010101)) >> np.uint64(56))


@kernel(parallel=True)
def _encode(padded: Float32, reference: Float32, tolerance: np.float32, codes: UInt64) -> None:
    """Compute the ternary Census transform of each pixel [Peng et al. 2017].

    padded: (H + 6, W + 8) gray levels with replicated borders; reference: (H, W) weighted means to compare
    with; tolerance: gray levels. codes: (2, H, W), initially zero, filled with the bits `brighter`, `darker`.
    """
    height, width = reference.shape
    for row in numba.prange(height):
        brighter, darker, middle = codes[0, row], codes[1, row], reference[row]
        for y in range(HEIGHT_PX):
            for x in range(WIDTH_PX):
                if y == HEIGHT_PX // 2 and x == WIDTH_PX // 2:
                    continue
                neighbour = padded[row + y, x : x + width]
                for column in range(width):
                    step = neighbour[column] - middle[column]
                    brighter[column] = (brighter[column] << np.uint64(1)) | np.uint64(step > tolerance)
                    darker[column] = (darker[column] << np.uint64(1)) | np.uint64(step < -tolerance)


@kernel(parallel=True)
def _distances(
    left: UInt64,
    right: UInt64,
    left_valid: Bool,
    right_valid: Bool,
    lowest: int,
    unknown: np.float32,
    slices: Float32,
) -> None:
    """Compute Hamming distances, 0...124, of the candidates from `lowest` px on.

    left, right: (2, H, W) codes; left_valid, right_valid: (H, W). Fills slices (K, H, W): left pixel x
    against right pixel x - d, `unknown` where either is invalid or outside.
    """
    count, height, width = slices.shape
    for row in numba.prange(height):
        for index in range(count):
            shift = lowest + index
            first, end = max(0, shift), min(width, width + shift)
            slices[index, row, :] = unknown
            if end > first:
                _differences(
                    left[0, row, first:end],
                    left[1, row, first:end],
                    right[0, row, first - shift : end - shift],
                    right[1, row, first - shift : end - shift],
                    left_valid[row, first:end],
                    right_valid[row, first - shift : end - shift],
                    unknown,
                    slices[index, row, first:end],
                )


@kernel()
def _differences(
    left_brighter: UInt64,
    left_darker: UInt64,
    right_brighter: UInt64,
    right_darker: UInt64,
    left_valid: Bool,
    right_valid: Bool,
    unknown: np.float32,
    costs: Float32,
) -> None:
    """Compute a row's Hamming distances at one candidate.

    All arrays are (W,), and right pixel i is the match of left pixel i. Fills costs; `unknown` where either
    is invalid.
    """
    for x in range(costs.shape[0]):
        bits = _ones(left_brighter[x] ^ right_brighter[x]) + _ones(left_darker[x] ^ right_darker[x])
        costs[x] = np.float32(bits) if left_valid[x] & right_valid[x] else unknown
