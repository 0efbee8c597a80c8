"""Planes fitted to the pixels' answers on supports that follow a bar and don't cross a depth edge."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import prange

from barsight.core.arrays import Float32, kernel
from barsight.stereo.supports import MARGIN, TILE_COLUMNS, TILE_ROWS, with_margin

_REACH = 2.0


@dataclass(frozen=True)
class SupportShape:
    """A Gaussian support: one sigma along and across the axis; it goes along the axis in odd steps (px)."""

    along_px: float
    across_px: float
    step: int = 1


def fit_planes(
    disparity: Float32,
    weight: Float32,
    pull: Float32,
    axes: Float32,
    shape: SupportShape,
    same_surface_px: float,
) -> tuple[Float32, Float32]:
    """A plane through the evidence of each pixel's support: its disparity there, and its information.

    Pixel i says: disparity[i] + pull[i] / weight[i], with weight[i] (0 = nothing). Its share falls with the
    distance (Gaussian) and with the difference of disparity (Tukey's biweight that ends at same_surface_px),
    so that a support doesn't cross a depth edge. Inputs: (H, W), no NaN.
    """
    step = shape.step
    framed = with_margin(disparity)
    if step > 1:
        weight, pull = (
            array
            for array in _summed_along(
                framed,
                with_margin(weight),
                with_margin(pull),
                axes,
                step // 2,
                same_surface_px,
                disparity.shape,
            )
        )
    fitted, information = np.empty_like(disparity), np.empty_like(disparity)
    _fit_planes(
        framed, with_margin(weight), with_margin(pull), axes, shape.along_px, shape.across_px, step,
        min(int(_REACH * shape.along_px), MARGIN - 8) // step, int(_REACH * shape.across_px + 0.5),
        same_surface_px, fitted, information,
    )  # fmt: skip
    return fitted, information


def _summed_along(
    disparity: Float32,
    weight: Float32,
    pull: Float32,
    axes: Float32,
    reach: int,
    same_surface_px: float,
    shape: tuple[int, ...],
) -> tuple[Float32, Float32]:
    """Weight and pull summed over 2 * reach + 1 pixels along the axis, the pulls now from the middle one's
    disparity: so a support can go in steps and still hear every pixel. Arrays with margins in, without out.
    """
    sums = np.empty(shape, dtype=np.float32), np.empty(shape, dtype=np.float32)
    _sum_along(disparity, weight, pull, axes, reach, same_surface_px, sums[0], sums[1])
    return sums


@kernel(parallel=True, fastmath=True)
def _sum_along(
    disparity: Float32,
    weight: Float32,
    pull: Float32,
    axes: Float32,
    reach: int,
    same_surface_px: float,
    weight_sum: Float32,
    pull_sum: Float32,
) -> None:
    height, width = weight_sum.shape
    nearness, one, zero = np.float32(1.0 / same_surface_px), np.float32(1), np.float32(0)
    framed_width = disparity.shape[1]
    theres, weights, pulls = disparity.reshape(-1), weight.reshape(-1), pull.reshape(-1)
    for tile_y in prange(axes.shape[0]):
        for tile_x in range(axes.shape[1]):
            axis_x, axis_y = axes[tile_y, tile_x, 0], axes[tile_y, tile_x, 1]
            x0 = tile_x * TILE_COLUMNS
            count = min(TILE_COLUMNS, width - x0)
            for y in range(tile_y * TILE_ROWS, min(height, tile_y * TILE_ROWS + TILE_ROWS)):
                centre = disparity[y + MARGIN, x0 + MARGIN : x0 + MARGIN + count]
                total, total_pull = weight_sum[y, x0 : x0 + count], pull_sum[y, x0 : x0 + count]
                total[:] = 0
                total_pull[:] = 0
                for step in range(-reach, reach + 1):
                    row = y + MARGIN + round(step * axis_y)
                    column = x0 + MARGIN + round(step * axis_x)
                    at = np.uint64(row * framed_width + column)
                    for index in range(count):
                        i = np.uint64(index)
                        gap = theres[at + i] - centre[i]
                        scaled = gap * nearness
                        same = max(one - scaled * scaled, zero)
                        kept = same * same
                        w = kept * weights[at + i]
                        total[i] += w
                        total_pull[i] += w * gap + kept * pulls[at + i]


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
    nearness, one, zero = np.float32(1.0 / same_surface_px), np.float32(1), np.float32(0)
    framed_width = disparity.shape[1]
    theres, weights, pulls = disparity.reshape(-1), weight.reshape(-1), pull.reshape(-1)
    shares = np.empty(2 * reach_along + 1, dtype=np.float32)
    for j in range(-reach_along, reach_along + 1):
        shares[j + reach_along] = math.exp(-0.5 * (j * step_along / along_px) ** 2)
    for tile_y in prange(axes.shape[0]):
        sums, line = (
            np.empty((9, TILE_COLUMNS), dtype=np.float32),
            np.empty((5, TILE_COLUMNS), dtype=np.float32),
        )
        s, sa, sc, saa, sac, scc, r, ra, rc = (
            sums[0], sums[1], sums[2], sums[3], sums[4], sums[5], sums[6], sums[7], sums[8],
        )  # fmt: skip
        n, na, naa, m, ma = line[0], line[1], line[2], line[3], line[4]
        offsets = np.empty((2 * reach_across + 1, 2 * reach_along + 1), dtype=np.int64)
        for tile_x in range(axes.shape[1]):
            axis_x, axis_y = axes[tile_y, tile_x, 0], axes[tile_y, tile_x, 1]
            for k in range(-reach_across, reach_across + 1):
                for j in range(-reach_along, reach_along + 1):
                    along = j * step_along
                    row, column = round(along * axis_y + k * axis_x), round(along * axis_x - k * axis_y)
                    offsets[k + reach_across, j + reach_along] = row * framed_width + column
            x0 = tile_x * TILE_COLUMNS
            count = min(TILE_COLUMNS, width - x0)
            for y in range(tile_y * TILE_ROWS, min(height, tile_y * TILE_ROWS + TILE_ROWS)):
                sums[:, :] = 0
                centre = disparity[y + MARGIN, x0 + MARGIN : x0 + MARGIN + count]
                middle = (y + MARGIN) * framed_width + x0 + MARGIN
                for k in range(-reach_across, reach_across + 1):
                    line[:, :] = 0
                    for j in range(-reach_along, reach_along + 1):
                        share, a = shares[j + reach_along], np.float32(j * step_along)
                        at = np.uint64(middle + offsets[k + reach_across, j + reach_along])
                        for index in range(count):
                            u = np.uint64(index)
                            gap = theres[at + u] - centre[u]
                            scaled = gap * nearness
                            same = max(one - scaled * scaled, zero)
                            kept = share * same * same
                            w = kept * weights[at + u]
                            b = w * gap + kept * pulls[at + u]
                            wa = w * a
                            n[u] += w
                            na[u] += wa
                            naa[u] += wa * a
                            m[u] += b
                            ma[u] += b * a
                    share, c = np.float32(math.exp(-0.5 * (k / across_px) ** 2)), np.float32(k)
                    for i in range(count):
                        s[i] += share * n[i]
                        sa[i] += share * na[i]
                        sc[i] += share * c * n[i]
                        saa[i] += share * naa[i]
                        sac[i] += share * c * na[i]
                        scc[i] += share * c * c * n[i]
                        r[i] += share * m[i]
                        ra[i] += share * ma[i]
                        rc[i] += share * c * m[i]
                for i in range(count):
                    # A slope of zero is held with a small weight, so that a line of pixels still has a plane.
                    held = np.float32(0.02) * (saa[i] + scc[i]) + np.float32(1e-3)
                    aa, ac, cc = saa[i] + held, sac[i], scc[i] + held
                    scale = one / (aa * cc - ac * ac)
                    from_a = (sa[i] * cc - sc[i] * ac) * scale
                    from_c = (sc[i] * aa - sa[i] * ac) * scale
                    left_over = max(s[i] - from_a * sa[i] - from_c * sc[i], np.float32(1e-6))
                    fitted[y, x0 + i] = centre[i] + (r[i] - from_a * ra[i] - from_c * rc[i]) / left_over
                    information[y, x0 + i] = left_over
