"""Find how far the straps of a bundle go on in the pictures: to its flanks, where they turn out of sight.

A strap is a line across the bars, darker or brighter than the steel before and after it. It is followed from
the middle of the bundle to either side over a round section, and beside it on the level plane at half its
height: there a round bundle is as wide as its outline in the picture, whatever the view.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence
from itertools import pairwise
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
)
from barsight.core.arrays import Float64, UInt8
from barsight.yard.bundles.section.straps import APART_M, DENSE_M, strongest_lines
from barsight.yard.lifting.load import is_one_bar
from barsight.yard.sections import part_about
from barsight.yard.types import Bundle, YardMap

STEP_M, _ROW_M = 0.004, 0.008
"""Way between two places across a bundle, and along it."""
REACH_M = 0.22
"""Search reach beyond the flanks of a bundle as the map tells it."""
_OUTSIDE_M = 0.01
"""Way from a flank to the line beside it that must be in sight."""
_OVERHEAD = 0.05
"""Way aside over height: a line of sight that leads less far aside passes what stands beside a bundle."""
_WINDOW_M = 3.0
"""Greatest length of a window: one picture shows it whole."""
_AROUND_M, _STRAP_ROWS = 0.4, 3
"""Length along the bars over which the steel's own gray level is taken, and rows that a strap covers."""
_SCATTER_LOG, _MIN_SCATTER_LOG, _SCATTER_M = 0.3, 0.03, 0.06
"""Of the logarithm of gray levels along a bar: the most that counts for its scatter, the least scatter, and
over how far across it is averaged."""
_CLIPPED, _STRAP = 6.0, 1.5
"""Contrasts over noise, and log-likelihood ratios: from where more counts no more. Least mean of a strap's
contrast over the middle."""
_MIDDLE_RATIO, _MIN_MIDDLE_M = 0.3, 0.03
"""Of the width, to either side, and at least: the middle, where straps are looked for."""
_ALIKE = 5
"""Places across that share their pixels, and so their evidence."""
_SLOPES = np.arange(-4, 5) * 0.025
"""Of a strap, from square to the bundle's axis."""


class Strap(NamedTuple):
    """One strap in one picture: m along the bundle from its middle; log-likelihood ratios (N,), summed from
    the axis outwards at places STEP_M apart on the low and on the high side, that the strap shows up to there
    rather than steel alone; size of the picture's pixels there.
    """

    along_m: float
    low: Float64
    high: Float64
    pixel_m: float


def strap_windows(
    frames: PlacedFrames, among: Collection[int], heights: YardMap, bundles: Sequence[Bundle]
) -> Iterator[tuple[int, BundleWindow]]:
    """List windows along each free bundle that straps may hold, with the frames nearest over them, of those
    in `among` where one has it; none where what stands higher may hide the flank on the camera's side.
    """
    for number, bundle in enumerate(bundles):
        for window in _windows(number, bundle) if bundle.is_free and not is_one_bar(bundle) else ():
            k = frames.nearest(window, among)
            k = frames.nearest(window) if k is None else k
            if k is not None and not _hides_flank(frames, k, window, heights):
                yield k, window


