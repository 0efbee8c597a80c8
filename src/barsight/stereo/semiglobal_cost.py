"""The semi-global start's cost of a candidate: 5x5 census [Zabih 1994], x gradient and grey value."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numba import prange
from numpy.typing import NDArray

from barsight.core.arrays import UInt8, kernel

Int16 = NDArray[np.int16]
UInt32 = NDArray[np.uint32]

_UNKNOWN_COST = 60


def census_codes(image: UInt8) -> UInt32:
    codes = np.zeros(image.shape, dtype=np.uint32)
    _write_census(cv2.copyMakeBorder(image, 2, 2, 2, 2, cv2.BORDER_REPLICATE), codes)
    return codes


def row_gradient(image: UInt8) -> Int16:
    gradient: Int16 = cv2.filter2D(image, cv2.CV_16S, np.array([[-1, 0, 1]], dtype=np.float32))
    return gradient


def reversed_rows(image: NDArray[Any]) -> NDArray[Any]:
    return np.ascontiguousarray(image[:, ::-1])


@kernel(parallel=True)
def _write_census(framed: UInt8, codes: UInt32) -> None:
    """Bit k is set where neighbour k is brighter than the centre. framed: (H + 4, W + 4)."""
    height, width = codes.shape
    one = np.uint32(1)
    for y in prange(height):
        row = codes[y]
        centre = framed[y + 2, 2 : 2 + width]
        for dy in range(5):
            for dx in range(5):
                if dy == 2 and dx == 2:
                    continue
                there = framed[y + dy, dx : dx + width]
                for x in range(width):
                    row[x] = (row[x] << one) | np.uint32(there[x] > centre[x])


@kernel()
def row_costs(
    left_code: UInt32,
    right_code: UInt32,
    left_slope: Int16,
    right_slope: Int16,
    left_grey: Int16,
    right_grey: Int16,
    lowest: int,
    cost: UInt8,
) -> None:
    """(W, count) costs of one row. The right row is reversed, so that candidates lie in memory's order."""
    width, count = cost.shape
    for x in range(width):
        base = width - 1 - x + lowest
        first, end = max(0, -base), min(count, width - base)
        here = cost[x]
        if end <= first:
            here[:] = _UNKNOWN_COST
            continue
        code, slope, grey = left_code[x], left_slope[x], left_grey[x]
        codes = right_code[base + first : base + end]
        slopes = right_slope[base + first : base + end]
        greys = right_grey[base + first : base + end]
        inside = here[first:end]
        for k in range(end - first):
            bits = np.uint32(code ^ codes[k])
            bits = np.uint32(bits - ((bits >> np.uint32(1)) & np.uint32(0x55555555)))
            bits = np.uint32(
                (bits & np.uint32(0x33333333)) + ((bits >> np.uint32(2)) & np.uint32(0x33333333))
            )
            bits = np.uint32((bits + (bits >> np.uint32(4))) & np.uint32(0x0F0F0F0F))
            hamming = np.uint32(np.uint32(bits * np.uint32(0x01010101)) >> np.uint32(24))
            steep = min(np.int16(abs(np.int16(slope - slopes[k]))), np.int16(20))
            bright = min(np.int16(abs(np.int16(grey - greys[k]))), np.int16(20))
            inside[k] = np.uint8(np.uint8(hamming) + np.uint8(np.int16(steep + bright) >> np.int16(1)))
        here[:first] = here[first]
        here[end:] = here[end - 1]
