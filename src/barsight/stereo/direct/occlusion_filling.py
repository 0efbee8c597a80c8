"""Fill occlusions by extrapolating the surrounding surfaces, marked as guesses.

From a hole, rays go out in 16 directions to the first matched pixel, whose surrounding plane is extrapolated
into the hole. The guess is a weighted quantile of these candidates: those that are near and have a similar
gray value weigh more. What one image hides lies behind what hides it, so a low quantile is used; beyond the
other image's border nothing hides it, and the median is used.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from barsight.core.arrays import Float32, Float64, Int32, UInt8, kernel
from barsight.core.parallel import parallel_bands

_RAYS, _REACH_PX = 16, 200
"""Number of rays from a hole's pixel, and their length along the row or the column."""
_PLANE_RADIUS_PX, _EVERY_PX = 15, 3
"""Half side of the window to which a plane is fitted, and the step between its pixels."""
_SLOPE_HOLD = 20.0 / _EVERY_PX**2
"""Weight of the assumption that a plane has no slope, px^2."""
_SAME_SURFACE_PX = 1.0
"""Maximum distance from a plane of the pixels to which it is fitted."""
_SLOPE_LENGTH_PX = 50.0
"""Distance over which an extrapolated plane's slope fades out."""
_GRAY = 12.0
"""Difference in gray levels at which a candidate's weight falls to 1 / e."""
_HIDDEN_QUANTILE = 0.3
"""Quantile of the candidates that is taken where one picture may hide what the other sees."""
_SEEN_RATIO = 0.03
"""Factor on the weight of a candidate that lies in front of what the right picture sees there."""
_SPREAD_RATIO = 2.0
"""Ratio of a guess's sigma to the candidates' spread."""
_BAND_ROWS = 32
_SAMPLED_EVERY_PX, _MIDDLE_PERCENT = 8, (45, 55)
"""Step between sampled pixels, and the percentiles of the sample between which all values are sorted."""


def fill_occlusions_by_planes(
    disparity: Float32, gray: UInt8, right_px: Float32, lowest_px: float, highest_px: float
) -> tuple[Float32, Float32]:
    """Fill the NaN of `disparity` (H, W) where any ray finds a match, and return the guesses' sigma (px; NaN
    where nothing was guessed): twice the spread of the candidates, since the truth may be none of them, and
    at least 1 px. The inputs don't change.

    right_px: (H, W) the right image's disparity; a guess that would be visible there in front of the surface
    that is there gets a lower weight. Guesses stay within lowest_px...highest_px.
    """
    slope_x, slope_y = np.zeros_like(disparity), np.zeros_like(disparity)

    def find_slopes(first: int, end: int) -> None:
        _slopes_beside_holes(disparity, _PLANE_RADIUS_PX, _SAME_SURFACE_PX, slope_x, slope_y, first, end)

    parallel_bands(find_slopes, len(disparity), _BAND_ROWS)
    filled = disparity.copy()
    smooth = cv2.GaussianBlur(gray.astype(np.float32), (0, 0), 1.0)
    angle = 2 * np.pi * np.arange(_RAYS) / _RAYS
    rays = np.column_stack([np.cos(angle), np.sin(angle)])
    rays /= np.abs(rays).max(axis=1, keepdims=True)
    sigma = np.full_like(disparity, np.nan)
    holes = np.isnan(disparity).astype(np.uint8)
    if holes.all():
        return filled, sigma
    # A ray may skip the distance to the nearest match in any direction.
    leaps = cv2.distanceTransform(holes, cv2.DIST_C, 3).astype(np.int32)

    slopes, limits, found = (slope_x, slope_y), (lowest_px, highest_px), (filled, sigma)

    def guess(first: int, end: int) -> None:
        _fill(disparity, smooth, leaps, slopes, right_px, rays, limits, found, first, end)

    parallel_bands(guess, len(disparity), _BAND_ROWS)
    return filled, sigma


def fill_row_holes(disparity: Float32) -> Float32:
    """Fill NaN with the smaller (farther) of the neighbours in the row, since what is hidden lies behind.

    Rows without any disparity get the median of all; a map without any becomes zero.
    """
    filled = np.empty_like(disparity)
    if not _fill_rows(disparity, filled):
        filled[np.isnan(filled)] = _median(disparity)
    return filled


