"""Filter slices of costs with the guided filter [He 2010]: a local linear model of the cost in the image.

The filter for a gray guide is our own, four times as fast as OpenCV's; the one for a colour guide is
OpenCV's. Ours filters each slice in one sweep over its rows with ring buffers of 2 r + 1 rows, which stay in
the cache. Windows are cut off at the border and divided by the number of pixels that remain.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numba
import numpy as np

from barsight.core.arrays import Float32, Float64, kernel


@dataclass(frozen=True, eq=False)
class GuidedFilter:
    """Filters (K, H, W) float32 slices in place when called.

    guide: (H, W) float32. mean: its window means. inverse: 1 / (window variance + epsilon).
    """

    guide: Float32
    mean: Float32
    inverse: Float32
    radius_px: int

    def __call__(self, slices: Float32) -> Float32:
        """Filter `slices` in place and return them."""
        _filter(slices, self.guide, self.mean, self.inverse, self.radius_px)
        return slices


def guided_filter(guide: Float32, radius_px: int, epsilon: float) -> GuidedFilter:
    """Create the filter for one image. epsilon: in the guide's units squared; a smaller value preserves
    weaker edges.
    """
    mean = box_mean(guide, radius_px)
    variance = box_mean(guide * guide, radius_px) - mean * mean
    inverse = 1 / (variance.clip(0, None) + epsilon)
    return GuidedFilter(guide, mean.astype(np.float32), inverse.astype(np.float32), radius_px)


def colour_guided_filter(guide: Float32, radius_px: int, epsilon: float) -> Callable[[Float32], Float32]:
    """Create the filter for a colour guide, (H, W, 3) float32."""
    one = cv2.ximgproc.createGuidedFilter(guide, radius_px, epsilon)

    def filtered(slices: Float32) -> Float32:
        for index in range(slices.shape[0]):
            one.filter(slices[index], slices[index])
        return slices

    return filtered


def box_mean(image: Float32, radius_px: int) -> Float64:
    """Average (H, W) float64 over windows of side 2 r + 1, cut off at the border."""
    total = np.zeros((image.shape[0] + 1, image.shape[1] + 1))
    total[1:, 1:] = image.astype(np.float64).cumsum(0).cumsum(1)
    ends = [np.arange(length) for length in image.shape]
    low = [(end - radius_px).clip(0, None) for end in ends]
    high = [(end + radius_px + 1).clip(None, length) for end, length in zip(ends, image.shape, strict=True)]
    window = (
        total[np.ix_(high[0], high[1])]
        - total[np.ix_(low[0], high[1])]
        - total[np.ix_(high[0], low[1])]
        + total[np.ix_(low[0], low[1])]
    )
    mean: Float64 = window / np.outer(high[0] - low[0], high[1] - low[1])
    return mean


@kernel(parallel=True)
def _filter(slices: Float32, guide: Float32, mean: Float32, inverse: Float32, radius: int) -> None:
    """Filter slices (K, H, W) by the guided filter, in place [He 2010].

    guide, its window means, inverse = 1 / (window variance + epsilon): (H, W). radius: px.
    """
    for index in numba.prange(slices.shape[0]):
        _filter_slice(slices[index], guide, mean, inverse, radius)


@kernel()
def _filter_slice(cost: Float32, guide: Float32, mean: Float32, inverse: Float32, radius: int) -> None:
    """Filter one slice (H, W) row by row, in place; guide, mean, inverse: (H, W), see `GuidedFilter`.

    The window sums of cost and guide * cost determine the model of the row `radius` above; the window sums of
    the models determine the filtered row `radius` above that. Ring buffers keep each row's costs and models
    as long as a window contains them.
    """
    height, width = cost.shape
    ring = 2 * radius + 1
    rings = np.zeros((3, ring, width), dtype=np.float32)
    costs, slopes, offsets = rings[0], rings[1], rings[2]
    padded = np.zeros((4, width + 2 * radius), dtype=np.float32)
    sums = padded[:, radius : radius + width]
    windows = np.zeros((2, width), dtype=np.float32)
    scratch = np.zeros((2, width + 2 * radius), dtype=np.float32)
    share = np.empty(width, dtype=np.float32)
    for x in range(width):
        share[x] = np.float32(1) / np.float32(min(x + radius, width - 1) - max(x - radius, 0) + 1)
    for enters in range(height + 2 * radius):
        leaves, place = enters - ring, enters % ring
        if 0 <= leaves < height:
            _leave(sums[0], sums[1], costs[place], guide[leaves])
        if enters < height:
            _enter(sums[0], sums[1], cost[enters], costs[place], guide[enters])
        middle = enters - radius
        slot = middle % ring
        if middle >= ring:
            _subtract(sums[2], slopes[slot])
            _subtract(sums[3], offsets[slot])
        if 0 <= middle < height:
            rows = np.float32(min(middle + radius, height - 1) - max(middle - radius, 0) + 1)
            _window_sums(padded[0], windows[0], radius, scratch)
            _window_sums(padded[1], windows[1], radius, scratch)
            _models(windows, share, rows, mean[middle], inverse[middle], slopes[slot], offsets[slot])
            _add(sums[2], slopes[slot])
            _add(sums[3], offsets[slot])
        out = middle - radius
        if 0 <= out < height:
            rows = np.float32(min(out + radius, height - 1) - max(out - radius, 0) + 1)
            _window_sums(padded[2], windows[0], radius, scratch)
            _window_sums(padded[3], windows[1], radius, scratch)
            _apply(windows, share, rows, guide[out], cost[out])


@kernel()
def _enter(sum_cost: Float32, sum_product: Float32, cost: Float32, kept: Float32, guide: Float32) -> None:
    """Add a row of costs to the columns' sums. All (W,).

    sum_cost, sum_product: sums of cost and of cost * guide, in place. kept: filled with cost, for later use
    in `_leave`.
    """
    for x in range(cost.shape[0]):
        kept[x] = cost[x]
        sum_cost[x] += cost[x]
        sum_product[x] += cost[x] * guide[x]


@kernel()
def _leave(sum_cost: Float32, sum_product: Float32, cost: Float32, guide: Float32) -> None:
    """Subtract a row of costs that `_enter` has added from the columns' sums. All (W,); sums in place."""
    for x in range(cost.shape[0]):
        sum_cost[x] -= cost[x]
        sum_product[x] -= cost[x] * guide[x]


