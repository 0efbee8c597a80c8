"""Find long objects that lie across the bundles, and their headings, so that bundles are sought there too."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np

from barsight.core.arrays import Bool, Float32, Float64, Int64, UInt8
from barsight.core.linalg.robust import nan_medians
from barsight.core.records.heights import HeightSource
from barsight.yard.bundles.fitting.outline import STEP_M, make_outline
from barsight.yard.bundles.fitting.outline_fit import AGREES, DIAMETER, ROLL, SLOPE_U, SLOPE_Z, Fit, U, Z
from barsight.yard.bundles.fitting.rotated_map import AlignedMap
from barsight.yard.bundles.fitting.settings import BundleSettings
from barsight.yard.types import HeightMap

OVER_M = 0.05
"""Height over a bundle's outline from which something counts as lying on it: more than the map's errors."""
_FURTHER_M = 1.5
"""Distance (m) beyond a followed piece over which the bundle may continue under what lies there."""
_STEP_M = 0.06
"""Minimum height step (m) between neighbouring cells that belong to different objects."""
_MIN_CELLS = 30
_FLANK = (0.3, 0.45)
"""Range of distances from the axis, in widths, in which a bundle falls off as round bars do."""
_FOLLOWS_M = 0.03
_FOLLOWED_RATIO = 0.4
_READ_RATIO = 0.5
_GAP_CELLS, _THIN_CELLS = 7, 5
_LEVEL_M = 0.008
_MARGIN_M = 0.6
_SLENDER = 1.8


def crossing_pieces(
    height_map: HeightMap,
    kept: list[tuple[AlignedMap, Fit]],
    headings: tuple[float, ...],
    settings: BundleSettings,
) -> Iterator[tuple[float, HeightMap]]:
    """Cut out each long object over the kept outlines: its heading (rad) and the map around it.

    Objects along the most common heading are left out, since they are found with the other bundles, and so
    are those that a kept outline follows.
    """
    over, followed = (np.zeros(height_map.z_m.shape, np.uint8) for _ in range(2))
    for grid, fit in kept:
        for cells, mask in zip(_cells_over(grid, fit, settings, height_map), (over, followed), strict=True):
            mask[cells] = 1
    read = np.zeros(height_map.z_m.shape, bool)
    for row, column in _pieces(_level(height_map), over):
        heading = _heading(row, column, settings.min_length_m / height_map.cell_m)
        if heading is None or _is_near(heading, headings[:1], settings.max_skew_deg):
            continue
        if followed[row, column].mean() > _FOLLOWED_RATIO or read[row, column].mean() > _READ_RATIO:
            continue
        if _is_level(height_map.z_m[row, column], row, column, heading):
            continue
        read[row, column] = True
        yield heading, _around(height_map, row, column)


def _cells_over(
    grid: AlignedMap, fit: Fit, settings: BundleSettings, height_map: HeightMap
) -> tuple[tuple[Int64, Int64], tuple[Int64, Int64]]:
    """Select rows and columns of the map's cells that lie over the outline, or over where the bundle may
    continue, and of the cells that lie on it.
    """
    further = round(_FURTHER_M / grid.cell_m)
    rows = np.arange(max(fit.first - further, 0), min(fit.last + further + 1, grid.z_m.shape[0]))
    v = grid.v0_m + grid.cell_m * rows
    across = np.arange(-0.5 * fit.width_m, 0.5 * fit.width_m, grid.cell_m)
    u = fit.values[U] + fit.values[SLOPE_U] * (v - fit.v_m)[:, None] + across
    rise = rise_over(grid, fit, rows, u, settings)

    def cells(chosen: Bool) -> tuple[Int64, Int64]:
        places = grid.to_map(np.stack([u[chosen], np.broadcast_to(v[:, None], u.shape)[chosen]], axis=1))
        places = np.rint((places - (height_map.x0_m, height_map.y0_m)) / height_map.cell_m).astype(np.int64)
        rows, columns = height_map.z_m.shape
        return places[:, 1].clip(0, rows - 1), places[:, 0].clip(0, columns - 1)

    return cells(rise > OVER_M), cells(np.abs(rise) <= OVER_M)


def rise_over(grid: AlignedMap, fit: Fit, rows: Int64, u: Float64, settings: BundleSettings) -> Float64:
    """Sample heights (R, N) over the outline at rows (R,) and lateral places u (R, N); NaN where unknown."""
    outline = make_outline(
        fit.rings, float(fit.values[DIAMETER]), float(fit.values[ROLL]), settings.smoothing_m
    )
    along = (grid.v0_m + grid.cell_m * rows - fit.v_m)[:, None]
    beside = u - fit.values[U] - fit.values[SLOPE_U] * along
    place = np.rint((beside + outline.reach_m) / STEP_M).astype(int)
    column = np.rint((u - grid.u0_m) / grid.cell_m).astype(int)
    inside = (column >= 0) & (column < grid.z_m.shape[1]) & (place >= 0) & (place < outline.seen_m.size)
    z = grid.z_m[rows[:, None], np.where(inside, column, 0)]
    height = outline.seen_m[np.where(inside, place, 0)]
    rise: Float64 = np.where(inside, z - fit.values[Z] - fit.values[SLOPE_Z] * along - height, np.nan)
    return rise


def is_beam(grid: AlignedMap, fit: Fit, settings: BundleSettings) -> bool:
    """Check whether the mean section is a beam's: level up to its edges instead of round.

    It is a beam's where the bars would be thinner than any that are allowed, where a flank departs from the
    outline, or where the middle is closer to level than to the outline. Where both flanks fall off as the
    outline does, the middle may be level, since two bars side by side look like that.
    """
    if fit.rings > 0 and fit.values[DIAMETER] < settings.min_bar_diameter_m:
        return True
    rows = np.flatnonzero(fit.state == AGREES)
    rows = rows[(rows >= fit.first) & (rows <= fit.last)]
    across = np.arange(-_FLANK[1] * fit.width_m, _FLANK[1] * fit.width_m, grid.cell_m / 2)
    along = grid.v0_m + grid.cell_m * rows - fit.v_m
    u = fit.values[U] + fit.values[SLOPE_U] * along[:, None] + across
    rise = rise_over(grid, fit, rows, u, settings)
    known = np.isfinite(rise).any(axis=0)
    section = np.full(across.size, np.nan)
    section[known] = nan_medians(rise[:, known])
    flanks = [section[known & (side * across > _FLANK[0] * fit.width_m)] for side in (-1, 1)]
    seen = [float(np.median(flank)) for flank in flanks if flank.size]
    if max((abs(one) for one in seen), default=0.0) > _FOLLOWS_M:
        return True
    outline = make_outline(
        fit.rings, float(fit.values[DIAMETER]), float(fit.values[ROLL]), settings.smoothing_m
    )
    middle = known & (np.abs(across) < _FLANK[0] * fit.width_m)
    height = outline.seen_m[np.rint((across + outline.reach_m) / STEP_M).astype(int)]
    fall = np.median(height[middle]) - np.median(height[known & ~middle]) if middle.sum() >= 3 else 0.0
    if fall > _FOLLOWS_M and len(seen) == 2 and max(abs(one) for one in seen) < _FOLLOWS_M / 3:
        return False
    rest = section[middle]
    return bool(middle.sum() >= 3 and np.var(rest + height[middle]) < np.var(rest))


def _level(height_map: HeightMap) -> UInt8:
    """Mark by 1 the measured cells without a height step beside them: surfaces that are bounded by steps."""
    measured = HeightSource.measured(height_map.source)
    z = height_map.z_m
    around = np.ones((3, 3), np.uint8)
    far = np.float32(1e6)
    highest = cv2.dilate(np.where(measured, z, -far), around)
    lowest = cv2.erode(np.where(measured, z, far), around)
    return np.asarray(measured & (highest - lowest < _STEP_M), dtype=np.uint8)


def _pieces(level: UInt8, over: UInt8) -> Iterator[tuple[Int64, Int64]]:
    """Yield rows and columns of each surface that lies partly over an outline, then of each connected piece
    of the cells over the outlines.

    Noise may join an object's surface to those beneath it. Among the cells over the outlines it is separate.
    """
    closed = cv2.morphologyEx(over, cv2.MORPH_CLOSE, np.ones((_GAP_CELLS, _GAP_CELLS), np.uint8))
    closed = cv2.morphologyEx(closed, cv2.MORPH_OPEN, np.ones((_THIN_CELLS, _THIN_CELLS), np.uint8))
    for whole in (level, closed):
        _, parts, boxes, _ = cv2.connectedComponentsWithStats(whole, connectivity=4)
        cells = np.bincount(parts[over > 0], minlength=len(boxes))
        cells[0] = 0
        for number in np.flatnonzero(cells >= _MIN_CELLS):
            x, y, width, height = boxes[number, :4]
            row, column = np.nonzero(parts[y : y + height, x : x + width] == number)
            yield row + y, column + x


def _heading(row: Int64, column: Int64, min_cells: float) -> float | None:
    """Compute the long axis's angle from +y, in (-pi/2, pi/2]; None if short or not clearly elongated."""
    if row.size < min_cells:
        return None
    places: Float64 = np.stack([column, row]).astype(np.float64)
    spread, axes = np.linalg.eigh(np.cov(places))
    if 12 * spread[1] < min_cells**2 or spread[1] < _SLENDER**2 * spread[0]:
        return None
    x, y = axes[:, 1]
    heading = float(np.arctan2(-x, y))
    return (heading + np.pi / 2) % -np.pi + np.pi / 2


def _is_level(z: Float32, row: Int64, column: Int64, heading: float) -> bool:
    """Check whether the middle of the section is level like a beam's, so that reading it would be in vain."""
    across = np.rint(np.cos(heading) * column + np.sin(heading) * row).astype(np.int64)
    low, high = np.quantile(across, [0.15, 0.85])
    heights = [float(np.median(z[across == u])) for u in range(int(np.ceil(low)), int(high) + 1)]
    return bool(np.ptp(heights) < _LEVEL_M) if heights else True


def _is_near(heading: float, headings: tuple[float, ...], apart_deg: float) -> bool:
    apart = [abs((np.degrees(heading - other) + 90) % 180 - 90) for other in headings]
    return min(apart, default=np.inf) < apart_deg


def _around(height_map: HeightMap, row: Int64, column: Int64) -> HeightMap:
    margin = round(_MARGIN_M / height_map.cell_m)
    j, i = max(int(row.min()) - margin, 0), max(int(column.min()) - margin, 0)
    return height_map.part(slice(j, int(row.max()) + margin + 1), slice(i, int(column.max()) + margin + 1))
