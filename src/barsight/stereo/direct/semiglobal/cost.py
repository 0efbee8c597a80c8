"""Compute the semi-global start's cost: 5x5 census [Zabih 1994], x gradient and grey value."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from barsight.core.arrays import UInt8, kernel
from barsight.core.parallel import parallel_bands
from barsight.stereo.direct.kernels.vectors import Vectors, bytes_of, shorts_of

Int16 = NDArray[np.int16]

_UNKNOWN_COST = 60
BESIDE_COST = 61
"""Of the places that fill up the last vector: dearer than any candidate, so that no path goes there."""
_MAX_APART = 20
_CODE_BYTES = 3
_BAND_ROWS = 64


@dataclass(frozen=True, eq=False)
class PixelDescriptors:
    """Descriptors of each pixel. codes: (H, 3, W) the census' 24 bits. slope: (H, W) difference of the
    neighbours in the row. grey: (H, W).
    """

    codes: UInt8
    slope: Int16
    grey: UInt8


def describe_pixels(image: UInt8) -> PixelDescriptors:
    """Compute descriptors; see `PixelDescriptors`."""
    height, width = image.shape
    codes = np.empty((height, _CODE_BYTES, width), dtype=np.uint8)
    framed = cv2.copyMakeBorder(image, 2, 2, 2, 2, cv2.BORDER_REPLICATE)
    parallel_bands(lambda first, end: _write_census(framed, codes, first, end), height, _BAND_ROWS)
    slope: Int16 = cv2.filter2D(image, cv2.CV_16S, np.array([[-1, 0, 1]], dtype=np.float32))
    return PixelDescriptors(codes, slope, image)


def reverse_rows(right: PixelDescriptors, lowest: int, places: int) -> PixelDescriptors:
    """Reverse the rows of the right image, so that a left pixel's candidates lie in memory's order: column W
    - 1 - x + k holds candidate k of left column x. Filled up so that each of the `places` can be read.
    """
    before, after = max(0, -lowest), max(0, lowest + places)

    def turned(array: NDArray[Any]) -> NDArray[Any]:
        margins = [(0, 0)] * (array.ndim - 1) + [(before, after)]
        return np.pad(array[..., ::-1], margins)[..., before + lowest :]

    return PixelDescriptors(
        *(np.ascontiguousarray(turned(a)) for a in (right.codes, right.slope, right.grey))
    )


@kernel()
def _write_census(framed: UInt8, codes: UInt8, first: int, end: int) -> None:
    """Set a bit where a neighbour is brighter than the centre. framed: (H + 4, W + 4)."""
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


@intrinsic  # type: ignore[untyped-decorator]
def _write_costs(
    _: Any, code: Any, slope: Any, grey: Any, codes: Any, slopes: Any, greys: Any, at: Any, cost: Any,
    start: Any, places: Any,
) -> Any:  # fmt: skip
    """Compute costs of one left pixel (code: tuple of bytes, slope, grey) with the right ones from column
    `at` on, written into the flat cost volume from `start` on.
    """
    signature = types.void(code, slope, grey, codes, slopes, greys, at, cost, start, places)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        v = Vectors(context, builder, signature, arguments)
        width = v.length(4)

        def write(offset: Any, lanes: int) -> None:
            kind, wide = bytes_of(lanes), shorts_of(lanes)
            there = builder.add(arguments[6], offset)
            hamming = v.all(0, kind)
            for part, byte in enumerate(v.members(0)):
                place = builder.add(there, builder.mul(width, width.type(part)))
                changed = builder.xor(v.all(byte, kind), v.load(v.data(3), place, kind))
                hamming = builder.add(hamming, v.ones(changed))
            steep = v.apart(v.all(arguments[1], wide), v.load(v.data(4), there, wide), signed=True)
            steep = builder.trunc(v.least(steep, v.all(_MAX_APART, wide)), kind)
            bright = v.apart(v.all(arguments[2], kind), v.load(v.data(5), there, kind))
            bright = v.least(bright, v.all(_MAX_APART, kind))
            apart = builder.lshr(builder.add(steep, bright), v.all(1, kind))
            v.store(builder.add(hamming, apart), v.data(7), builder.add(arguments[8], offset))

        v.by_chunks(arguments[9], write)
        return context.get_dummy_value()

    return signature, generate


@kernel()
def row_costs(
    code: UInt8, slope: Int16, grey: UInt8, codes: UInt8, slopes: Int16, greys: UInt8, lowest: int,
    count: int, cost: UInt8,
) -> None:  # fmt: skip
    """Compute costs (W, places) of one row, of which `count` are candidates.

    codes, slopes, greys: the right row, see `reverse_rows`.
    """
    width, places = cost.shape
    flat, flat_codes = cost.reshape(-1), codes.reshape(-1)
    for x in range(width):
        base = width - 1 - x + lowest
        first, end = max(0, -base), min(count, width - base)
        here = cost[x]
        here_code = (code[0, x], code[1, x], code[2, x])
        _write_costs(
            here_code, slope[x], grey[x], flat_codes, slopes, greys, width - 1 - x, flat, x * places, places
        )
        if end <= first:
            here[:count] = _UNKNOWN_COST
        else:
            here[:first] = here[first]
            here[end:count] = here[end - 1]
        here[count:] = BESIDE_COST
