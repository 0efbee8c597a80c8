"""Find where the straps of a bundle end in the pictures: at its flanks, where they turn out of sight.

A strap is a line across the bars that is darker or brighter than the steel on both sides of it. It is
followed from the middle of the bundle to either side, in the horizontal plane at half the bundle's height:
there a round bundle is as wide as its outline in the picture, from any viewpoint.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from barsight.bundle_pictures.samples import (
    DARKEST,
    BundleWindow,
    PlacedFrames,
    WindowPicture,
    is_hidden,
    is_placed,
    windows_along,
)
from barsight.core.arrays import Bool, Float64, UInt8
from barsight.yard.bundles.section.straps import APART_M, DENSE_M, strongest_lines
from barsight.yard.placement.load import is_one_bar
from barsight.yard.sections import part_about
from barsight.yard.types import Bundle, YardMap

_STEP_M, _ROW_M = 0.004, 0.008
"""Sample spacing across and along a bundle."""
REACH_M = 0.22
"""Search distance beyond the flanks that the map shows."""
_OUTSIDE_M = 0.01
"""Distance from a flank to the line beside it that must be visible."""
_OVERHEAD = 0.05
"""Maximum horizontal over vertical component of a line of sight that passes whatever stands beside a
bundle.
"""
_AROUND_M, _STRAP_ROWS = 0.4, 3
"""Length along the bars over which the steel's own gray level is averaged, and number of rows that a strap
covers.
"""
_SCATTER_LOG, _MIN_SCATTER_LOG, _SCATTER_M = 0.3, 0.03, 0.06
"""Maximum and minimum scatter of the logarithmic gray levels along a bar, and the width across over which the
scatter is averaged.
"""
_CLIPPED, _STRAP, _SEEN = 6.0, 1.5, 1.2
"""Contrasts over noise: the value at which they are clipped, the minimum mean of a strap over the bundle's
middle, and the minimum at which a single sample of it counts as visible.
"""
_MIDDLE_RATIO, _MIN_MIDDLE_M = 0.3, 0.03
"""Half width of the middle in which straps are searched, as a share of the width, and its minimum."""
_SMOOTH_M, _END_RATIO = 0.02, 0.5
"""A strap ends where its contrast, averaged over this width, falls below this share of the contrast in the
middle.
"""
_GULLY_BARS, _MIN_GULLY_M = 0.45, 0.016
"""Maximum width of a gap in a strap at a gully between two bars, in bar diameters, and at least."""
_LINE_M = 0.0015
"""Distance by which a strap shows beyond the bundle, due to its thickness and blur."""


class StrapEnds(NamedTuple):
    """Ends of one strap in one picture: along the bundle from its middle, and beside its axis, m.

    NaN where the strap continues to the window's border. contrast: over noise, in the middle. pixel_m: size
    of the picture's pixels there.
    """

    along_m: float
    low_m: float
    high_m: float
    contrast: float
    pixel_m: float


def strap_windows(
    frames: PlacedFrames, preferred: Collection[int], heights: YardMap, bundles: Sequence[Bundle]
) -> Iterator[tuple[int, BundleWindow]]:
    """List windows along each free bundle that straps may hold, with the nearest frames over them.

    Frames in `preferred` come first. Windows are left out where something higher may hide the flank on the
    camera's side.
    """
    for number, bundle in enumerate(bundles):
        is_long = is_placed(bundle) and bundle.length_m > 2 * APART_M
        if not (bundle.is_free and is_long) or is_one_bar(bundle):
            continue
        half = bundle.width_m / 2 + REACH_M
        beside, axis_z_m = np.arange(-half, half, _STEP_M), bundle.top_z_m - bundle.width_m / 2
        for window in windows_along(number, bundle, beside, axis_z_m, _ROW_M):
            k = frames.nearest(window, preferred)
            if k is not None and not _hides_flank(frames, k, window, heights):
                yield k, window


def _hides_flank(frames: PlacedFrames, k: int, window: BundleWindow, heights: YardMap) -> bool:
    """Check whether something higher beside a bundle hides its flank from a frame's camera."""
    tilt = view_tilt(frames, k, window)
    if abs(tilt) < _OVERHEAD:
        return False
    inwards = window.middle_m[-1] - window.middle_m[0]
    inwards *= -np.sign(tilt) * (REACH_M - _OUTSIDE_M) / np.linalg.norm(inwards)
    flank = window.middle_m[0 if tilt < 0 else -1] + inwards
    part = part_about(heights, window.corners_m[:, 0], window.corners_m[:, 1])
    eyes = (camera.map_from_rect.translation for camera in frames.cameras[k])
    return any(is_hidden(part, flank + window.rows_m, eye) for eye in eyes)