@kernel()
def _models(
    windows: Float32,
    share: Float32,
    rows: np.float32,
    mean: Float32,
    inverse: Float32,
    slope: Float32,
    offset: Float32,
) -> None:
    """Fit the linear model cost = slope * guide + offset of each window in a row [He 2010].

    windows: (2, W) window sums of cost and of guide * cost. share: (W,) one over the window's columns; rows:
    number of its rows. mean, inverse: (W,) of the guide, see `GuidedFilter`. Fills slope and offset (W,).
    """
    costs, products = windows[0], windows[1]
    per_row = np.float32(1) / rows
    for x in range(share.shape[0]):
        weight = share[x] * per_row
        mean_cost = costs[x] * weight
        steep = (products[x] * weight - mean[x] * mean_cost) * inverse[x]
        slope[x] = steep
        offset[x] = mean_cost - steep * mean[x]


@kernel()
def _apply(windows: Float32, share: Float32, rows: np.float32, guide: Float32, out: Float32) -> None:
    """Evaluate the mean linear model of a row: the filtered costs, out (W,) [He 2010].

    windows: (2, W) window sums of slope and offset. share: (W,) one over the window's columns; rows: number
    of its rows.
    """
    slopes, offsets = windows[0], windows[1]
    per_row = np.float32(1) / rows
    for x in range(share.shape[0]):
        out[x] = (slopes[x] * guide[x] + offsets[x]) * share[x] * per_row


@kernel()
def _add(total: Float32, row: Float32) -> None:
    """Add row (W,) to total (W,), in place."""
    for x in range(row.shape[0]):
        total[x] += row[x]


@kernel()
def _subtract(total: Float32, row: Float32) -> None:
    """Subtract row (W,) from total (W,), in place."""
    for x in range(row.shape[0]):
        total[x] -= row[x]


@kernel()
def _copy(values: Float32, out: Float32) -> None:
    """Copy the first W values to out (W,)."""
    for x in range(out.shape[0]):
        out[x] = values[x]


@kernel()
def _pairs(values: Float32, size: int, sums: Float32) -> None:
    """Sum pairs `size` elements apart: sums[x] = values[x] + values[x + size], N - size of them.

    values: (N,). sums: at least N - size long.
    """
    shifted = values[size:]
    for x in range(shifted.shape[0]):
        sums[x] = values[x] + shifted[x]


@kernel()
def _window_sums(padded: Float32, sums: Float32, radius: int, scratch: Float32) -> None:
    """Sum over 2 r + 1 neighbours of `padded`, which has r zeros at both ends, from sums over 1, 2, 4...
    neighbours: there are few additions, and none waits for the previous one as in a running sum.

    padded: (W + 2 R,). Fills sums (W,). scratch: (2, W + 2 R).
    """
    width = sums.shape[0]
    window = 2 * radius + 1
    _copy(padded, sums)
    if window == 1:
        return
    _pairs(padded, 1, scratch[0])
    done, size, turn, length = 1, 2, 0, padded.shape[0] - 1
    while size <= window:
        if window & size:
            _add(sums, scratch[turn, done : done + width])
            done += size
        if 2 * size <= window:
            _pairs(scratch[turn, :length], size, scratch[1 - turn])
            length -= size
            turn = 1 - turn
        size *= 2
