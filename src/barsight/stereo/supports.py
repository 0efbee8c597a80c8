"""Supports that follow a bar: tiles with an axis, means along it, and planes fitted along it.

The image is cut into tiles; each has one axis, the direction in which the image changes least. A support is a
fixed pattern of whole-pixel offsets turned to that axis, so the innermost loop runs along a row of the tile and
the compiler makes vector instructions of it. Arrays read at offsets carry a margin (`with_margin`).
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
_LEAST_COHERENCE = 0.2


def tile_axes(image: Float32, scale_px: float = 8.0) -> Float32:
    """(tile rows, tile columns, 2) unit vector (x, y) along which the image changes least around each tile.

    From the structure tensor [Foerstner 1987] averaged over scale_px. Where no direction stands out it is the
    column's, across the baseline: there a mean along the axis costs the match least.
    """
    smooth = cv2.GaussianBlur(image, (0, 0), 1.2)
    slope_x = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, scale=1 / 8)
    slope_y = cv2.Sobel(smooth, cv2.CV_32F, 0, 1, scale=1 / 8)
    height, width = image.shape
    rows = np.minimum(np.arange(-(-height // TILE_ROWS)) * TILE_ROWS + TILE_ROWS // 2, height - 1)
    columns = np.minimum(np.arange(-(-width // TILE_COLUMNS)) * TILE_COLUMNS + TILE_COLUMNS // 2, width - 1)
    xx, xy, yy = (
        cv2.GaussianBlur(product, (0, 0), scale_px)[np.ix_(rows, columns)]
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
    first: Float32, second: Float32, weight: Float32, axes: Float32, sigma_px: float
) -> tuple[Float32, Float32]:
    """Weighted Gaussian means of two images along each tile's axis, (H, W) each. Inputs: (H, W), no NaN."""
    reach = min(int(2.5 * sigma_px), MARGIN - 1)
    means = np.empty_like(first), np.empty_like(second)
    _axis_means(
        with_margin(first),
        with_margin(second),
        with_margin(weight),
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
    axes: Float32,
    reach: int,
    sigma_px: float,
    first_mean: Float32,
    second_mean: Float32,
) -> None:
    height, width = first_mean.shape
    for tile_y in prange(axes.shape[0]):
        sums = np.empty((3, TILE_COLUMNS), dtype=np.float32)
        for tile_x in range(axes.shape[1]):
            axis_x, axis_y = axes[tile_y, tile_x, 0], axes[tile_y, tile_x, 1]
            x0 = tile_x * TILE_COLUMNS
            count = min(TILE_COLUMNS, width - x0)
            for y in range(tile_y * TILE_ROWS, min(height, tile_y * TILE_ROWS + TILE_ROWS)):
                total, total_first, total_second = sums[0], sums[1], sums[2]
                total[:] = np.float32(1e-6)
                total_first[:] = 0
                total_second[:] = 0
                for step in range(-reach, reach + 1):
                    row = y + MARGIN + int(round(step * axis_y))
                    column = x0 + MARGIN + int(round(step * axis_x))
                    share = np.float32(math.exp(-0.5 * (step / sigma_px) ** 2))
                    weights = weight[row, column : column + count]
                    firsts = first[row, column : column + count]
                    seconds = second[row, column : column + count]
                    for i in range(count):
                        w = share * weights[i]
                        total[i] += w
                        total_first[i] += w * firsts[i]
                        total_second[i] += w * seconds[i]
                for i in range(count):
                    first_mean[y, x0 + i] = total_first[i] / total[i]
                    second_mean[y, x0 + i] = total_second[i] / total[i]


