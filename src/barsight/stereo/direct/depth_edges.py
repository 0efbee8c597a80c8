"""Sharpen depth edges to those of the image with a weighted median beside every jump of the disparity."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from barsight.core.arrays import Bool, Float32, UInt8, kernel
from barsight.core.parallel import parallel_bands
from barsight.stereo.direct.kernels.vectors import FLOAT, FLOAT_LANES, Vectors, bytes_of

_RADIUS_PX = 5
_SIDE_PX = 2 * _RADIUS_PX + 1
"""Side of the median's window."""
_UNKNOWN, _FAR = 1e30, 1e4
"""Values in place of unknown disparities: for the median, and beyond any real one."""
_GRAY, _DISTANCE_PX = 10.0, 4.0
"""Difference in gray levels at which a weight falls to 1 / e, and sigma of the weights over distance."""
_BESIDE_PX = 3
"""Distance from a jump within which pixels are sharpened, along rows and columns."""
_EXACT_PX = 0.02
"""Length of the interval to which a median is narrowed down."""
_BAND_ROWS = 32


def sharpen_edges(disparity: Float32, gray: UInt8, jump_px: float) -> Float32:
    """Apply, beside jumps of more than jump_px, the weighted median of the known disparities around, to
    0.02 px; pixels that are near and have a similar gray value weigh more [Ma 2013]. NaN stays NaN; other
    pixels don't change.
    """
    sharpened = disparity.copy()
    offset = np.arange(-_RADIUS_PX, _RADIUS_PX + 1)
    near = np.zeros((_SIDE_PX, FLOAT_LANES), dtype=np.float32)
    near[:, :_SIDE_PX] = np.exp(-np.add.outer(offset**2, offset**2) / (2 * _DISTANCE_PX**2))
    wanted = _beside_jumps(disparity, jump_px)
    margins = _RADIUS_PX, _RADIUS_PX, _RADIUS_PX, FLOAT_LANES
    known = np.where(np.isfinite(disparity), disparity, np.float32(_UNKNOWN))
    around = cv2.copyMakeBorder(known, *margins, cv2.BORDER_CONSTANT, value=_UNKNOWN)
    shades = cv2.copyMakeBorder(gray, *margins, cv2.BORDER_CONSTANT, value=0)

    def work(first: int, end: int) -> None:
        _weighted_medians(around, shades, wanted, near.reshape(-1), sharpened, first, end)

    parallel_bands(work, len(disparity), _BAND_ROWS)
    return sharpened


def _beside_jumps(disparity: Float32, jump_px: float) -> Bool:
    side = 2 * _BESIDE_PX + 1
    near = cv2.dilate(mark_jumps(disparity, jump_px), np.ones((side, side), dtype=np.uint8))
    beside: Bool = np.isfinite(disparity) & near.view(np.bool_)
    return beside


def mark_jumps(disparity: Float32, jump_px: float) -> UInt8:
    """Mark (1, else 0) the pixels (H, W) around which known disparities within 1 px differ by more than
    jump_px. NaN is no jump.
    """
    jumps = np.empty(disparity.shape, dtype=np.uint8)

    def work(first: int, end: int) -> None:
        _mark_jumps(disparity, np.float32(jump_px), jumps, first, end)

    parallel_bands(work, len(disparity), _BAND_ROWS)
    return jumps


@kernel()
def _mark_jumps(disparity: Float32, jump: np.float32, jumps: UInt8, first: int, end: int) -> None:
    """Mark jumps (H, W) of rows first...end, see `mark_jumps`."""
    height, width = disparity.shape
    highest, lowest = np.empty((2, width + 2), dtype=np.float32)
    low, high = np.float32(-_FAR), np.float32(_FAR)
    highest[:], lowest[:] = low, high
    inner_highest, inner_lowest = highest[1:], lowest[1:]
    for y in range(first, end):
        one, two, three = disparity[max(y - 1, 0)], disparity[y], disparity[min(y + 1, height - 1)]
        marked = jumps[y]
        # A NaN fails each comparison.
        for x in range(width):
            most = one[x] if one[x] > low else low
            most = two[x] if two[x] > most else most
            inner_highest[x] = three[x] if three[x] > most else most
        for x in range(width):
            least = one[x] if one[x] < high else high
            least = two[x] if two[x] < least else least
            inner_lowest[x] = three[x] if three[x] < least else least
        for x in range(width):
            most = highest[x] if highest[x] > highest[x + 1] else highest[x + 1]
            most = highest[x + 2] if highest[x + 2] > most else most
            least = lowest[x] if lowest[x] < lowest[x + 1] else lowest[x + 1]
            least = lowest[x + 2] if lowest[x + 2] < least else least
            marked[x] = np.uint8(most - least > jump)


def _falling(v: Vectors, gap: Any) -> Any:
    """Approximate exp(-gap / _GRAY) to 1 % where it exceeds 1 %, by the sixteenth power of a cubic, since
    there is no vector instruction for the exponential.
    """
    small = v.product(gap, v.all(-1 / (16 * _GRAY), v.floats))
    power = v.all(1 / 6, v.floats)
    for factor in (1 / 2, 1.0, 1.0):
        power = v.sum(v.product(power, small), v.all(factor, v.floats))
    # Never so small that its power loses full precision (denormals), which is slow.
    power = v.bound_below(power, 0.05)
    for _ in range(4):
        power = v.product(power, power)
    return power