def _median(disparity: Float32) -> np.float32:
    """Compute the median of the known values (H, W) px, 0 if there are none. Only those near the median of
    a sample are sorted.
    """
    sample = disparity[::_SAMPLED_EVERY_PX, ::_SAMPLED_EVERY_PX]
    sample, found = sample[np.isfinite(sample)], np.empty(disparity.size, dtype=np.float32)
    low, high = np.percentile(sample, _MIDDLE_PERCENT) if sample.size else (0, 0)
    below, count, above = _take_between(disparity, np.float32(low), np.float32(high), found)
    if below + count + above == 0:
        return np.float32(0)
    if max(below, above) >= (below + count + above) // 2:
        return np.float32(np.median(disparity[np.isfinite(disparity)]))
    middle = [(below + count + above - 1) // 2 - below, (below + count + above) // 2 - below]
    return np.float32(np.partition(found[:count], middle)[middle].mean())


@kernel()
def _take_between(
    disparity: Float32, low: np.float32, high: np.float32, found: Float32
) -> tuple[int, int, int]:
    """Count the values below, between and above two disparities, ignoring NaN.

    disparity: (H, W) px. Fills the first of found (H W,) px with the values in between.
    """
    below = count = above = 0
    for row in disparity:
        for value in row:
            if value < low:
                below += 1
            elif value > high:
                above += 1
            elif value == value:
                found[count] = value
                count += 1
    return below, count, above


@kernel()
def _fill_rows(disparity: Float32, filled: Float32) -> bool:
    """Fill each row's holes and check whether every row had a disparity; rows that had none become NaN.

    disparity: (H, W) px. Fills filled (H, W): holes take the smaller of the values beside them in their row.
    """
    height, width = disparity.shape
    complete = True
    for y in range(height):
        last = -1
        for x in range(width + 1):
            if x < width and np.isnan(disparity[y, x]):
                continue
            if x < width and last == x - 1:
                filled[y, x] = disparity[y, x]
                last = x
                continue
            value = np.float32(np.nan)
            if last >= 0 and x < width:
                value = min(disparity[y, last], disparity[y, x])
            elif last >= 0:
                value = disparity[y, last]
            elif x < width:
                value = disparity[y, x]
            else:
                complete = False
            for hole in range(last + 1, x):
                filled[y, hole] = value
            if x < width:
                filled[y, x] = disparity[y, x]
            last = x
    return complete


@kernel()
def _slopes_beside_holes(
    disparity: Float32, radius: int, same_surface_px: float, slope_x: Float32, slope_y: Float32, first: int,
    end: int,
) -> None:  # fmt: skip
    """Fit slopes (px per px) of the plane around each matched pixel next to a hole, in three rounds of least
    squares, each on the pixels near the previous plane, regularised to zero slope where there are few. Every
    third pixel in each direction is enough for a slope.

    disparity: (H, W) px, NaN in holes. radius: px. Fills slope_x and slope_y (H, W), in rows first...end.
    """
    height, width = disparity.shape
    for y in range(first, end):
        for x in range(width):
            centre = disparity[y, x]
            if np.isnan(centre):
                continue
            beside = False
            for yy in range(max(0, y - 1), min(height, y + 2)):
                for xx in range(max(0, x - 1), min(width, x + 2)):
                    beside = beside or np.isnan(disparity[yy, xx])
            if not beside:
                continue
            p = q = 0.0
            for attempt in range(3):
                slack = 0.05 if attempt == 0 else 0.0
                n = su = sv = suu = suv = svv = r = ru = rv = 0.0
                for yy in range(y - radius, y + radius + 1, _EVERY_PX):
                    if yy < 0 or yy >= height:
                        continue
                    for xx in range(x - radius, x + radius + 1, _EVERY_PX):
                        if xx < 0 or xx >= width:
                            continue
                        u, v = float(xx - x), float(yy - y)
                        d = float(disparity[yy, xx] - centre)
                        # A NaN fails the comparison, so holes stay out.
                        if abs(d - p * u - q * v) < same_surface_px + slack * (abs(u) + abs(v)):
                            n += 1.0
                            su += u
                            sv += v
                            suu += u * u
                            suv += u * v
                            svv += v * v
                            r += d
                            ru += u * d
                            rv += v * d
                if n == 0.0:
                    break
                a, b, c = suu - su * su / n + _SLOPE_HOLD, suv - su * sv / n, svv - sv * sv / n + _SLOPE_HOLD
                right_u, right_v = ru - su * r / n, rv - sv * r / n
                determinant = a * c - b * b
                p = (right_u * c - right_v * b) / determinant
                q = (right_v * a - right_u * b) / determinant
            slope_x[y, x], slope_y[y, x] = p, q


@kernel()
def _sort_by_value(values: Float64, weights: Float64, count: int) -> None:
    """Sort the first `count` values (_RAYS,), ascending, with their weights (_RAYS,), in place (insertion
    sort).
    """
    for i in range(1, count):
        value, weight = values[i], weights[i]
        j = i - 1
        while j >= 0 and values[j] > value:
            values[j + 1], weights[j + 1] = values[j], weights[j]
            j -= 1
        values[j + 1], weights[j + 1] = value, weight


@kernel()
def _fill(
    disparity: Float32,
    gray: Float32,
    leaps: Int32,
    slopes: tuple[Float32, Float32],
    right_px: Float32,
    rays: Float32,
    limits: tuple[float, float],
    guesses: tuple[Float32, Float32],
    first: int,
    end: int,
) -> None:
    """Fill the holes (NaN) of rows first...end with planes, see `fill_occlusions_by_planes`.

    disparity, right_px: (H, W) px. gray: (H, W) smoothed gray levels. leaps: (H, W) px to the nearest match,
    0 at one. slopes: in x and y, (H, W) px per px. rays: (_RAYS, 2) x, y, the larger of them 1. limits:
    minimum and maximum, px. Fills the guesses and their sigmas (H, W) px in the holes; a hole whose rays find
    nothing keeps NaN in both.
    """
    (slope_x, slope_y), (lowest, highest), (filled, sigma) = slopes, limits, guesses
    height, width = disparity.shape
    values, weights, pixels = np.empty(_RAYS), np.empty(_RAYS), np.hypot(rays[:, 0], rays[:, 1])
    for y in range(first, end):
        for x in range(width):
            if not np.isnan(disparity[y, x]):
                continue
            found = 0
            beyond_border = True
            for ray in range(_RAYS):
                way_x, way_y = rays[ray, 0], rays[ray, 1]
                j = leaps[y, x]
                while j < _REACH_PX:
                    xx, yy = math.floor(x + j * way_x + 0.5), math.floor(y + j * way_y + 0.5)
                    if xx < 0 or xx >= width or yy < 0 or yy >= height:
                        break
                    there = disparity[yy, xx]
                    if np.isnan(there):
                        j += leaps[yy, xx]
                        continue
                    distance = j * pixels[ray]
                    # The plane's slope fades out with the distance: far away it means nothing.
                    fade = _SLOPE_LENGTH_PX * (1.0 - math.exp(-distance / _SLOPE_LENGTH_PX)) / distance
                    value = there + fade * (slope_x[yy, xx] * (x - xx) + slope_y[yy, xx] * (y - yy))
                    value = min(max(value, lowest), highest)
                    weight = math.exp(-abs(gray[yy, xx] - gray[y, x]) / _GRAY) / (distance + 2.0)
                    column = round(x - value)
                    if column >= 0:
                        beyond_border = False
                        if right_px[y, min(column, width - 1)] < value:
                            weight *= _SEEN_RATIO
                    values[found], weights[found] = value, weight
                    found += 1
                    break
            if found == 0:
                continue
            quantile = 0.5 if beyond_border else _HIDDEN_QUANTILE
            filled[y, x], sigma[y, x] = _weighted_quantile(values, weights, found, quantile)


@kernel()
def _weighted_quantile(
    values: Float64, weights: Float64, count: int, quantile: float
) -> tuple[np.float32, float]:
    """Compute a weighted quantile of the first `count` candidates and its sigma, px.

    values: (_RAYS,) px; weights: (_RAYS,). Both are sorted by value in place.
    """
    wanted = weights[:count].sum() * quantile
    passed, guess = 0.0, np.float32(np.nan)
    _sort_by_value(values, weights, count)
    for i in range(count):
        passed += weights[i]
        if passed >= wanted:
            guess = np.float32(values[i])
            break
    spread = 0.0
    for i in range(count):
        spread += weights[i] * (values[i] - guess) ** 2
    return guess, math.sqrt(1.0 + _SPREAD_RATIO**2 * spread / weights[:count].sum())
