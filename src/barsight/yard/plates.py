"""Find labels without reading them: bright plates of a label's size on bundles, in the orthophoto."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import chain

import cv2
import numpy as np

from barsight.core.arrays import Bool, Float32, Float64
from barsight.yard.sections import part_about
from barsight.yard.types import Bundle, YardMap

STEP_M = 0.01
ASIDE_M = 0.05
"""Distance (m) beside a bundle that is searched too: what continues there isn't a label."""
OPENING_RATIO = 1.7
"""Maximum length of a bright run along the bars, in lengths of a label: a longer one is a bar."""
CODE_CELLS = 7
"""Number of cells along the bars that is larger than a code's dark modules."""
BRIGHTER_LOGS = (0.22, 0.35, 0.5, 0.8)
"""Thresholds on the log ratio of a plate to its bars before and behind; at one of them its shape shows."""
MIDDLE_LOG, USUAL_RATIO = 0.28, 4.6
"""Minimum log ratio of a plate's median cell: absolute, and as a multiple of the value below which four
fifths of the bundle's cells stay.
"""
MIN_SIDE_RATIO, MAX_SIDE_RATIO = (0.6, 0.75), 1.5
"""Minimum and maximum ratios of a plate's longer and shorter side to a label's."""
MIN_FULL_RATIO = 0.72
"""Minimum share of the smallest rectangle around a plate that is bright."""
WHITE_LEVEL, CODE_LOGS = 200.0, (0.22, 0.35)
"""Minimum level of the paper before and behind a code, and thresholds on its log ratio to the code's level:
on a bar as bright as the paper only the code shows.
"""
MAX_CODE_LOG, DARK_QUANTILE = 0.7, 0.75
"""Maximum log ratio of the white to a code's cells, and the share of cells within it: a code is half white.
What is darker, or so dark that no picture shows it, is a strap.
"""
MIN_CODE_RATIO, MAX_CODE_RATIO, MIN_CODE_FULL = (0.8, 0.6), 1.3, 0.85
"""Range of a code's sides in shorter sides of the label, and minimum share of its rectangle that it fills."""
BESIDE_M, MAX_RISE_M = 0.1, 0.015
"""Distance (m) before and behind a plate of the surface that it is compared with, and its maximum rise (m)
over that: blocks rise more.
"""
_DARK = 10.0
"""Level added to all levels, since ratios of very dark levels mean nothing."""


def find_plates(bundle: Bundle, heights: YardMap, size_m: tuple[float, float]) -> list[Float64]:
    """Find the middles (2,) in m of bright plates of about size_m on a bundle's top, in either direction;
    none without an orthophoto.
    """
    across = np.arange(-bundle.width_m / 2 - ASIDE_M, bundle.width_m / 2 + ASIDE_M, STEP_M)
    along = np.arange(-bundle.length_m / 2, bundle.length_m / 2 + STEP_M / 2, STEP_M)
    x, y = (
        bundle.centre_m[k] + bundle.axes[0, k] * across + bundle.axes[1, k] * along[:, None] for k in (0, 1)
    )
    part = part_about(heights, x.ravel(), y.ravel())
    if part.gray is None or not part.gray.any():
        return []
    rows = np.rint((y - part.y0_m) / part.cell_m).astype(np.int64).clip(0, part.shape[0] - 1)
    columns = np.rint((x - part.x0_m) / part.cell_m).astype(np.int64).clip(0, part.shape[1] - 1)
    gray, z_m = part.gray[rows, columns], part.z_m[rows, columns]
    middles = (
        tuple(round(float(at.mean())) for at in np.nonzero(cells))
        for cells in plate_masks(gray.astype(np.float32), z_m, size_m)
    )
    return [np.array([x[at], y[at]]) for at in middles if abs(across[at[1]]) <= bundle.width_m / 2]


def plate_masks(
    gray: Float32, z_m: Float32, size_m: tuple[float, float], white_level: float = WHITE_LEVEL, *,
    unknown_rise_m: float = math.inf,
) -> Iterator[Bool]:  # fmt: skip
    """Yield a mask (V, U) of each plate of about size_m, in either direction; one plate may occur twice.

    gray: levels (V, U) at places STEP_M apart, V along the bars; 0 where nothing was seen. z_m: heights.
    white_level: minimum level of the paper around a code. unknown_rise_m: what a plate counts as rising where
    its height, or that beside it, isn't known.
    """
    for cells in (*_plates(gray, size_m), *_codes(gray, size_m, white_level)):
        rise = _rise(cells, z_m)
        if abs(unknown_rise_m if math.isnan(rise) else rise) <= MAX_RISE_M:
            yield cells


