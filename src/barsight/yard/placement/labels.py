"""Find labels on the load in the orthophoto: bright plates that, though thin, hold the faces off the bars."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from barsight.core.arrays import Bool, Float32, Float64, UInt8
from barsight.core.linalg.robust import mad_sigma
from barsight.core.records.heights import HeightSource
from barsight.yard.label_settings import LabelSettings
from barsight.yard.lift_settings import LiftSettings
from barsight.yard.magnet.contact import Contact, FaceHeights
from barsight.yard.magnet.description import Magnet
from barsight.yard.magnet.footprint import Placement
from barsight.yard.magnet.resting_plane import SEGMENT_M
from barsight.yard.map_lookup import SATURATED_LEVEL, nearest_cells, sample_levels
from barsight.yard.placement.clearance import FacePlane
from barsight.yard.plates import STEP_M, WHITE_LEVEL, plate_masks
from barsight.yard.types import HeightMap

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
_NEAR, _EDGE = round(SEGMENT_M / 2 / STEP_M), round(EDGE_M / STEP_M)
"""Number of steps along and across around a label whose median heights along the bars are the steel's."""
_BESIDE = 4
"""Number of steps before and behind a label that are read."""
_DARK = 10.0
"""Level added to both levels of a ratio, since ratios of very dark levels mean nothing."""


@dataclass(frozen=True)
class SeenLabel:
    """Rectangle of a label, or of another bright plate, as it shows: its middle (yard axes, m), half of its
    length along the beam and of its width across; heights of the steel under it, and of itself as mapped.
    """

    x_m: float
    y_m: float
    half_along_m: float
    half_across_m: float
    steel_z_m: float
    own_z_m: float

    def place_under(self, place: Placement) -> tuple[float, float]:
        """Return how far (m) along and across the beam its middle is from the magnet's."""
        along, across = place.beam_axes @ (self.x_m - place.x_m, self.y_m - place.y_m)
        return float(along), float(across)


def rests_on_label(
    label: SeenLabel, place: Placement, faces: FaceHeights, bare: Contact, magnet: Magnet,
    settings: LiftSettings,
) -> Iterator[Contact]:  # fmt: skip
    """Yield how the faces rest where a label is under them, for each part that may bear them; none for a part
    below all that they touch where they are bare.
    """
    top_z_m = max(label.steel_z_m + settings.label_m, label.own_z_m)
    (plane,) = FacePlane.of(bare).table
    for part in _bearing_parts(label, place, magnet):
        plate = np.column_stack([part, np.full(len(part), top_z_m)])
        if (plane[0] + part @ plane[1:] - top_z_m <= bare.touch_gap_m).any():
            yield faces.rest(magnet, settings.contact_gap_m, plate)


def _bearing_parts(label: SeenLabel, place: Placement, magnet: Magnet) -> Iterator[Float64]:
    """Yield the corners (N, 2), along and across, of what shows of a label under a face; then the middle of
    each column of it, and of those up to EDGE_M beside it.
    """
    middle, half = np.array(label.place_under(place)), np.array([label.half_along_m, label.half_across_m])
    for pole in magnet.pole_table:
        low, high = pole[:2] - pole[2:] / 2, pole[:2] + pole[2:] / 2
        first, last = np.maximum(middle - half, low), np.minimum(middle + half, high)
        if (first < last).all():
            yield np.array(list(itertools.product(*zip(first, last, strict=True))))
        first, last = np.maximum(middle - half - EDGE_M, low), np.minimum(middle + half + EDGE_M, high)
        if (first < last).all():
            for column in np.linspace(first[1], last[1], math.ceil((last[1] - first[1]) / STEP_M) + 1):
                yield np.array([[(first[0] + last[0]) / 2, column]])


