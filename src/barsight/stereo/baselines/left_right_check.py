"""Check whole disparities for left-right consistency, and fill them where they disagree [Hosni 2013]."""

from __future__ import annotations

import numba
import numpy as np

from barsight.core.arrays import Bool, Float32, Int32, UInt8, kernel


def left_right_agreement(left_px: Int32, right_px: Int32, tolerance_px: int = 0) -> Bool:
    """Check (H, W) that the right image's disparity at x - d is within the tolerance of the left image's d.

    right_px: (H, W) whole disparities of the right image (its pixel x matches the left's x + d).
    """
    agrees = np.empty(left_px.shape, dtype=np.bool_)
    _compare(left_px, right_px, tolerance_px, agrees)
    return agrees


def fill_from_background(values: Int32, usable: Bool) -> Int32:
    """Fill with the lower (further) of the nearest usable values to the left and right in the row.

    A row without any usable value stays as it is.
    """
    filled = values.copy()
    _fill_rows(values, usable, filled)
    return filled


def weighted_median(
    values: Int32, guide: UInt8, where: Bool, radius_px: int, sigma_px: float, sigma_gray: float
) -> Int32:
    """Compute the weighted median of the window's values where `where` is True, each weighted by exp(-(r /
    sigma_px)^2 - (gray difference / sigma_gray)^2) [Hosni 2013]; other values stay as they are.
    """
    lowest = int(values.min())
    count = int(values.max()) - lowest + 1
    steps = np.arange(-radius_px, radius_px + 1)
    near = np.exp(-(steps[:, None] ** 2 + steps[None, :] ** 2) / sigma_px**2).astype(np.float32)
    alike = np.exp(-((np.arange(256) / sigma_gray) ** 2)).astype(np.float32)
    result = values.copy()
    _median(values, guide, where, near, alike, lowest, count, result)
    return result


@kernel(parallel=True)
def _compare(left: Int32, right: Int32, tolerance: int, agrees: Bool) -> None:
    """Check the left-right consistency of whole disparities.

    left, right: (H, W) px; tolerance: px. Fills agrees (H, W); False where the match lies outside.
    """
    height, width = left.shape
    for row in numba.prange(height):
        for column in range(width):
            there = column - left[row, column]
            inside = 0 <= there < width
            agrees[row, column] = inside and abs(right[row, there] - left[row, column]) <= tolerance


@kernel(parallel=True)
def _fill_rows(values: Int32, usable: Bool, filled: Int32) -> None:
    """Fill each row's unusable runs with the lower of the values beside them, which is the background's
    [Hosni 2013].

    values: (H, W) px; usable: (H, W). filled: initially a copy of values. A row without any usable value
    stays as it is.
    """
    height, width = values.shape
    for row in numba.prange(height):
        start = 0
        while start < width:
            if usable[row, start]:
                start += 1
                continue
            end = start
            while end < width and not usable[row, end]:
                end += 1
            if start > 0 and end < width:
                filled[row, start:end] = min(values[row, start - 1], values[row, end])
            elif start > 0:
                filled[row, start:end] = values[row, start - 1]
            elif end < width:
                filled[row, start:end] = values[row, end]
            start = end


@kernel(parallel=True)
def _median(
    values: Int32,
    guide: UInt8,
    where: Bool,
    near: Float32,
    alike: Float32,
    lowest: int,
    count: int,
    result: Int32,
) -> None:
    """Compute weighted medians from histograms at the pixels in `where` [Hosni 2013].

    values: (H, W) px, from `lowest` on, at most `count` different ones. guide: (H, W) gray levels. near: (2 r
    + 1, 2 r + 1) weights by distance; alike: (256,) by gray difference. result: (H, W), initially a copy of
    values. Windows are cut off at the border.
    """
    height, width = values.shape
    radius = near.shape[0] // 2
    for row in numba.prange(height):
        histogram = np.zeros(count, dtype=np.float32)
        for column in range(width):
            if not where[row, column]:
                continue
            histogram[:] = 0
            total = np.float32(0)
            for y in range(max(0, row - radius), min(height, row + radius + 1)):
                for x in range(max(0, column - radius), min(width, column + radius + 1)):
                    step = abs(np.int32(guide[y, x]) - np.int32(guide[row, column]))
                    weight = near[y - row + radius, x - column + radius] * alike[step]
                    histogram[values[y, x] - lowest] += weight
                    total += weight
            reached = np.float32(0)
            for index in range(count):
                reached += histogram[index]
                if 2 * reached >= total:
                    result[row, column] = lowest + index
                    break