def _plates(gray: Float32, size_m: tuple[float, float]) -> Iterator[Bool]:
    """Yield the cells of each bright area of a label's size."""
    excess = _excess(gray, size_m)
    limit = max(MIDDLE_LOG, USUAL_RATIO * float(np.quantile(excess, 0.8)))
    if excess.max() < limit:
        return
    for cells in chain.from_iterable(_blobs(excess > level, size_m) for level in BRIGHTER_LOGS):
        ratio, full = _shape(cells, size_m)
        fits = (ratio >= MIN_SIDE_RATIO).all() and (ratio <= MAX_SIDE_RATIO).all() and full >= MIN_FULL_RATIO
        if fits and float(np.median(excess[cells])) >= limit:
            yield cells


def _codes(gray: Float32, size_m: tuple[float, float], white_level: float) -> Iterator[Bool]:
    """Yield the cells of each area of a code's size that is darker than the white before and behind it."""
    level, side = np.log(gray + _DARK), min(size_m)
    length = round(1.5 * side / STEP_M) | 1
    white = cv2.morphologyEx(level, cv2.MORPH_CLOSE, np.ones((length, 1), np.uint8))
    if white.max() <= np.log(white_level):
        return
    dark = np.where(gray > 0, white - level, np.float32(np.inf))
    lack = np.where((white > np.log(white_level)) & (gray > 0), dark, 0)
    for cells in chain.from_iterable(_blobs(lack > least, (side, side)) for least in CODE_LOGS):
        ratio, full = _shape(cells, (side, side))
        fits = (ratio >= MIN_CODE_RATIO).all() and (ratio <= MAX_CODE_RATIO).all() and full >= MIN_CODE_FULL
        if fits and float(np.quantile(dark[cells], DARK_QUANTILE, method="higher")) <= MAX_CODE_LOG:
            yield cells


def _excess(gray: Float32, size_m: tuple[float, float]) -> Float32:
    """Compute the log ratio of levels (V, U) to the bars' own, V along them; 0 where nothing was seen."""
    level = np.where(gray > 0, np.log(gray + _DARK), np.float32(-1))
    filled = cv2.morphologyEx(level, cv2.MORPH_CLOSE, np.ones((CODE_CELLS, 1), np.uint8))
    seen = filled > 0
    length = round(OPENING_RATIO * max(size_m) / STEP_M) | 1
    bars = cv2.morphologyEx(
        np.where(seen, filled, np.float32(np.log(512.0))), cv2.MORPH_OPEN, np.ones((length, 1), np.uint8)
    )
    excess: Float32 = np.where(seen, filled - bars, np.float32(0))
    return excess


def _blobs(bright: Bool, size_m: tuple[float, float]) -> list[Bool]:
    """List the connected areas that may be of about size_m: neither much smaller nor longer."""
    mask = bright.astype(np.uint8)
    for way in (cv2.MORPH_CLOSE, cv2.MORPH_OPEN):
        mask = cv2.morphologyEx(mask, way, np.ones((3, 3), np.uint8))
    _, numbers, stats, _ = cv2.connectedComponentsWithStats(mask)
    longest = MAX_SIDE_RATIO * math.hypot(*size_m) / STEP_M
    small = MIN_FULL_RATIO * math.prod(MIN_SIDE_RATIO) * math.prod(size_m) / STEP_M**2
    fits = (stats[1:, cv2.CC_STAT_AREA] >= small) & (
        stats[1:, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]].max(axis=1) <= longest
    )
    return [numbers == number for number in 1 + np.flatnonzero(fits)]


def _shape(cells: Bool, size_m: tuple[float, float]) -> tuple[Float64, float]:
    """Compute the ratios of the sides of the smallest rectangle around cells to those of size_m, the longer
    first, and the share of it that the cells fill.
    """
    rows, columns = np.nonzero(cells)
    _, sides, _ = cv2.minAreaRect(np.stack([columns, rows], axis=1).astype(np.float32))
    sides_m = (np.sort(sides)[::-1] + 1) * STEP_M
    full = rows.size * STEP_M**2 / float(np.prod(sides_m))
    return sides_m / np.sort(size_m)[::-1], full


def _rise(cells: Bool, z_m: Float32) -> float:
    """Compute how far cells rise over the higher surface before or behind them; NaN if unknown."""
    i, j = np.nonzero(cells)
    beside = []
    for way in (-1, 1):
        at = i + way * round(BESIDE_M / STEP_M)
        there = (at >= 0) & (at < len(z_m))
        level = z_m[at[there], j[there]]
        beside += [float(np.median(level[np.isfinite(level)]))] if np.isfinite(level).any() else []
    own = z_m[i, j]
    if not beside or not np.isfinite(own).any():
        return math.nan
    return float(np.median(own[np.isfinite(own)])) - max(beside)
