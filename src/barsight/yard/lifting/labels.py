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
LENGTH_CELLS, WIDTH_CELLS = range(3, 11), 3
"""Steps that a label fills along the bars, and at least across."""
MIN_EDGE_LOG, MIN_COLUMN_LOG = 0.25, 0.12
"""Logarithm of the darkest of a label's steps over the bare bar's two and three steps before and behind it,
as a mean across the label and of each of its columns: a label ends at once, a gleam fades."""
STRAP_CELLS, MAX_ACROSS_CELLS = 4, 13
"""What is no longer than the one and wider than the other is a bright strap."""
BRIGHTER_RATIO, FULL_LEVEL, MIN_LEVEL = 1.3, 215.0, 140.0
"""Gray level of a label over the median of the load, the level from which on a picture shows no more, and the
least of a label."""
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
    long = float(np.abs(place.along) @ slack) + turned * wide + EDGE_M
    broad = float(np.abs(place.across) @ slack) + turned * magnet.half_span_m + EDGE_M
    v, u = _steps(magnet.half_span_m + long + BESIDE_M), _steps(wide + broad + BESIDE_M)
    gray, z_m = _look_up(place, heights, v, u)
    labels = mark_labels(gray)
    for mask in plate_masks(gray, z_m, SIZE_M):
        labels |= mask
    faces_z_m = plane.centre_z_m + math.tan(plane.pitch_rad) * v[:, None] + math.tan(plane.roll_rad) * u
    labels &= ~(z_m < faces_z_m - DEEP_M)
    under = np.zeros(gray.shape, np.bool_)
    for along, across, length, width in poles:
        rows = np.abs(v - along) <= length / 2 + long
        under |= rows[:, None] & (np.abs(u - across) <= width / 2 + broad)
    under &= labels
    cells = np.argwhere(under)
    return (float(v[cells[0, 0]]), float(u[cells[0, 1]])) if cells.size else None


def _steps(reach_m: float) -> Float64:
    """List places STEP_M apart to either side of 0."""
    count = math.ceil(reach_m / STEP_M)
    return np.asarray(STEP_M * np.arange(-count, count + 1), np.float64)


def mark_labels(gray: Float32) -> Bool:
    """Mark the cells (V, U) of labels: bright, and at once darker before and behind along the bars.

    gray: levels, 0 where nothing was seen.
    """
    level = np.log(gray + _DARK)
    mean = ndimage.uniform_filter1d(level, WIDTH_CELLS, axis=1)
    seen = gray[gray > 0]
    needed = min(BRIGHTER_RATIO * float(np.median(seen)), FULL_LEVEL) if seen.size else np.inf
    bright = mean > np.log(max(needed, MIN_LEVEL) + _DARK)
    short, long = np.zeros((2, *gray.shape), np.bool_)
    for length in LENGTH_CELLS:
        if length + 6 > len(gray):
            break
        columns = _edge_logs(level, length) > MIN_COLUMN_LOG
        wide = ndimage.binary_erosion(columns, np.ones((1, WIDTH_CELLS), np.bool_))
        found = wide & (_edge_logs(mean, length) > MIN_EDGE_LOG)
        found = ndimage.binary_dilation(found, np.ones((1, WIDTH_CELLS), np.bool_))
        marked = short if length <= STRAP_CELLS else long
        for row in range(length):
            marked[3 + row : 3 + row + len(found)] |= found
    return np.asarray(long & bright | _without_straps(short & bright), np.bool_)


def _edge_logs(level: Float32, length: int) -> Float32:
    """Compute how far the lowest of `length` steps stands over the highest of the two beyond the next, before
    and behind: (V - length - 5, U), for runs from the fourth step on.
    """
    count = len(level) - length - 5
    rows = [level[k : k + count] for k in range(length + 6)]
    return np.asarray(np.min(rows[3:-3], axis=0) - np.max([*rows[:2], *rows[-2:]], axis=0))


def _without_straps(marked: Bool) -> Bool:
    """Unmark what goes on across the bars for longer than a label."""
    numbers, _ = ndimage.label(marked, np.ones((3, 3)))
    for number, place in enumerate(ndimage.find_objects(numbers), start=1):
        if place[1].stop - place[1].start > MAX_ACROSS_CELLS:
            marked[numbers == number] = False
    return marked


def _look_up(place: Placement, heights: HeightMap, v: Float64, u: Float64) -> tuple[Float32, Float32]:
    """Look up gray levels and heights (V, U) at places along and across; 0 and NaN where nothing was seen."""
    x = place.x_m + v[:, None] * place.along[0] + u * place.across[0]
    y = place.y_m + v[:, None] * place.along[1] + u * place.across[1]
    column, row, inside = nearest_cells(heights, x, y)
    assert heights.gray is not None
    gray = np.where(inside, heights.gray[row, column], 0)
    return gray.astype(np.float32), np.where(inside, heights.z_m[row, column], np.float32(np.nan))
