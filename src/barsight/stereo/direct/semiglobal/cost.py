"""Compute the semi-global start's cost: 5x5 census [Zabih 1994], x gradient and gray value."""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from barsight.core.arrays import UInt8, kernel
from barsight.core.parallel import parallel_bands
from barsight.stereo.direct.kernels.vectors import stack_array

Int16 = NDArray[np.int16]

UNKNOWN_COST = 60
BESIDE_COST = 61
"""Cost of the padding that fills the last vector: higher than any candidate's, so that no path goes there."""
LANES = 16
"""Multiple to which candidates are padded, so that no vector is left half empty."""
_MAX_APART = 20
_CODE_BYTES = 3
_BAND_ROWS = 64


class PixelDescriptors(NamedTuple):
    """Descriptors of each pixel. codes: (H, 3, W) the 24 bits of the census. slope: (H, W) difference
    between the neighbours in the row. gray: (H, W).
    """

    codes: UInt8
    slope: Int16
    gray: UInt8


def describe_pixels(image: UInt8) -> PixelDescriptors:
    """Compute the descriptors of an image (H, W)."""
    height, width = image.shape
    codes = np.empty((height, _CODE_BYTES, width), dtype=np.uint8)
    framed = cv2.copyMakeBorder(image, 2, 2, 2, 2, cv2.BORDER_REPLICATE)
    parallel_bands(lambda first, end: _write_census(framed, codes, first, end), height, _BAND_ROWS)
    slope: Int16 = cv2.filter2D(image, cv2.CV_16S, np.array([[-1, 0, 1]], dtype=np.float32))
    return PixelDescriptors(codes, slope, image)


def reverse_rows(right: PixelDescriptors, lowest: int, places: int) -> PixelDescriptors:
    """Reverse the rows of the right image, so that a left pixel's candidates are contiguous in memory:
    column W - 1 - x + k holds candidate k of left column x. Padded so that each of the `places` can be
    read.
    """
    before, after = max(0, -lowest), max(0, lowest + places)

    def turned(array: NDArray[Any]) -> NDArray[Any]:
        margins = [(0, 0)] * (array.ndim - 1) + [(before, after)]
        return np.pad(array[..., ::-1], margins)[..., before + lowest :]

    return PixelDescriptors(
        *(np.ascontiguousarray(turned(a)) for a in (right.codes, right.slope, right.gray))
    )


@kernel()
def _write_census(framed: UInt8, codes: UInt8, first: int, end: int) -> None:
    """Set a bit for each neighbour that is brighter than the centre. framed: (H + 4, W + 4)."""
    width = codes.shape[2]
    one = np.uint8(1)
    for y in range(first, end):
        centre = framed[y + 2, 2 : 2 + width]
        for part in range(_CODE_BYTES):
            row = codes[y, part]
            row[:] = 0
            for bit in range(8):
                neighbour = part * 8 + bit
                place = neighbour + 1 if neighbour >= 12 else neighbour
                there = framed[y + place // 5, place % 5 : place % 5 + width]
                for x in range(width):
                    row[x] = np.uint8(np.uint8(row[x] << one) | np.uint8(there[x] > centre[x]))


@kernel(inline=True)
def _bits_in_halves(byte: np.uint8) -> np.uint8:
    """Count the bits set in each half of a byte, first in pairs, then in fours."""
    pairs = np.uint8(byte - np.uint8(np.uint8(byte >> np.uint8(1)) & np.uint8(0x55)))
    return np.uint8(
        np.uint8(pairs & np.uint8(0x33)) + np.uint8(np.uint8(pairs >> np.uint8(2)) & np.uint8(0x33))
    )


@kernel()
def descriptor_cost(left: PixelDescriptors, right: PixelDescriptors, y: int, x: int, column: int) -> int:
    """Compute the cost of matching left pixel (y, x) with the right one in `column`: the Hamming distance
    of the census plus half the truncated differences of slope and gray value.
    """
    # Signed: a difference of unsigned numbers would wrap.
    hamming = np.int64(0)
    for part in range(_CODE_BYTES):
        halves = _bits_in_halves(np.uint8(left.codes[y, part, x] ^ right.codes[y, part, column]))
        hamming += np.int64(halves & np.uint8(0x0F)) + np.int64(halves >> np.uint8(4))
    steep = min(abs(np.int64(left.slope[y, x]) - np.int64(right.slope[y, column])), np.int64(_MAX_APART))
    bright = min(abs(np.int64(left.gray[y, x]) - np.int64(right.gray[y, column])), np.int64(_MAX_APART))
    return int(hamming + (steep + bright) // 2)


@kernel()
def _write_costs(
    own: tuple[np.uint8, np.uint8, np.uint8, np.int16, np.uint8],
    row: tuple[UInt8, UInt8, UInt8, Int16, UInt8], at: int, cost: UInt8,
) -> None:  # fmt: skip
    """Compute the costs (places,) of one left pixel with the right ones from column `at` on.

    own, row: the three bytes of the census, slope and gray, of the pixel and of the right row.
    """
    one, two, three, slope, gray = own
    ones, twos, threes, slopes, grays = row
    # Unsigned: a loop whose index might be negative, and count from the end, isn't vectorised.
    first, most = np.uint64(at), np.int16(_MAX_APART)
    found = stack_array(LANES, np.uint8)
    for part in range(0, cost.shape[0], LANES):
        for lane in range(LANES):
            i = np.uint64(part) + np.uint64(lane)
            k = first + i
            changed, changed_too, third = (
                np.uint8(one ^ ones[k]), np.uint8(two ^ twos[k]), np.uint8(three ^ threes[k]),
            )  # fmt: skip
            # Three bytes' bits as ones and twos: two counts in place of three.
            odd = np.uint8(changed ^ changed_too)
            carried = np.uint8(np.uint8(changed & changed_too) | np.uint8(odd & third))
            halves = _bits_in_halves(np.uint8(odd ^ third))
            twice = _bits_in_halves(carried)
            halves = np.uint8(halves + np.uint8(twice + twice))
            hamming = np.uint8(np.uint8(halves & np.uint8(0x0F)) + np.uint8(halves >> np.uint8(4)))
            steep = np.int16(slope - slopes[k])
            bright = np.int16(np.int16(gray) - np.int16(grays[k]))
            steep = steep if steep > 0 else np.int16(-steep)
            bright = bright if bright > 0 else np.int16(-bright)
            steep = steep if steep < most else most
            bright = bright if bright < most else most
            found[lane] = np.uint8(hamming + np.uint8(np.int16(steep + bright) >> np.int16(1)))
        for lane in range(LANES):
            cost[np.uint64(part) + np.uint64(lane)] = found[lane]


@kernel()
def row_costs(
    left: PixelDescriptors, right: PixelDescriptors, y: int, lowest: int, count: int, cost: UInt8
) -> None:
    """Compute costs (W, places) of row y, of which the first `count` are candidates. right: see
    `reverse_rows`.
    """
    width = cost.shape[0]
    code, slope, gray = left.codes[y], left.slope[y], left.gray[y]
    row = right.codes[y, 0], right.codes[y, 1], right.codes[y, 2], right.slope[y], right.gray[y]
    for x in range(width):
        base = width - 1 - x + lowest
        first, end = max(0, -base), min(count, width - base)
        here = cost[x]
        own = code[0, x], code[1, x], code[2, x], slope[x], gray[x]
        _write_costs(own, row, width - 1 - x, here)
        if end <= first:
            here[:count] = UNKNOWN_COST
        else:
            here[:first] = here[first]
            here[end:count] = here[end - 1]
        here[count:] = BESIDE_COST
