"""Find labels on the load in the orthophoto: bright plates that hold the faces off, though they are thin."""

from __future__ import annotations

import math

import numpy as np
from scipy import ndimage

from barsight.core.arrays import Bool, Float32, Float64
from barsight.yard.label_settings import LabelSettings
from barsight.yard.lifting.clearance import FacePlane
from barsight.yard.magnet.description import Magnet
from barsight.yard.magnet.footprint import Placement
from barsight.yard.plates import STEP_M, plate_masks
from barsight.yard.stability.stability import nearest_cells
from barsight.yard.types import HeightMap
from barsight.yard.vetoes import Check, check_true

SIZE_M = LabelSettings().size_m
"""A usual label; one with a code is too dark in its middle for `mark_labels`."""
DEEP_M = 0.02
"""A label so far below the faces' plane, on the flank of a bundle, holds nothing off; what is unknown may."""
EDGE_M = 0.01
"""Margin of a label around what the orthophoto shows of it: a cell."""
BESIDE_M = 0.15
"""So far beside what lies under the faces the shape of a label may reach."""
LENGTH_CELLS, WIDTH_CELLS, APART_CELLS = 5, 3, 5
"""Steps that a label fills along the bars and across, and from its middle to the bare bar on both sides: a
label ends at once, a gleam fades."""
BRIGHTER_RATIO, FULL_LEVEL, MIN_LEVEL = 1.3, 215.0, 140.0
"""Gray level of a label over the median of the load, the level from which on a picture shows no more, and the
least of a label's steps."""
MEAN_LOG, ODD_CELLS = 0.15, 1
"""Logarithm of a label's level over that of the brighter end of the bare bar, on average; each step but so
many is brighter than that."""
_DARK = 10.0
"""Level that is added to both: where hardly any light is, ratios tell nothing."""


def label_checks(place: Placement, heights: HeightMap, magnet: Magnet, plane: FacePlane) -> list[Check]:
    """Check that no label lies under a face, wherever within its tolerance the crane sets it down; empty
    without an orthophoto.
    """
    if heights.gray is None:
        return []
    found = find_label(place, heights, magnet, plane)
    reason = ""
    if found is not None:
        reason = (
            f"a label or another bright plate lies under a face, {found[0]:+.2f} m along and "
            f"{found[1]:+.2f} m across the beam: it would hold the faces off the bars"
        )
    return [check_true("gap", "no label lies under a face", found is None, reason)]


def find_label(
    place: Placement, heights: HeightMap, magnet: Magnet, plane: FacePlane
) -> tuple[float, float] | None:
    """Find a label under the faces that lies nearly as high as they do, m along and across the beam; None
    where there is none.
    """
    poles, tolerance = magnet.pole_table, magnet.tolerance
    slack = np.array([tolerance.x_m, tolerance.y_m])
    turned = math.radians(tolerance.yaw_deg)
    wide = float((np.abs(poles[:, 1]) + poles[:, 3] / 2).max())
    edge = np.full(2, EDGE_M)
    off = edge + np.array([LENGTH_CELLS, WIDTH_CELLS]) * STEP_M / 2  # of a marked middle to the label's edge
    long = float(np.abs(place.along) @ slack) + turned * wide
    broad = float(np.abs(place.across) @ slack) + turned * magnet.half_span_m
    reach_v = magnet.half_span_m + long + off[0] + (APART_CELLS + LENGTH_CELLS) * STEP_M
    reach_u = wide + broad + off[1] + STEP_M
    v, u = _steps(reach_v + BESIDE_M), _steps(reach_u + BESIDE_M)
    gray, z_m = _look_up(place, heights, v, u)
    middles, plates = np.zeros((2, *gray.shape), np.bool_)
    near = np.ix_(np.abs(v) < reach_v + STEP_M, np.abs(u) < reach_u + STEP_M)
    middles[near] = mark_labels(gray[near])
    for mask in plate_masks(gray, z_m, SIZE_M):
        plates |= mask
    faces_z_m = plane.centre_z_m + math.tan(plane.pitch_rad) * v[:, None] + math.tan(plane.roll_rad) * u
    is_near = ~(z_m < faces_z_m - DEEP_M)
    under = np.zeros(gray.shape, np.bool_)
    for marked, (more_v, more_u) in ((middles, off), (plates, edge)):
        for along, across, length, width in poles:
            rows = np.abs(v - along) <= length / 2 + long + more_v
            under |= rows[:, None] & (np.abs(u - across) <= width / 2 + broad + more_u) & marked & is_near
    cells = np.argwhere(under)
    return (float(v[cells[0, 0]]), float(u[cells[0, 1]])) if cells.size else None


def _steps(reach_m: float) -> Float64:
    """List places STEP_M apart to either side of 0."""
    count = math.ceil(reach_m / STEP_M)
    return np.asarray(STEP_M * np.arange(-count, count + 1), np.float64)


def mark_labels(gray: Float32) -> Bool:
    """Mark the middles (V, U) of labels: bright all over, and darker before and behind along the bars.

    gray: levels, 0 where nothing was seen.
    """
    inner = ndimage.uniform_filter1d(gray, LENGTH_CELLS, axis=0)
    bare = ndimage.uniform_filter1d(gray, WIDTH_CELLS, axis=0)
    brighter = np.maximum(np.roll(bare, APART_CELLS, axis=0), np.roll(bare, -APART_CELLS, axis=0)) + _DARK
    mean = ndimage.uniform_filter1d(np.log((inner + _DARK) / brighter), WIDTH_CELLS, axis=1)
    darkest = ndimage.rank_filter(gray, ODD_CELLS, size=(LENGTH_CELLS, WIDTH_CELLS)) + _DARK
    brightest = ndimage.maximum_filter1d(brighter, WIDTH_CELLS, axis=1)
    level = ndimage.uniform_filter1d(inner, WIDTH_CELLS, axis=1)
    seen = gray[gray > 0]
    needed = min(BRIGHTER_RATIO * float(np.median(seen)), FULL_LEVEL) if seen.size else np.inf
    sure = (darkest > brightest) & (darkest > MIN_LEVEL + _DARK)
    return np.asarray((mean > MEAN_LOG) & sure & (level > needed))


def _look_up(place: Placement, heights: HeightMap, v: Float64, u: Float64) -> tuple[Float32, Float32]:
    """Look up gray levels and heights (V, U) at places along and across; 0 and NaN where nothing was seen."""
    x = place.x_m + v[:, None] * place.along[0] + u * place.across[0]
    y = place.y_m + v[:, None] * place.along[1] + u * place.across[1]
    column, row, inside = nearest_cells(heights, x, y)
    assert heights.gray is not None
    gray = np.where(inside, heights.gray[row, column], 0)
    return gray.astype(np.float32), np.where(inside, heights.z_m[row, column], np.float32(np.nan))