def _hides_flank(frames: PlacedFrames, k: int, window: BundleWindow, heights: YardMap) -> bool:
    """Check whether what stands higher beside a bundle hides its flank from a frame's camera."""
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
    """Compute how far across a bundle a frame's lines of sight lead, over their height: of the camera that
    looks from further aside.
    """
    middle = window.middle_m[len(window.middle_m) // 2]
    across = window.middle_m[-1] - window.middle_m[0]
    away = [camera.map_from_rect.translation - middle for camera in frames.cameras[k]]
    tilts = [float(one @ across / np.linalg.norm(across) / one[2]) for one in away]
    return max(tilts, key=abs)


def _windows(number: int, bundle: Bundle) -> Iterator[BundleWindow]:
    """Divide a bundle's length into windows that reach beyond its flanks."""
    if not (np.isfinite(bundle.centre_m).all() and bundle.width_m > 0 and bundle.length_m > 2 * APART_M):
        return
    along, across = bundle_axes(bundle)
    half = round((bundle.width_m / 2 + REACH_M) / STEP_M)
    beside = STEP_M * np.arange(-half, half + 1)
    inner = np.minimum(np.abs(beside) / (bundle.width_m / 2), 1)
    fall = bundle.width_m / 2 * (1 - np.sqrt(1 - inner**2))
    middle = np.append(bundle.centre_m[:2], bundle.top_z_m) - fall[:, None] * [0.0, 0.0, 1.0]
    edges = np.linspace(-0.5, 0.5, int(bundle.length_m / _WINDOW_M) + 2) * bundle.length_m
    for low, high in pairwise(edges.tolist()):
        rows = np.arange(low, high, _ROW_M)[:, None] * along
        yield BundleWindow(number, middle + beside[:, None] * across, rows)


def find_straps(picture: WindowPicture, window: BundleWindow, bundle: Bundle) -> list[Strap]:
    """Find the straps in a window of a bundle, and how far each goes on."""
    contrast = _contrast(picture.gray)
    half = contrast.shape[1] // 2
    beside = STEP_M * np.arange(-half, half + 1)
    middle = np.abs(beside) < max(_MIDDLE_RATIO * bundle.width_m, _MIN_MIDDLE_M)
    found = []
    for row in _strap_rows(contrast[:, middle].mean(axis=1)):
        rows = np.rint(row + _SLOPES[:, None] * beside / _ROW_M).astype(np.int64)
        lines = contrast[np.clip(rows, 0, len(contrast) - 1), np.arange(beside.size)]
        ratios = [_strap_ratios(line, float(np.median(line[middle]))) for line in lines]
        ratio = max(ratios, key=lambda one: float(one[middle].sum()))
        along = float(np.linalg.norm(window.rows_m[row]) * np.sign(window.rows_m[row] @ bundle.direction))
        low, high = (np.cumsum(part) for part in (ratio[half::-1], ratio[half:]))
        found.append(Strap(along, low, high, picture.pixel_m))
    return found


def _strap_ratios(contrast: Float64, level: float) -> Float64:
    """Compute log-likelihood ratios (N,) of contrasts c, a strap's to steel's: c level - level^2 / 2."""
    return np.asarray(np.clip(contrast * level - level**2 / 2, -_CLIPPED, _CLIPPED) / _ALIKE)


def _contrast(gray: UInt8) -> Float64:
    """Compute how much each place (R, N) differs from the steel before and after it, over a bar's own
    scatter: the logarithm of gray levels less its mean along the bar, averaged over a strap's rows.
    """
    level = np.log(gray + DARKEST)
    around = 2 * round(_AROUND_M / _ROW_M / 2) + 1
    off = level - ndimage.uniform_filter1d(level, around, axis=0, mode="nearest")
    off = ndimage.uniform_filter1d(off, _STRAP_ROWS, axis=0)
    scatter = np.sqrt(np.pi / 2) * np.minimum(np.abs(off), _SCATTER_LOG).mean(axis=0)
    scatter = ndimage.uniform_filter1d(np.maximum(scatter, _MIN_SCATTER_LOG), round(_SCATTER_M / STEP_M))
    return np.asarray(np.clip(off / scatter, -_CLIPPED, _CLIPPED))


def _strap_rows(strength: Float64) -> list[int]:
    """Choose the rows (R,) with the strongest lines, APART_M from each other."""
    lines = np.flatnonzero(np.abs(strength) >= _STRAP)
    rows = strongest_lines(np.abs(strength[lines]), lines, math.ceil(APART_M / _ROW_M))
    return [int(row) for row in rows[: max(int(strength.size * _ROW_M / DENSE_M), 2)]]
