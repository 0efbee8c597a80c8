"""Tell straps from thin bars across a bundle: a strap is wider, and ends at the flanks in every picture.

On its bundle it hides the pattern of the bars over its width. A bar that lies across runs straight on beyond
a flank, as bright as on the crest, wherever what shows behind it has another gray level.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import islice
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from barsight.bundle_pictures.samples import (
    DARKEST,
    BundleWindow,
    PlacedFrames,
    WindowPicture,
    bundle_axes,
    is_hidden,
    is_placed,
    sample_windows,
)
from barsight.core.arrays import Bool, Float64
from barsight.core.linalg.robust import mad_sigma
from barsight.core.pose import Pose
from barsight.recording.rectified_pairs import RectifiedPairs
from barsight.yard.sections import part_about
from barsight.yard.thin_lines import SURE_STRENGTH, ThinLine, find_thin_lines
from barsight.yard.types import Bundle, DoubtKind, HeightMap, YardMap

_STEP_M, _ROW_M = 0.004, 0.003
"""Spacing of the samples across and along the bundle."""
_BESIDE_M, _ALONG_M = 0.13, 0.13
"""Reach (m) of a window beyond the flanks, and along the bundle to either side of a line."""
_FRAMES, _LINES = 4, 6
"""Number of nearest frames in which a line is looked at, and maximum number of lines on a bundle."""
_MAX_PIXEL_M = 0.007
"""Maximum size of the pictures' pixels on the bundle: in coarser ones bars are as wide and flat as straps."""
_MAX_ASKEW_DEG = 8.5
"""Maximum angle of a strap from the perpendicular, as the map's photo shows it."""
_NEAR_M, _BARE_M = 0.035, 0.045
"""Distance (m) along the bundle from a line's place within which its band is searched, and from which the
bars' own pattern is taken.
"""
_CREST_RATIO = 0.36
"""Part of the width, to either side of the axis, on which a band is measured."""
_HIDES, _MIN_BAND_M, _MAX_BAND_M = 0.5, 0.022, 0.034
"""Maximum share of the bars' pattern that shows through a band; limits of its width, of which samples add up
to 2 mm: steel strapping is up to 32 mm wide.
"""
_FLAT_ROWS, _MAX_RANGE_LOG = 3, 0.14
"""Number of rows to either side of a band's middle, and maximum range of the log gray level over them: a
strap is flat, and a round bar shaded.
"""
_MIN_PATTERN_LOG = 0.06
"""Minimum scatter, in log gray levels, of the bars' pattern on the crest."""
_RIM, _STEADY_QUANTILE, _STEADY = 4, 0.1, 0.7
"""Number of rows beside a band that aren't counted; share of the others on which less than the last of the
bars' pattern may show: on mottled steel it changes along the bars, and nothing tells where a band hides it.
"""
_FLANK_RATIO, _OFF_FLANK_M, _LOOKED_AT_M = 0.6, 0.012, 0.032
"""Depth of a flank under the top, in widths, to which it may show on the camera's side; distance beyond it
from which a bar is looked for, and over which.
"""
_SLOPES = np.linspace(-0.16, 0.16, 9)
"""Slopes at which a bar may go on beyond a flank."""
_MAX_SHOWN, _SHOWN, _SIGMAS = 0.4, 0.3, 2.0
"""Maximum brightness, relative to the crest's, of what goes on beyond a strap's end, including its sigmas;
what exceeds the second by as many sigmas shows a bar.
"""
_ROW_SIGMAS = math.sqrt(3.0)
"""Factor on the scatter of a mean, since neighbouring samples share their pixels."""
_MIN_PICTURES = 3
"""Minimum number of pictures in which a line must end at a flank."""


class _End(NamedTuple):
    """Share of a line's brightness on the crest that shows beyond a flank, and its sigma."""

    shown: float
    sigma: float


class _View(NamedTuple):
    """A line in one picture: width of the band that hides the bars (m), range of its log gray level over its
    middle, and its two ends.
    """

    band_m: float
    range_log: float
    low: _End
    high: _End


