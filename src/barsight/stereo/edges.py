"""Depth edges put where the image has them: a weighted median beside every jump of the disparity."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from barsight.core.arrays import Bool, Float32, UInt8, kernel
from barsight.core.parallel import in_bands
from barsight.stereo.vectors import FLOAT_LANES, Vectors

_RADIUS_PX = 5
_SIDE_PX = 2 * _RADIUS_PX + 1
_PLACES = _SIDE_PX * FLOAT_LANES
"""The window's rows, each filled up to whole vectors with places of no weight."""
_UNKNOWN = 1e30
_GREY = 10.0
_DISTANCE_PX = 4.0
_BESIDE_PX = 3
_LOWEST = -1e4
_EXACT_PX = 0.02
_BAND_ROWS = 32


def sharpen_edges(disparity: Float32, grey: UInt8, jump_px: float) -> Float32:
    """Beside jumps of more than jump_px the weighted median of the known disparities around: near and alike
    in grey counts more [Ma 2013], to 0.02 px. NaN stays NaN; elsewhere nothing changes."""
    sharpened = disparity.copy()
    offset = np.arange(-_RADIUS_PX, _RADIUS_PX + 1)
    near = np.zeros((_SIDE_PX, FLOAT_LANES), dtype=np.float32)
    near[:, :_SIDE_PX] = np.exp(-np.add.outer(offset**2, offset**2) / (2 * _DISTANCE_PX**2))
    alike = np.exp(-np.arange(256) / _GREY).astype(np.float32)
    wanted = _beside_jumps(disparity, jump_px)
    margins = _RADIUS_PX, _RADIUS_PX, _RADIUS_PX, FLOAT_LANES
    known = np.where(np.isfinite(disparity), disparity, np.float32(_UNKNOWN))
    around = cv2.copyMakeBorder(known, *margins, cv2.BORDER_CONSTANT, value=_UNKNOWN)
    shades = cv2.copyMakeBorder(grey, *margins, cv2.BORDER_CONSTANT, value=0)

    def work(first: int, end: int) -> None:
        _weighted_medians(around, shades, wanted, near.reshape(-1), alike, sharpened, first, end)

    in_bands(work, len(disparity), _BAND_ROWS)
    return sharpened


def _beside_jumps(disparity: Float32, jump_px: float) -> Bool:
    three = np.ones((3, 3), dtype=np.uint8)
    known = np.isfinite(disparity)
    highest = cv2.dilate(np.where(known, disparity, np.float32(_LOWEST)), three)
    lowest = cv2.erode(np.where(known, disparity, np.float32(-_LOWEST)), three)
    side = 2 * _BESIDE_PX + 1
    jumps = (highest - lowest > jump_px).astype(np.uint8)
    beside: Bool = known & (cv2.dilate(jumps, np.ones((side, side), dtype=np.uint8)) > 0)
    return beside


@intrinsic  # type: ignore[untyped-decorator]
def _take_window(
    _: Any, theres: Any, at: Any, stride: Any, near: Any, values: Any, weights: Any
) -> Any:  # fmt: skip
    """Values from `at` on, row by row; their weights, of which `weights` holds the part that grey says, times
    `near`. Returns the sum of the weights, the lowest and the highest value. All arrays are flat."""
    three = types.UniTuple(types.float32, 3)
    signature = three(theres, at, stride, near, values, weights)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        v = Vectors(context, builder, signature, arguments)
        index, far = arguments[1].type, v.all(_UNKNOWN, v.floats)
        total, lowest, highest = (
            cgutils.alloca_once_value(builder, v.all(first, v.floats)) for first in (0.0, _UNKNOWN, -_UNKNOWN)
        )
        with cgutils.for_range(builder, index(_SIDE_PX)) as loop:
            place = builder.mul(loop.index, index(FLOAT_LANES))
            value = v.load(
                v.data(0), builder.add(arguments[1], builder.mul(loop.index, arguments[2])), v.floats
            )
            share = v.load(v.data(3), place, v.floats)
            counts = builder.and_(
                builder.fcmp_ordered("<", value, far), builder.fcmp_ordered(">", share, v.all(0.0, v.floats))
            )
            weight = v.product(v.load(v.data(5), place, v.floats), share)
            weight = builder.select(counts, weight, v.all(0.0, v.floats))
            v.store(value, v.data(4), place)
            v.store(weight, v.data(5), place)
            v.add_to(total, weight)
            for extreme, sign, none in ((lowest, "<", _UNKNOWN), (highest, ">", -_UNKNOWN)):
                other, so_far = builder.select(counts, value, v.all(none, v.floats)), builder.load(extreme)
                builder.store(
                    builder.select(builder.fcmp_ordered(sign, other, so_far), other, so_far), extreme
                )
        found = [
            v.sum_of(builder.load(total)),
            v.extreme_of(builder.load(lowest), "min"),
            v.extreme_of(builder.load(highest), "max"),
        ]
        return context.make_tuple(builder, signature.return_type, found)

    return signature, generate


@intrinsic  # type: ignore[untyped-decorator]
def _weight_below(_: Any, values: Any, weights: Any, level: Any) -> Any:
    """The sum of the weights of the values up to a level."""
    signature = types.float32(values, weights, level)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        v = Vectors(context, builder, signature, arguments)
        level, nothing = v.all(arguments[2], v.floats), v.all(0.0, v.floats)
        totals = [nothing, nothing]
        for line in range(_SIDE_PX):
            place = ir.IntType(64)(line * FLOAT_LANES)
            value, weight = (v.load(v.data(part), place, v.floats) for part in (0, 1))
            below = builder.select(builder.fcmp_ordered("<=", value, level), weight, nothing)
            totals[line % 2] = v.sum(totals[line % 2], below)
        return v.sum_of(v.sum(*totals))

    return signature, generate


@kernel(fastmath=True)
def _weighted_medians(
    disparity: Float32, grey: UInt8, wanted: Bool, near: Float32, alike: Float32, medians: Float32,
    first: int, end: int,
) -> None:  # fmt: skip
    """The median is closed in by halving the interval of values: faster than to sort a hundred of them.

    disparity, grey: with a margin of _RADIUS_PX before and FLOAT_LANES after; unknown ones are _UNKNOWN.
    """
    width = wanted.shape[1]
    values, weights = np.zeros(_PLACES, dtype=np.float32), np.zeros(_PLACES, dtype=np.float32)
    exact, framed_width = np.float32(_EXACT_PX), disparity.shape[1]
    theres, shades = disparity.reshape(-1), grey.reshape(-1)
    for y in range(first, end):
        for x in range(width):
            if not wanted[y, x]:
                continue
            own = np.int32(grey[y + _RADIUS_PX, x + _RADIUS_PX])
            at = (y * framed_width) + x
            for line in range(_SIDE_PX):
                there, place = np.uint64(at + line * framed_width), np.uint64(line * FLOAT_LANES)
                for i in range(_SIDE_PX):
                    k = np.uint64(i)
                    weights[place + k] = alike[abs(np.int32(shades[there + k]) - own)]
            total, lowest, highest = _take_window(theres, at, framed_width, near, values, weights)
            half = np.float32(0.5) * total
            lowest -= exact
            while highest - lowest > exact:
                middle = np.float32(0.5) * (lowest + highest)
                is_above = _weight_below(values, weights, middle) >= half
                highest = middle if is_above else highest
                lowest = lowest if is_above else middle
            medians[y, x] = highest