def view_tilt(frames: PlacedFrames, k: int, window: BundleWindow) -> float:
    """Compute the horizontal over vertical component, across a bundle, of a frame's lines of sight: of the
    camera that looks more obliquely.
    """
    middle = window.middle_m[len(window.middle_m) // 2]
    across = window.middle_m[-1] - window.middle_m[0]
    away = [camera.map_from_rect.translation - middle for camera in frames.cameras[k]]
    tilts = [float(one @ across / np.linalg.norm(across) / one[2]) for one in away]
    return max(tilts, key=abs)


def find_straps(picture: WindowPicture, window: BundleWindow, bundle: Bundle) -> list[StrapEnds]:
    """Find the straps in a window of a bundle, and where each ends."""
    contrast = _contrast(picture.gray)
    beside = _STEP_M * (np.arange(contrast.shape[1]) - (contrast.shape[1] - 1) / 2)
    middle = np.abs(beside) < max(_MIDDLE_RATIO * bundle.width_m, _MIN_MIDDLE_M)
    strength = contrast[:, middle].mean(axis=1)
    bridged = round(max(_MIN_GULLY_M, _GULLY_BARS * np.nan_to_num(bundle.bar_diameter_m)) / _STEP_M)
    found = []
    for row in _strap_rows(strength):
        near = contrast[max(row - 2, 0) : row + 3] * np.sign(strength[row])
        line = ndimage.uniform_filter1d(near, round(_SMOOTH_M / _STEP_M), axis=1).max(axis=0)
        level = float(np.median(line[middle]))
        seen = line > max(_END_RATIO * level, _SEEN)
        half = seen.size // 2
        ends = (_end(part, bridged) for part in (seen[half::-1], seen[half:]))
        low, high = (np.nan if k is None else _STEP_M * (k + 0.5) - _LINE_M for k in ends)
        along = float(np.linalg.norm(window.rows_m[row]) * np.sign(window.rows_m[row] @ bundle.direction))
        sides = float(beside[half] - low), float(beside[half] + high)
        found.append(StrapEnds(along, *sides, level, picture.pixel_m))
    return found


def _contrast(gray: UInt8) -> Float64:
    """Compute the contrast of each sample (R, N) with the steel on both sides along the bar, over the bar's
    scatter.

    It is the logarithm of the gray level less its mean along the bar, averaged over a strap's rows.
    """
    level = np.log(gray + DARKEST)
    around = 2 * round(_AROUND_M / _ROW_M / 2) + 1
    off = level - ndimage.uniform_filter1d(level, around, axis=0, mode="nearest")
    off = ndimage.uniform_filter1d(off, _STRAP_ROWS, axis=0)
    scatter = np.sqrt(np.pi / 2) * np.minimum(np.abs(off), _SCATTER_LOG).mean(axis=0)
    scatter = ndimage.uniform_filter1d(np.maximum(scatter, _MIN_SCATTER_LOG), round(_SCATTER_M / _STEP_M))
    return np.asarray(np.clip(off / scatter, -_CLIPPED, _CLIPPED))


def _strap_rows(strength: Float64) -> list[int]:
    """Choose the rows (R,) with the strongest lines, at least APART_M apart."""
    lines = np.flatnonzero(np.abs(strength) >= _STRAP)
    rows = strongest_lines(np.abs(strength[lines]), lines, math.ceil(APART_M / _ROW_M))
    return [int(row) for row in rows[: max(int(strength.size * _ROW_M / DENSE_M), 2)]]


def _end(seen: Bool, bridged: int) -> int | None:
    """Follow a strap outwards to the last visible sample before more than `bridged` hidden ones; None if it
    is visible to the end.
    """
    last = 0
    for k in np.flatnonzero(seen).tolist():
        if k - last > bridged + 1:
            return last
        last = k
    return last if seen.size - 1 - last > bridged else None