def tell_straps(
    pairs: RectifiedPairs, poses: Mapping[int, Pose], heights: YardMap, bundles: Sequence[Bundle]
) -> tuple[Bundle, ...]:
    """Note on each bundle the places of faint lines that are its straps by the pictures, and remove the doubt
    whether one is a bar where no other line crosses it. poses: as for `measure_from_pictures`.
    """
    frames = PlacedFrames.of(pairs.rectifier, poses)
    lines = [(k, line) for k, one in enumerate(bundles) for line in _faint_lines(one, heights)]
    windows = [
        at for n, (k, line) in enumerate(lines) for at in _line_windows(frames, n, bundles[k], line, heights)
    ]
    views = [list[_View]() for _ in lines]
    for place, picture in sample_windows(pairs, frames, windows):
        k, window = windows[place]
        if picture.is_sharp and picture.pixel_m <= _MAX_PIXEL_M:
            eyes = np.array([camera.map_from_rect.translation for camera in frames.cameras[k]])
            views[window.number].append(_look_at(picture, window, bundles[lines[window.number][0]], eyes))
    told = dict[int, list[float]]()
    for (k, line), seen in zip(lines, views, strict=True):
        if _is_strap(seen):
            told.setdefault(k, []).append(line.along_m)
    return tuple(
        _with_straps(one, tuple(told[k]), heights) if k in told else one for k, one in enumerate(bundles)
    )


def _with_straps(bundle: Bundle, told_m: tuple[float, ...], heights: YardMap) -> Bundle:
    """Return the bundle with these straps, without the doubt that they raised if no other line is left. A
    thin bar that may lie along it, of which no place is told, stays in doubt.
    """
    bundle = replace(bundle, straps_m=told_m)
    left = find_thin_lines(_part(heights, bundle), bundle)
    if left is None or left[0].excess_ratio >= 1:
        return bundle
    reasons, covers = (
        tuple(one for one in doubts if one.kind is not DoubtKind.FAINT_LINE or math.isnan(one.along_m))
        for doubts in (bundle.reasons, bundle.cover_doubts)
    )
    return replace(bundle, reasons=reasons, cover_doubts=covers)


def _faint_lines(bundle: Bundle, heights: YardMap) -> tuple[ThinLine, ...]:
    """List the lines across a bundle that may be straps, where one of them is a doubt."""
    if not is_placed(bundle) or not any(doubt.kind is DoubtKind.FAINT_LINE for doubt in bundle.reasons):
        return ()
    lines = [line for line in find_thin_lines(_part(heights, bundle), bundle) or () if line.excess_ratio >= 1]
    if len(lines) > _LINES:
        return ()
    return tuple(one for one in lines if one.strength < SURE_STRENGTH and abs(one.askew_deg) < _MAX_ASKEW_DEG)


def _line_windows(
    frames: PlacedFrames, number: int, bundle: Bundle, line: ThinLine, heights: YardMap
) -> Iterator[tuple[int, BundleWindow]]:
    """List windows about a line at the height of the top, with the nearest frames that show them whole and
    past everything higher.
    """
    along, across = bundle_axes(bundle)
    half = round((bundle.width_m / 2 + _BESIDE_M) / _STEP_M)
    beside = _STEP_M * np.arange(-half, half + 1.0)
    rows = _ROW_M * np.arange(-round(_ALONG_M / _ROW_M), round(_ALONG_M / _ROW_M) + 1.0)
    middle = np.append(bundle.centre_m[:2], bundle.top_z_m) + line.along_m * bundle.direction
    window = BundleWindow(number, middle + beside[:, None] * across, rows[:, None] * along)
    part = part_about(heights, window.corners_m[:, 0], window.corners_m[:, 1])

    def is_shown(k: int) -> bool:
        eyes = (camera.map_from_rect.translation for camera in frames.cameras[k])
        return not any(is_hidden(part, window.middle_m, eye) for eye in eyes)

    for k in islice(filter(is_shown, frames.all_nearest(window)), _FRAMES):
        yield k, window


