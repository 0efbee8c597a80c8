"""Filter the cost space min(T, (d - D)^2) bilaterally, without building it [paper Eq. 5, Figure 2].

A pixel's filtered cost at d is the weighted mean over its window. A neighbour q whose D_q is further than
sqrt(T) from d adds the constant T, so C(d) = T - sum w_q max(0, T - (d - D_q)^2) / sum w_q: only the
candidates within sqrt(T) of a neighbour need computing. Where all D in the window are so close together that
the truncation affects neither the winner nor its two neighbours, C is a single parabola there, and its
minimum, which Eq. 4 then finds exactly, is the weighted mean of D. This is the case in most of an image.
"""

from __future__ import annotations

import math

import cv2
import numba
import numpy as np

from barsight.core.arrays import Float32, Float64, UInt8, kernel
from barsight.core.records.disparity import DisparityRange

_FAR = np.float32(1e9)


def bilateral_update(
    disparity_px: Float32,
    guide: UInt8,
    candidates: DisparityRange,
    limit: float,
    radius_px: int,
    sigma_px: float,
    sigma_gray: float,
) -> Float32:
    """Run one round on (H, W) disparity_px: build and filter the cost space, take the winner, fit the
    parabola. Returns (H, W) float32.

    limit: T in px squared. Weights are exp(-(r / sigma_px)^2 / 2 - (gray difference / sigma_gray)^2 / 2). A
    neighbour without disparity (NaN) adds the same to all candidates; NaN where no neighbour has one.
    """
    known = np.isfinite(disparity_px)
    margins = (radius_px,) * 4
    values = cv2.copyMakeBorder(np.where(known, disparity_px, 0), *margins, cv2.BORDER_CONSTANT, value=0.0)
    present = cv2.copyMakeBorder(known.astype(np.float32), *margins, cv2.BORDER_CONSTANT, value=0.0)
    grays = cv2.copyMakeBorder(guide, *margins, cv2.BORDER_REPLICATE)
    window = np.ones((2 * radius_px + 1,) * 2, dtype=np.uint8)
    lowest = cv2.erode(np.where(known, disparity_px, _FAR), window, borderValue=float(_FAR))
    highest = cv2.dilate(np.where(known, disparity_px, -_FAR), window, borderValue=-float(_FAR))
    steps = np.arange(-radius_px, radius_px + 1)
    near = np.exp(-0.5 * (steps[:, None] ** 2 + steps[None, :] ** 2) / sigma_px**2).astype(np.float32)
    alike = np.exp(-0.5 * (np.arange(256) / sigma_gray) ** 2).astype(np.float32)
    updated = np.empty_like(disparity_px)
    _weighted_means(values, present, grays, near, alike, updated)
    _compete_at_edges(
        (values, present, grays),
        near,
        alike,
        lowest,
        highest,
        limit,
        candidates.lowest_px,
        candidates.count,
        updated,
    )
    return updated


@kernel(parallel=True)
def _weighted_means(
    values: Float32, present: Float32, grays: UInt8, near: Float32, alike: Float32, means: Float32
) -> None:
    """Compute the weighted mean of the window's known values; NaN (0 / 0) where there is none.

    values (px, 0 where unknown), present (1, or 0 where unknown), grays: (H + 2 R, W + 2 R). near: (2 R + 1,
    2 R + 1) weights by distance; alike: (256,) by gray difference. Fills means (H, W) px.
    """
    height, width = means.shape
    side = near.shape[0]
    radius = side // 2
    for row in numba.prange(height):
        weights = np.zeros(width, dtype=np.float32)
        totals = np.zeros(width, dtype=np.float32)
        middle = grays[row + radius, radius : radius + width]
        for y in range(side):
            for x in range(side):
                _add_neighbours(
                    near[y, x],
                    alike,
                    middle,
                    grays[row + y, x : x + width],
                    present[row + y, x : x + width],
                    values[row + y, x : x + width],
                    weights,
                    totals,
                )
        for column in range(width):
            known = weights[column] > 0
            means[row, column] = totals[column] / weights[column] if known else np.nan


