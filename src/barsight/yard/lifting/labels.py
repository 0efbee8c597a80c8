"""Find labels on the load in the orthophoto: bright plates that hold the faces off, though they are thin."""

from __future__ import annotations

import math

import numpy as np
from scipy import ndimage

from barsight.core.arrays import Bool, Float32, Float64
from barsight.core.linalg.robust import mad_sigma
from barsight.yard.label_settings import LabelSettings
from barsight.yard.lifting.clearance import FacePlane
from barsight.yard.magnet.description import Magnet
from barsight.yard.magnet.footprint import Placement
from barsight.yard.map_lookup import nearest_cells, sample_levels
from barsight.yard.plates import STEP_M, plate_masks
from barsight.yard.types import HeightMap
from barsight.yard.vetoes import Check, check_true

SIZE_M = LabelSettings().size_m
"""A usual label; one with a code is too dark in its middle for `mark_labels`."""
DEEP_M = 0.02
"""A label so far below the faces' plane, on the flank of a bundle, holds nothing off; what is unknown may."""
EDGE_M = 0.02
"""Margin of a label around what the orthophoto shows of it: two cells."""
BESIDE_M = 0.15
"""So far beside what lies under the faces the shape of a label may reach."""
LENGTH_CELLS, WIDTH_CELLS = range(3, 11), 3
"""Steps that a label fills along the bars, and at least across."""
EDGE_SIGMAS, MIN_EDGE_LOG, MIN_COLUMN_LOG = 6.0, (0.2, 0.42), 0.06
"""Logarithm of the darkest of a label's steps over the bare bar's before and behind it, as a mean across the
label: in scatters of the bars' own, and its least and its largest bound; and of each column. A label ends at
once, a gleam fades."""
AROUND_CELLS = 9
"""Steps along a bar over which its scatter is taken."""
WHITE_LEVEL, MIN_WHITE_LOG = 245.0, 0.1
"""Level from which on a picture tells no more, and the least such mean of what is as bright."""
BRIGHTER_RATIO, FULL_LEVEL, MIN_LEVEL = 1.2, 215.0, 140.0
"""Gray level of a label over the median of the load, the level from which on a picture shows no more, and the
least of a label."""
_BESIDE = 4
"""Steps before and behind a label that are read."""
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
            f"a label or another bright plate is under a face, {found[0]:+.2f} m along and "
            f"{found[1]:+.2f} m across the beam: it would hold the faces off the bars"
        )
    return [check_true("gap", "no label is under a face", found is None, reason)]


def find_label(
    place: Placement, heights: HeightMap, magnet: Magnet, plane: FacePlane
) -> tuple[float, float] | None:
    """Find a label under the faces that lies nearly as high as they do, m along and across the beam; None
    where there is none.
    """
    poles, tolerance = magnet.pole_table, magnet.tolerance
    turned = math.radians(tolerance.yaw_deg)
    wide = float((np.abs(poles[:, 1]) + poles[:, 3] / 2).max())
    long = float(tolerance.along(place.along)) + turned * wide + EDGE_M
    broad = float(tolerance.along(place.across)) + turned * magnet.half_span_m + EDGE_M
    v, u = _steps(magnet.half_span_m + long + BESIDE_M), _steps(wide + broad + BESIDE_M)
    gray, z_m = _look_up(place, heights, v, u)
    faces_z_m = plane.centre_z_m + math.tan(plane.pitch_rad) * v[:, None] + math.tan(plane.roll_rad) * u
    is_low = z_m < faces_z_m - DEEP_M
    load = (gray > 0) & ~is_low
    labels = mark_labels(gray, load & (np.abs(u) <= wide + broad))
    for mask in plate_masks(gray, z_m, SIZE_M):
        labels |= mask
    labels &= ~is_low
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


def mark_labels(gray: Float32, load: Bool) -> Bool:
    """Mark the cells (V, U) of labels: bright, and at once darker before and behind along the bars. A bright
    strap is marked as well.

    gray: levels, 0 where nothing was seen, which counts as dark. load: cells that tell the load's usual level
    and its scatter.
    """
    if not load.any():
        return np.zeros(gray.shape, np.bool_)
    level = np.log(gray + _DARK)
    mean = ndimage.uniform_filter1d(level, WIDTH_CELLS, axis=1)
    scatter = mad_sigma((mean - ndimage.uniform_filter1d(mean, AROUND_CELLS, axis=0))[load])
    edge = float(np.clip(EDGE_SIGMAS * scatter, *MIN_EDGE_LOG))
    needed = max(min(BRIGHTER_RATIO * float(np.median(gray[load])), FULL_LEVEL), MIN_LEVEL)
    bright = mean > np.log(needed + _DARK)
    marked = np.zeros(gray.shape, np.bool_)
    for length in LENGTH_CELLS:
        if length + 2 * _BESIDE > len(gray):
            break
        columns = _edge_logs(level, length)[0] > MIN_COLUMN_LOG
        wide = ndimage.binary_erosion(columns, np.ones((1, WIDTH_CELLS), np.bool_))
        edges, lowest = _edge_logs(mean, length)
        is_white = lowest > np.log(WHITE_LEVEL + _DARK)
        found = wide & (edges > np.where(is_white, MIN_WHITE_LOG, edge))
        found = ndimage.binary_dilation(found, np.ones((1, WIDTH_CELLS), np.bool_))
        for row in range(_BESIDE, _BESIDE + length):
            marked[row : row + len(found)] |= found
    return np.asarray(bright & marked, np.bool_)


def _edge_logs(level: Float32, length: int) -> tuple[Float32, Float32]:
    """Compute how far the lowest of `length` steps stands over the bare bar's before and behind it, and the
    lowest: (V - length - 2 _BESIDE + 1, U), for runs from step _BESIDE on.

    The bare bar's are the two next steps but one, or but two: a picture blurs an end over one or two.
    """
    count = len(level) - length - 2 * _BESIDE + 1
    rows = [level[k : k + count] for k in range(length + 2 * _BESIDE)]
    lowest = np.min(rows[_BESIDE:-_BESIDE], axis=0)
    bare = [
        np.minimum(np.maximum(near, middle), np.maximum(middle, far))
        for far, middle, near in (rows[:3], rows[:-4:-1])
    ]
    return np.asarray(lowest - np.maximum(*bare)), np.asarray(lowest)


def _look_up(place: Placement, heights: HeightMap, v: Float64, u: Float64) -> tuple[Float32, Float32]:
    """Look up gray levels and heights (V, U) at places along and across; 0 and NaN where nothing was seen.

    Levels are interpolated between the four cells about: along bars that lie a little askew the nearest cell
    jumps aside from step to step, and a bar's bright crest then seems to begin there.
    """
    x = place.x_m + v[:, None] * place.along[0] + u * place.across[0]
    y = place.y_m + v[:, None] * place.along[1] + u * place.across[1]
    column, row, inside = nearest_cells(heights, x, y)
    assert heights.gray is not None
    nearest = np.where(inside, heights.gray[row, column], 0).astype(np.float32)
    between = sample_levels(heights, heights.gray, x, y)
    return (
        np.where(np.isfinite(between), between, nearest),
        np.where(inside, heights.z_m[row, column], np.float32(np.nan)),
    )