def _look_at(picture: WindowPicture, window: BundleWindow, bundle: Bundle, eyes_m: Float64) -> _View:
    """Measure a line in one picture. eyes_m: (2, 3) the cameras of its frame."""
    level = np.log(picture.gray + DARKEST)
    along = _ROW_M * (np.arange(level.shape[0]) - (level.shape[0] - 1) / 2)
    beside = _STEP_M * (np.arange(level.shape[1]) - (level.shape[1] - 1) / 2)
    bars = np.median(level[np.abs(along) > _BARE_M], axis=0)
    crest = np.abs(beside) < _CREST_RATIO * bundle.width_m
    first, last = _band(level[:, crest], bars[crest], np.abs(along) < _NEAR_M)
    if last <= first:
        return _View(0.0, np.inf, _End(np.inf, 0.0), _End(np.inf, 0.0))
    middle = (first + last - 1) // 2
    row_m = float(along[middle])
    crest_level = float(np.median(level[max(middle - 2, 0) : middle + 3, crest]))
    centre = window.middle_m[len(window.middle_m) // 2]
    tilts = (eyes_m - centre)[:, :2] @ bundle_axes(bundle)[1][:2] / (eyes_m - centre)[:, 2]
    ends = []
    for side in (-1, 1):
        flank = bundle.width_m * (0.5 + _FLANK_RATIO * max(0.0, float((side * tilts).max()))) + _OFF_FLANK_M
        there = (side * beside >= flank) & (side * beside < flank + _LOOKED_AT_M)
        if not there.any():
            return _View(0.0, np.inf, _End(np.inf, 0.0), _End(np.inf, 0.0))
        ends.append(_end(level[:, there], beside[there], along, row_m, crest_level))
    flat = np.ptp(level[max(middle - _FLAT_ROWS, 0) : middle + _FLAT_ROWS + 1, crest].mean(axis=1))
    return _View(_ROW_M * (last - first), float(flat), ends[0], ends[1])


def _band(level: Float64, bars: Float64, near: Bool) -> tuple[int, int]:
    """Find the rows, first and one past the last, on which the bars' pattern hardly shows: the band about the
    place near the line where it shows least.

    level: (rows, places) on the crest; bars: (places,) away from the line.
    """
    pattern = bars - bars.mean()
    if float(np.sqrt(np.mean(pattern**2))) < _MIN_PATTERN_LOG:
        return 0, 0
    smooth = ndimage.uniform_filter1d(level, 3, axis=0)
    shown = (smooth - smooth.mean(axis=1, keepdims=True)) @ pattern / (pattern**2).sum()
    least = int(np.argmin(np.where(near, ndimage.uniform_filter1d(shown, 7), np.inf)))
    runs, _ = ndimage.label(shown < _HIDES)
    if runs[least] == 0:
        return 0, 0
    rows = np.flatnonzero(runs == runs[least])
    away = np.ones(shown.size, bool)
    away[max(rows[0] - _RIM, 0) : rows[-1] + 1 + _RIM] = False
    if not away.any() or np.quantile(shown[away], _STEADY_QUANTILE) < _STEADY:
        return 0, 0
    return int(rows[0]), int(rows[-1]) + 1


def _end(level: Float64, beside: Float64, along: Float64, row_m: float, crest_level: float) -> _End:
    """Measure how much of a line shows beyond a flank: the most over all slopes. level: (rows, places)."""
    most = _End(-np.inf, 0.0)
    for slope in _SLOPES:
        rows = np.stack(
            [np.interp(along + slope * u, along, level[:, k]) for k, u in enumerate(beside)], axis=1
        )
        away = np.abs(along - row_m) > _BARE_M
        behind = np.median(rows[away], axis=0)
        off = ndimage.uniform_filter1d(rows - behind, 5, axis=0)
        own = off[int(np.argmin(np.abs(along - row_m)))]
        expected = crest_level - behind
        power = max(float((expected**2).sum()), 1e-9)
        scatter = mad_sigma(off[away], axis=0) + 0.01
        sigma = _ROW_SIGMAS * math.sqrt(float((scatter**2 * expected**2).sum())) / power
        most = max(most, _End(float(own @ expected) / power, sigma))
    return most


def _is_strap(views: Sequence[_View]) -> bool:
    """Check whether the pictures show a strap: a flat band as wide as one, and no bar beyond either flank."""
    if len(views) < _MIN_PICTURES:
        return False
    if not _MIN_BAND_M <= np.median([one.band_m for one in views]) <= _MAX_BAND_M:
        return False
    if np.median([one.range_log for one in views]) > _MAX_RANGE_LOG:
        return False
    for ends in ([one.low for one in views], [one.high for one in views]):
        if any(one.shown - _SIGMAS * one.sigma > _SHOWN for one in ends):
            return False
        if sum(one.shown + _SIGMAS * one.sigma < _MAX_SHOWN for one in ends) < _MIN_PICTURES:
            return False
    return True


def _part(heights: YardMap, bundle: Bundle) -> HeightMap:
    """Read the part of the map in which lines across a bundle are searched."""
    x, y = bundle.corners_m.T
    return part_about(
        heights, np.array([x.min() - 1.0, x.max() + 1.0]), np.array([y.min() - 1.0, y.max() + 1.0])
    )
