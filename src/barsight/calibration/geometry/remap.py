"""Warp pictures to rectified pixels in two separable passes.

A rectified row crosses the columns of the raw picture one by one along a gentle curve. The raw picture is
therefore first sampled where the curve crosses each column and then along the curve. This takes 8 products
per pixel instead of the 16 of OpenCV's remap, is three times as fast and doesn't round positions to 1/32 px.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from barsight.core.arrays import Bool, Float32, UInt8, kernel

_SHARP = np.float32(-0.75)
"""Free parameter of the cubic convolution kernel, as in OpenCV [Keys 1981]."""
_ZERO, _HALF, _ONE, _MAX_VALUE = (np.float32(v) for v in (0, 0.5, 1, 255))


@dataclass(frozen=True, eq=False)
class Warp:
    """Rectification map. map_x, map_y: (H, W) float32 raw pixels. valid: (H, W), true within the raw picture.

    crossing: (H, w) float32 raw y at which each rectified row crosses each of the raw picture's w columns.
    """

    map_x: Float32
    map_y: Float32
    valid: Bool
    crossing: Float32

    @classmethod
    def of(cls, map_x: Float32, map_y: Float32, raw_size: tuple[int, int]) -> Warp:
        """Build a warp from its maps; raw_size: (h, w)."""
        height, width = raw_size
        valid = (map_x >= 0) & (map_x <= width - 1) & (map_y >= 0) & (map_y <= height - 1)
        columns = np.arange(width)
        # Outside the picture a lens model may fold back.
        rows = [np.interp(columns, np.fmax.accumulate(x), y) for x, y in zip(map_x, map_y, strict=True)]
        return cls(map_x, map_y, valid, np.array(rows, np.float32))

    def __call__(self, image: UInt8) -> UInt8:
        """Warp a raw (h, w) picture to (H, W); border pixels are replicated."""
        warped = np.empty(self.map_x.shape, np.uint8)
        _warp(np.ascontiguousarray(image), self.crossing, self.map_x, warped)
        return warped


@kernel()
def _warp(image: UInt8, crossing: Float32, map_x: Float32, warped: UInt8) -> None:
    """Resample a picture by cubic convolution, first along the columns and then along the rows [Keys 1981].

    image: (h, w). crossing: (H, w) raw y and map_x: (H, W) raw x, in px, see `Warp`. Fills warped (H, W),
    rounded and clipped to 0...255; border pixels are replicated.
    """
    height, width = image.shape
    row = np.empty(width + 4, np.float32)  # padded by two on each side
    column, furthest = np.empty(warped.shape[1], np.float32), np.float32(width)
    for i in range(warped.shape[0]):
        curve, begin = crossing[i], 0
        while begin < width:
            floor = int(np.floor(curve[begin]))
            end = begin + 1
            while end < width and int(np.floor(curve[end])) == floor:
                end += 1
            above = image[min(max(floor - 1, 0), height - 1), begin:end]
            upper = image[min(max(floor, 0), height - 1), begin:end]
            lower = image[min(max(floor + 1, 0), height - 1), begin:end]
            below = image[min(max(floor + 2, 0), height - 1), begin:end]
            places, read = curve[begin:end], row[begin + 2 : end + 2]
            whole = np.float32(floor)
            for k in range(end - begin):
                a, b, c, d = _weights(places[k] - whole)
                read[k] = (
                    a * np.float32(above[k]) + b * np.float32(upper[k])
                    + c * np.float32(lower[k]) + d * np.float32(below[k])
                )  # fmt: skip
            begin = end
        row[0] = row[1] = row[2]
        row[width + 2] = row[width + 3] = row[width + 1]
        for j in range(column.size):
            place = map_x[i, j] if map_x[i, j] > -_ONE else -_ONE
            column[j] = (place if place < furthest else furthest) + _ONE
        begin = 0
        while begin < column.size:
            first = min(int(column[begin]), width)
            end = begin + 1
            while end < column.size and min(int(column[end]), width) == first + end - begin:
                end += 1
            places, line, count = column[begin:end], warped[i, begin:end], end - begin
            before, left = row[first : first + count], row[first + 1 : first + 1 + count]
            right, after = row[first + 2 : first + 2 + count], row[first + 3 : first + 3 + count]
            for k in range(count):
                a, b, c, d = _weights(places[k] - np.float32(first + k))
                value = a * before[k] + b * left[k] + c * right[k] + d * after[k] + _HALF
                value = value if value > _ZERO else _ZERO
                line[k] = np.uint8(np.int32(value if value < _MAX_VALUE else _MAX_VALUE))
            begin = end


@kernel()
def _weights(t: np.float32) -> tuple[np.float32, np.float32, np.float32, np.float32]:
    """Compute the cubic weights of the four pixels around a position at fraction t after the second."""
    rest = _ONE - t
    outer = _SHARP * t * rest
    second = ((_SHARP + _ONE + _ONE) * t - (_SHARP + _ONE + _ONE + _ONE)) * t * t + _ONE
    return outer * rest, second, _ONE - second - outer * (rest + t), outer * t