def find_labels(
    place: Placement, heights: HeightMap, magnet: Magnet, plane: FacePlane
) -> tuple[SeenLabel, ...]:
    """Find the labels that may come under a face within the crane's tolerance, and are nearly as high as the
    faces; none without an orthophoto.
    """
    if heights.gray is None:
        return ()
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
    median = median_level(heights.gray)
    min_level = min(MIN_RATIO * median, MIN_LEVEL)
    labels = mark_labels(gray, load & (np.abs(u) <= wide + broad), min_level)
    for mask in plate_masks(gray, z_m, SIZE_M, min(PAPER_RATIO * median, WHITE_LEVEL), unknown_rise_m=0.0):
        labels |= mask
    labels &= ~is_low
    under = np.zeros(gray.shape, np.bool_)
    for along, across, length, width in poles:
        rows = np.abs(v - along) <= length / 2 + long
        under |= rows[:, None] & (np.abs(u - across) <= width / 2 + broad)
    # A gap of two cells parts no label.
    numbers, _ = ndimage.label(ndimage.binary_dilation(labels, np.ones((3, 3), np.bool_)), np.ones((3, 3)))
    found = []
    for number in np.unique(numbers[under & labels]):
        at = np.argwhere((numbers == number) & labels)
        (top, left), (bottom, right) = at.min(axis=0), at.max(axis=0)
        x_m, y_m = (v[top] + v[bottom], u[left] + u[right]) @ place.beam_axes / 2 + (place.x_m, place.y_m)
        half_along, half_across = STEP_M / 2 * (bottom - top + 1), STEP_M / 2 * (right - left + 1)
        about = z_m[max(top - _NEAR, 0) : bottom + _NEAR + 1, max(left - _EDGE, 0) : right + _EDGE + 1]
        steel_z_m = _highest(about, float(faces_z_m[top, left]))
        own_z_m = _highest(z_m[top : bottom + 1, left : right + 1], steel_z_m)
        half_m = float(half_along), float(half_across)
        found.append(SeenLabel(float(x_m), float(y_m), *half_m, steel_z_m, own_z_m))
    return tuple(found)


def _highest(z_m: Float32, unseen_m: float) -> float:
    """Find the highest of the columns' medians (V, U) along the bars; `unseen_m` where none is known."""
    seen = z_m[:, np.isfinite(z_m).any(axis=0)]
    return float(np.nanmedian(seen, axis=0).max()) if seen.size else unseen_m


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
    for length in LENGTH_CELLS if bright.any() else ():
        if length + 2 * _BESIDE > len(gray):
            break
        columns = _edge_logs(level, length)[0] > MIN_COLUMN_LOG
        edges, lowest = _edge_logs(mean, length)
        room = math.log(MAX_LEVEL + _DARK) - (lowest - edges)
        abrupt = edges > np.clip(ROOM_RATIO * room, MIN_COLUMN_LOG, edge)
        count = columns.shape[1] - WIDTH_CELLS + 1
        beside = [columns[:, k : k + count] for k in range(WIDTH_CELLS)]
        middle = WIDTH_CELLS // 2
        found = np.logical_and.reduce([*beside, abrupt[:, middle : middle + count]])
        if not found.any():
            continue
        for row, k in itertools.product(range(_BESIDE, _BESIDE + length), range(WIDTH_CELLS)):
            marked[row : row + len(found), k : k + count] |= found
    white = gray >= SATURATED_LEVEL
    if white.any():
        white = ndimage.binary_opening(white, np.ones(WHITE_CELLS, np.bool_))
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
    """Look up gray levels and heights (V, U) at places along and across; 0 and NaN where nothing was seen,
    or a height was filled in.

    Levels are interpolated between the four nearest cells. Along slightly skewed bars the nearest cell jumps
    sideways from step to step, so that a bar's bright crest would seem to begin there.
    """
    x = place.x_m + v[:, None] * place.along[0] + u * place.across[0]
    y = place.y_m + v[:, None] * place.along[1] + u * place.across[1]
    column, row, inside = nearest_cells(heights, x, y)
    assert heights.gray is not None
    nearest = np.where(inside, heights.gray[row, column], 0).astype(np.float32)
    between = sample_levels(heights, heights.gray, x, y)
    seen = inside & ~np.isin(heights.source[row, column], (HeightSource.UNKNOWN, HeightSource.FILLED))
    return (
        np.where(np.isfinite(between), between, nearest),
        np.where(seen, heights.z_m[row, column], np.float32(np.nan)),
    )
