"""Find labels on the load in the orthophoto: bright plates that, though thin, hold the faces off the bars."""

from __future__ import annotations

import math

import numpy as np
from scipy import ndimage

from barsight.core.arrays import Bool, Float32, Float64, UInt8
from barsight.core.linalg.robust import mad_sigma
from barsight.yard.label_settings import LabelSettings
from barsight.yard.lifting.clearance import FacePlane
from barsight.yard.magnet.description import Magnet
from barsight.yard.magnet.footprint import Placement
from barsight.yard.map_lookup import SATURATED_LEVEL, nearest_cells, sample_levels
from barsight.yard.plates import STEP_M, WHITE_LEVEL, plate_masks
from barsight.yard.types import HeightMap
from barsight.yard.vetoes import Check, check_true

SIZE_M = LabelSettings().size_m
"""Size (m) of a usual label; the middle of one with a code is too dark for `mark_labels`."""
DEEP_M = 0.02
"""Depth (m) below the faces' plane from which a label, being on a bundle's flank, holds nothing off. Labels
of unknown height may.
"""
EDGE_M = 0.02
"""Margin (m) of a label around what the orthophoto shows of it: two cells."""
BESIDE_M = 0.15
"""Distance (m) beyond the area under the faces over which a label's shape may extend."""
LENGTH_CELLS, WIDTH_CELLS = range(3, 11), 3
"""Range of a label's length along the bars, and its minimum width across, in steps."""
EDGE_SIGMAS, MIN_EDGE_LOG, MIN_COLUMN_LOG = 6.0, (0.2, 0.42), 0.06
"""Thresholds on the log ratio of a label's darkest step to the bare bar before and behind it. For its mean
across the label: in scatters of the bars' own levels, with minimum and maximum; for each column: minimum. A
label ends abruptly, a reflection fades.
"""
AROUND_CELLS = 9
"""Number of steps along a bar over which its scatter is measured."""
MAX_LEVEL, ROOM_RATIO = 255.0, 0.7
"""Level at which a picture saturates; a label's minimum share of the log ratio from the bare bar to it: on
polished steel paper can't be brighter by more.
"""
BRIGHTER_RATIO, FULL_LEVEL = 1.2, 215.0
"""Minimum ratio of a label's gray level to the load's median, and the maximum of that level."""
MIN_RATIO, MIN_LEVEL = 1.65, 140.0
"""Minimum ratio of a label's gray level to the orthophoto's median, and the maximum of that level."""
SAMPLED_EVERY = 8
"""Number of cells between those from which that median is taken."""
PAPER_RATIO = 2.3
"""Minimum ratio of the level of a code's paper to the orthophoto's median; WHITE_LEVEL is always enough."""
WHITE_CELLS = 6, 3
"""Size along and across, in steps, of a saturated place that may be a label."""
_BESIDE = 4
"""Number of steps before and behind a label that are read."""
_DARK = 10.0
"""Level added to both levels of a ratio, since ratios of very dark levels mean nothing."""


def label_checks(place: Placement, heights: HeightMap, magnet: Magnet, plane: FacePlane) -> list[Check]:
    """Check that no label lies under a face wherever the crane sets it down within its tolerance; empty
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
    """Find a label under the faces that is nearly as high as they are. Returns m along and across the beam;
    None where there is none.
    """
    poles, tolerance = magnet.pole_table, magnet.tolerance
    turned = math.radians(tolerance.yaw_deg)
    wide = float((np.abs(poles[:, 1]) + poles[:, 3] / 2).max())
    long = float(tolerance.along(place.along)) + turned * wide + EDGE_M
    broad = float(tolerance.along(place.across)) + turned * magnet.half_span_m + EDGE_M
    v, u = _steps(magnet.half_span_m + long + BESIDE_M), _steps(wide + broad + BESIDE_M)
    assert heights.gray is not None
    gray, z_m = _look_up(place, heights, v, u)
    faces_z_m = plane.centre_z_m + math.tan(plane.pitch_rad) * v[:, None] + math.tan(plane.roll_rad) * u
    is_low = z_m < faces_z_m - DEEP_M
    load = (gray > 0) & ~is_low
    median = median_level(heights.gray)
    min_level = min(MIN_RATIO * median, MIN_LEVEL)
    labels = mark_labels(gray, load & (np.abs(u) <= wide + broad), min_level)
    for mask in plate_masks(gray, z_m, SIZE_M, min(PAPER_RATIO * median, WHITE_LEVEL)):
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
    """List places STEP_M apart to both sides of 0."""
    count = math.ceil(reach_m / STEP_M)
    return np.asarray(STEP_M * np.arange(-count, count + 1), np.float64)


def median_level(photo: UInt8) -> float:
    """Return the median gray level of the orthophoto (rows, columns): how brightly it is exposed; infinite
    where nothing was seen.
    """
    sampled = photo[::SAMPLED_EVERY, ::SAMPLED_EVERY]
    seen = sampled[sampled > 0]
    return float(np.median(seen)) if seen.size else math.inf


def mark_labels(gray: Float32, load: Bool, min_level: float = MIN_LEVEL) -> Bool:
    """Mark the cells (V, U) of labels: bright, and abruptly darker before and behind along the bars. A bright
    strap is marked too, and saturated steel on which a label wouldn't show.

    gray: levels, 0 where nothing was seen, which counts as dark. load: cells from which the load's usual
    level and its scatter are measured.
    """
    if not load.any():
        return np.zeros(gray.shape, np.bool_)
    level = np.log(gray + _DARK)
    mean = ndimage.uniform_filter1d(level, WIDTH_CELLS, axis=1)
    scatter = mad_sigma((mean - ndimage.uniform_filter1d(mean, AROUND_CELLS, axis=0))[load])
    edge = float(np.clip(EDGE_SIGMAS * scatter, *MIN_EDGE_LOG))
    needed = max(min(BRIGHTER_RATIO * float(np.median(gray[load])), FULL_LEVEL), min_level)
    bright = mean > np.log(needed + _DARK)
    marked = np.zeros(gray.shape, np.bool_)
    for length in LENGTH_CELLS:
        if length + 2 * _BESIDE > len(gray):
            break
        columns = _edge_logs(level, length)[0] > MIN_COLUMN_LOG
        wide = ndimage.binary_erosion(columns, np.ones((1, WIDTH_CELLS), np.bool_))
        edges, lowest = _edge_logs(mean, length)
        room = math.log(MAX_LEVEL + _DARK) - (lowest - edges)
        found = wide & (edges > np.clip(ROOM_RATIO * room, MIN_COLUMN_LOG, edge))
        found = ndimage.binary_dilation(found, np.ones((1, WIDTH_CELLS), np.bool_))
        for row in range(_BESIDE, _BESIDE + length):
            marked[row : row + len(found)] |= found
    white = ndimage.binary_opening(gray >= SATURATED_LEVEL, np.ones(WHITE_CELLS, np.bool_))
    return np.asarray((bright & marked) | white, np.bool_)


def _edge_logs(level: Float32, length: int) -> tuple[Float32, Float32]:
    """Compute the log ratio of the darkest of `length` steps to the bare bar before and behind, and that
    darkest level: (V - length - 2 _BESIDE + 1, U), for runs from step _BESIDE on.

    The bare bar's level comes from the second and third, or the third and fourth, step beyond the run, since
    a picture blurs an end over one or two steps.
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

    Levels are interpolated between the four nearest cells. Along slightly skewed bars the nearest cell jumps
    sideways from step to step, so that a bar's bright crest would seem to begin there.
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