def _load_window(v: Vectors, at: Any, stride: Any) -> tuple[list[Any], list[Any], list[Any]]:
    """Load the window of `_median`: a vector of values and one of weights per line, then two vectors, the
    smallest and the largest of the values that count.
    """
    builder, index = v.builder, at.type
    nothing, far = v.all(0.0, v.floats), v.all(_UNKNOWN, v.floats)
    middle = builder.add(at, builder.mul(stride, index(_RADIUS_PX)))
    own = v.number(1, builder.add(middle, index(_RADIUS_PX)), bytes_of(FLOAT_LANES))
    values, weights, extremes = [], [], [v.all(x, v.floats) for x in (_UNKNOWN, -_UNKNOWN)]
    for line in range(_SIDE_PX):
        there = builder.add(at, builder.mul(stride, index(line)))
        value = v.load(v.data(0), there, v.floats)
        share = v.load(v.data(4), index(line * FLOAT_LANES), v.floats)
        gap = v.apart(v.load(v.data(1), there, bytes_of(FLOAT_LANES)), own)
        counts = builder.and_(
            builder.fcmp_ordered("<", value, far), builder.fcmp_ordered(">", share, nothing)
        )
        weight = v.product(_falling(v, builder.uitofp(gap, v.floats)), share)
        values.append(value)
        weights.append(builder.select(counts, weight, nothing))
        for which, (sign, none) in enumerate((("<", _UNKNOWN), (">", -_UNKNOWN))):
            other = builder.select(counts, value, v.all(none, v.floats))
            nearer = builder.fcmp_ordered(sign, other, extremes[which])
            extremes[which] = builder.select(nearer, other, extremes[which])
    return values, weights, extremes


@intrinsic  # type: ignore[untyped-decorator]
def _median(_: Any, theres: Any, grays: Any, at: Any, stride: Any, near: Any) -> Any:
    """Compute the weighted median of the window that begins at `at`. A value's weight is exp(-gap / _GRAY),
    where gap is the difference between its gray value and that of the window's centre, times `near`. All
    arrays are flat.

    The interval of values is quartered until it is short enough, which is faster than sorting a hundred of
    them. The vector instructions keep the window in registers where there are enough. Plain loops take 2.1 to
    2.8 times as long for identical results (benchmarks/results/2026-11-23-kernels.md).
    """
    signature = types.float32(theres, grays, at, stride, near)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        v = Vectors(context, builder, signature, arguments)
        nothing = v.all(0.0, v.floats)
        values, weights, (lowest, highest) = _load_window(v, arguments[2], arguments[3])
        half = builder.fmul(FLOAT(0.5), v.sum_of(_summed(v, weights)))
        first = builder.fsub(v.extreme_of(lowest, "min"), FLOAT(_EXACT_PX))
        low = cgutils.alloca_once_value(builder, first)
        high = cgutils.alloca_once_value(builder, v.extreme_of(highest, "max"))

        def has_half(level: Any) -> Any:
            """Return whether the values up to a level have at least half of the weight."""
            every = v.all(level, v.floats)
            below = [
                builder.select(builder.fcmp_ordered("<=", value, every), weight, nothing)
                for value, weight in zip(values, weights, strict=True)
            ]
            return builder.fcmp_ordered(">=", v.sum_of(_summed(v, below)), half)

        check, closer, done = (builder.append_basic_block(name) for name in ("check", "closer", "done"))
        builder.branch(check)
        builder.position_at_end(check)
        length = builder.fsub(builder.load(high), builder.load(low))
        builder.cbranch(builder.fcmp_ordered(">", length, FLOAT(_EXACT_PX)), closer, done)
        builder.position_at_end(closer)
        quarter, end = builder.fmul(FLOAT(0.25), length), builder.load(high)
        levels = [builder.fsub(end, builder.fmul(FLOAT(step), quarter)) for step in (1.0, 2.0, 3.0)]
        for enough, level in [(has_half(level), level) for level in levels]:
            end = builder.select(enough, level, end)
        builder.store(end, high)
        builder.store(builder.fsub(end, quarter), low)
        builder.branch(check)
        builder.position_at_end(done)
        return builder.load(high)

    return signature, generate


def _summed(v: Vectors, terms: list[Any]) -> Any:
    """Sum in pairs, so that no addition waits for all previous ones."""
    while len(terms) > 1:
        pairs = zip(terms[::2], terms[1::2], strict=False)
        terms = [v.sum(*pair) for pair in pairs] + terms[len(terms) // 2 * 2 :]
    return terms[0]


@kernel()
def _weighted_medians(
    disparity: Float32, gray: UInt8, wanted: Bool, near: Float32, medians: Float32, first: int,
    end: int,
) -> None:  # fmt: skip
    """Fill in the medians of the pixels `wanted`, in rows first...end.

    disparity, gray: (H, W) with a margin of _RADIUS_PX before and FLOAT_LANES after; unknown values are
    _UNKNOWN. near: (_SIDE_PX * FLOAT_LANES,) weights by distance, 0 outside the window. wanted, medians: (H,
    W).
    """
    framed_width = disparity.shape[1]
    theres, shades = disparity.reshape(-1), gray.reshape(-1)
    for y in range(first, end):
        for x in range(wanted.shape[1]):
            if wanted[y, x]:
                medians[y, x] = _median(theres, shades, y * framed_width + x, framed_width, near)
