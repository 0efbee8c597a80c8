"""Supports that follow a bar: tiles with an axis, and means along it.

The image is cut into tiles; each has one axis, the direction in which the image changes least. A support is
a fixed pattern of whole-pixel offsets turned to that axis, so the innermost loop runs along a row of the tile
and the compiler makes vector instructions of it. Arrays read at offsets carry a margin (`with_margin`).
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numba import prange

from barsight.core.arrays import Float32, kernel

TILE_ROWS = 16
TILE_COLUMNS = 32
MARGIN = 48
_LEAST_COHERENCE = 0.35


def tile_axes(image: Float32, scale_px: float = 8.0) -> Float32:
    """(tile rows, tile columns, 2) unit vector (x, y) along which the image changes least around each tile.

    From the structure tensor [Foerstner 1987] averaged over scale_px. Where no direction stands out it is the
    column's, across the baseline: there a mean along the axis costs the match least.
    """
    # Half the size is fine enough for a direction, and a quarter of the work.
    smooth = cv2.resize(
        cv2.GaussianBlur(image, (0, 0), 1.2), None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA
    )
    slope_x = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, scale=1 / 8)
    slope_y = cv2.Sobel(smooth, cv2.CV_32F, 0, 1, scale=1 / 8)
    height, width = image.shape
    rows = np.minimum(np.arange(-(-height // TILE_ROWS)) * TILE_ROWS + TILE_ROWS // 2, height - 2)
    columns = np.minimum(np.arange(-(-width // TILE_COLUMNS)) * TILE_COLUMNS + TILE_COLUMNS // 2, width - 2)
    xx, xy, yy = (
        cv2.GaussianBlur(product, (0, 0), scale_px / 2)[np.ix_(rows // 2, columns // 2)]
        for product in (slope_x * slope_x, slope_x * slope_y, slope_y * slope_y)
    )
    across = 0.5 * np.arctan2(2 * xy, xx - yy)
    coherence = np.hypot(xx - yy, 2 * xy) / (xx + yy + np.float32(1e-3))
    axes = np.stack([-np.sin(across), np.cos(across)], axis=-1).astype(np.float32)
    axes[coherence < _LEAST_COHERENCE] = (0, 1)
    return axes


def with_margin(array: Float32) -> Float32:
    """The array with a margin of zeros that every support offset stays within."""
    framed: Float32 = cv2.copyMakeBorder(
        array, MARGIN, MARGIN + TILE_ROWS, MARGIN, MARGIN + TILE_COLUMNS, cv2.BORDER_CONSTANT, value=0
    )
    return framed


def axis_means(
    first: Float32, second: Float32, weight: Float32, alike: Float32, axes: Float32, sigma_px: float
) -> tuple[Float32, Float32]:
    """Weighted Gaussian means of two images along each tile's axis, (H, W) each. Inputs: (H, W), no NaN.

    alike: a pixel's share falls with the difference of this image (Tukey's biweight that ends at 1), so that
    a strap or a shadow across the bars has a mean of its own.
    """
    reach = min(int(2.5 * sigma_px), MARGIN - 1)
    means = np.empty_like(first), np.empty_like(second)
    _axis_means(
        with_margin(first),
        with_margin(second),
        with_margin(weight),
        with_margin(alike),
        axes,
        reach,
        sigma_px,
        means[0],
        means[1],
    )
    return means


@kernel(parallel=True, fastmath=True)
def _axis_means(
    first: Float32,
    second: Float32,
    weight: Float32,
    alike: Float32,
    axes: Float32,
    reach: int,
    sigma_px: float,
    first_mean: Float32,
    second_mean: Float32,
) -> None:
    height, width = first_mean.shape
    framed_width = first.shape[1]
    firsts, seconds, weights = first.reshape(-1), second.reshape(-1), weight.reshape(-1)
    theres, one, zero = alike.reshape(-1), np.float32(1), np.float32(0)
    shares = np.empty(2 * reach + 1, dtype=np.float32)
    for step in range(-reach, reach + 1):
        shares[step + reach] = math.exp(-0.5 * (step / sigma_px) ** 2)
    for tile_y in prange(axes.shape[0]):
        sums = np.empty((3, TILE_COLUMNS), dtype=np.float32)
        offsets = np.empty(2 * reach + 1, dtype=np.int64)
        for tile_x in range(axes.shape[1]):
            axis_x, axis_y = axes[tile_y, tile_x, 0], axes[tile_y, tile_x, 1]
            for step in range(-reach, reach + 1):
                offsets[step + reach] = round(step * axis_y) * framed_width + round(step * axis_x)
            x0 = tile_x * TILE_COLUMNS
            count = min(TILE_COLUMNS, width - x0)
            for y in range(tile_y * TILE_ROWS, min(height, tile_y * TILE_ROWS + TILE_ROWS)):
                total, total_first, total_second = sums[0], sums[1], sums[2]
                total[:] = np.float32(1e-6)
                total_first[:] = 0
                total_second[:] = 0
                middle = (y + MARGIN) * framed_width + x0 + MARGIN
                centre = alike[y + MARGIN, x0 + MARGIN : x0 + MARGIN + count]
                for step in range(2 * reach + 1):
                    at, share = np.uint64(middle + offsets[step]), shares[step]
                    for index in range(count):
                        u = np.uint64(index)
                        gap = theres[at + u] - centre[u]
                        same = max(one - gap * gap, zero)
                        w = share * same * same * weights[at + u]
                        total[u] += w
                        total_first[u] += w * firsts[at + u]
                        total_second[u] += w * seconds[at + u]
                for i in range(count):
                    first_mean[y, x0 + i] = total_first[i] / total[i]
                    second_mean[y, x0 + i] = total_second[i] / total[i]