@kernel()
def _add_neighbours(
    near: np.float32,
    alike: Float32,
    middle: UInt8,
    grays: UInt8,
    present: Float32,
    values: Float32,
    weights: Float32,
    totals: Float32,
) -> None:
    """Accumulate a row's bilateral sums over the neighbours at one offset, in place.

    near: the offset's weight. alike: (256,) weights by gray difference. middle, grays: (W,) gray values of
    the pixels and of their neighbours. present: (W,) 1, or 0 where the neighbour has no disparity; values:
    (W,) px, 0 there. weights, totals: (W,) sums of the weights and of weight times value (px).
    """
    for x in range(weights.shape[0]):
        step = np.uint8(max(middle[x], grays[x]) - min(middle[x], grays[x]))
        weight = near * alike[step]
        weights[x] += weight * present[x]
        totals[x] += weight * values[x]


@kernel(parallel=True)
def _compete_at_edges(
    images: tuple[Float32, Float32, UInt8],
    near: Float32,
    alike: Float32,
    lowest: Float32,
    highest: Float32,
    limit: float,
    first: int,
    count: int,
    updated: Float32,
) -> None:
    """Search the candidates within reach of the truncation where the window's values are spread more widely.

    A neighbour's credit w (T - (d - D)^2) is a polynomial in d between its two ends: its three coefficients
    are added where it begins and subtracted where it ends, and running sums over d yield all credits.

    images: disparity (px, 0 where unknown), 1 where it is known, grays; all with the window's margin. lowest,
    highest: (H, W) px of the window. first, count: the candidates. Updates (H, W) px in place.
    """
    values, present, grays = images
    height, width = updated.shape
    side = near.shape[0]
    radius = side // 2
    reach = math.sqrt(limit)
    for row in numba.prange(height):
        credit = np.zeros(count, dtype=np.float64)
        starts = np.zeros((count + 1, 3), dtype=np.float64)
        for column in range(width):
            low, high, mean = lowest[row, column], highest[row, column], updated[row, column]
            inside = first < np.rint(mean) < first + count - 1
            if low > high or (inside and _is_one_parabola(low, high, mean, reach)):
                continue
            begin = max(0, math.ceil(lowest[row, column] - reach) - first)
            end = min(count, math.floor(highest[row, column] + reach) + 1 - first)
            if begin >= end:
                updated[row, column] = np.nan
                continue
            here = np.int32(grays[row + radius, column + radius])
            for y in range(row, row + side):
                for x in range(column, column + side):
                    step = abs(np.int32(grays[y, x]) - here)
                    weight = np.float64(near[y - row, x - column] * alike[step] * present[y, x])
                    place = np.float64(values[y, x]) - first - begin
                    start = min(max(0, math.ceil(place - reach)), end - begin)
                    stop = max(start, min(end - begin, math.floor(place + reach) + 1))
                    level, slope = weight * (limit - place * place), 2 * weight * place
                    starts[start, 0] += level
                    starts[start, 1] += slope
                    starts[start, 2] += weight
                    starts[stop, 0] -= level
                    starts[stop, 1] -= slope
                    starts[stop, 2] -= weight
            _run_up(starts, credit, begin, end)
            updated[row, column] = np.float32(first) + _best_place(credit, begin, end)


@kernel()
def _is_one_parabola(lowest: float, highest: float, mean: float, reach: float) -> bool:
    """Check that the winner is the whole candidate nearest to the mean, and that the truncation affects
    neither it nor its neighbours. With all values within `reach` of one another, the credits are those of
    the parabola at every candidate between them, and fall outside.
    """
    winner = np.rint(mean)
    near_enough = winner + 1 - lowest <= reach and highest - winner + 1 <= reach
    return bool(highest - lowest <= reach and near_enough)


@kernel()
def _run_up(starts: Float64, credit: Float64, begin: int, end: int) -> None:
    """Integrate the credits of begin...end from the changes of the coefficients.

    starts: (K + 1, 3) changes of level, slope and bend, reset to zero. Fills credit (K,).
    """
    level, slope, bend = 0.0, 0.0, 0.0
    for index in range(end - begin):
        level += starts[index, 0]
        slope += starts[index, 1]
        bend += starts[index, 2]
        credit[begin + index] = level + slope * index - bend * index * index
        starts[index] = 0
    starts[end - begin] = 0


@kernel()
def _best_place(credit: Float64, begin: int, end: int) -> np.float32:
    """Find the index of the highest credit, refined by the parabola through it and its neighbours [paper Eq.
    4].

    credit: (K,), of which only begin...end is used.
    """
    best = begin
    for index in range(begin, end):
        if credit[index] > credit[best]:
            best = index
    place = np.float64(best)
    if begin < best < end - 1:
        below, above = credit[best - 1], credit[best + 1]
        bend = below + above - 2 * credit[best]
        if bend < 0:
            place += (below - above) / (2 * bend)
    return np.float32(place)