def fit_planes(
    disparity: Float32,
    weight: Float32,
    pull: Float32,
    axes: Float32,
    along_px: float,
    across_px: float,
    step_along: int,
    same_surface_px: float,
) -> tuple[Float32, Float32]:
    """A plane through the evidence of each pixel's support: its disparity there, and its information.

    Pixel i says: disparity[i] + pull[i] / weight[i], with weight[i] (0 = nothing). Its share falls with the
    distance (Gaussian, along_px and across_px) and with the difference of disparity (Tukey's biweight that
    ends at same_surface_px), so that a support doesn't cross a depth edge. Inputs: (H, W), no NaN.
    """
    reach_along = min(int(2.2 * along_px), MARGIN - 8) // step_along
    reach_across = int(2.2 * across_px + 0.5)
    fitted, information = np.empty_like(disparity), np.empty_like(disparity)
    _fit_planes(
        with_margin(disparity), with_margin(weight), with_margin(pull), axes,
        along_px, across_px, step_along, reach_along, reach_across, same_surface_px, fitted, information,
    )  # fmt: skip
    return fitted, information


@kernel(parallel=True, fastmath=True)
def _fit_planes(
    disparity: Float32,
    weight: Float32,
    pull: Float32,
    axes: Float32,
    along_px: float,
    across_px: float,
    step_along: int,
    reach_along: int,
    reach_across: int,
    same_surface_px: float,
    fitted: Float32,
    information: Float32,
) -> None:
    height, width = fitted.shape
    nearness = np.float32(1.0 / same_surface_px)
    one, zero = np.float32(1), np.float32(0)
    for tile_y in prange(axes.shape[0]):
        sums = np.empty((9, TILE_COLUMNS), dtype=np.float32)
        for tile_x in range(axes.shape[1]):
            axis_x, axis_y = axes[tile_y, tile_x, 0], axes[tile_y, tile_x, 1]
            x0 = tile_x * TILE_COLUMNS
            count = min(TILE_COLUMNS, width - x0)
            for y in range(tile_y * TILE_ROWS, min(height, tile_y * TILE_ROWS + TILE_ROWS)):
                sums[:, :] = 0
                s, su, sv, suu, suv, svv = sums[0], sums[1], sums[2], sums[3], sums[4], sums[5]
                r, ru, rv = sums[6], sums[7], sums[8]
                centre = disparity[y + MARGIN, x0 + MARGIN : x0 + MARGIN + count]
                for j in range(-reach_along, reach_along + 1):
                    along = j * step_along
                    for k in range(-reach_across, reach_across + 1):
                        dy = int(round(along * axis_y + k * axis_x))
                        dx = int(round(along * axis_x - k * axis_y))
                        share = np.float32(
                            math.exp(-0.5 * (along / along_px) ** 2 - 0.5 * (k / across_px) ** 2)
                        )
                        u, v = np.float32(dx), np.float32(dy)
                        uu, uv, vv = u * u, u * v, v * v
                        row, column = y + MARGIN + dy, x0 + MARGIN + dx
                        there = disparity[row, column : column + count]
                        weights = weight[row, column : column + count]
                        pulls = pull[row, column : column + count]
                        for i in range(count):
                            gap = (there[i] - centre[i]) * nearness
                            same = max(one - gap * gap, zero)
                            kept = share * same * same
                            w = kept * weights[i]
                            b = w * (there[i] - centre[i]) + kept * pulls[i]
                            s[i] += w
                            su[i] += w * u
                            sv[i] += w * v
                            suu[i] += w * uu
                            suv[i] += w * uv
                            svv[i] += w * vv
                            r[i] += b
                            ru[i] += b * u
                            rv[i] += b * v
                for i in range(count):
                    # A slope of zero is held with a small weight, so that a line of pixels still has one plane.
                    held = np.float32(0.02) * (suu[i] + svv[i]) + np.float32(1e-3)
                    a, b, c = suu[i] + held, suv[i], svv[i] + held
                    scale = one / (a * c - b * b)
                    from_u = (su[i] * c - sv[i] * b) * scale
                    from_v = (sv[i] * a - su[i] * b) * scale
                    left_over = max(s[i] - from_u * su[i] - from_v * sv[i], np.float32(1e-6))
                    fitted[y, x0 + i] = centre[i] + (r[i] - from_u * ru[i] - from_v * rv[i]) / left_over
                    information[y, x0 + i] = left_over
