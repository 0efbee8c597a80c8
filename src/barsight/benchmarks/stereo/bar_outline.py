"""Locate a straight outline of a round bar in an image, to a fraction of a pixel.

The outline of a round bar is not a step edge: shading falls towards the limb like cos(angle), whose slope is
infinite there. The whole profile across the outline is therefore fitted, stretch by stretch along the bar:
floor b0 + b1 x outside, c0 + c1 cos(angle) + c2 sin(angle) inside (matt shading under any lamp), both blurred
by the lens. The outline is the straight line with the highest likelihood over all stretches.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.interpolate import CubicSpline

from barsight.core.arrays import Float64, UInt8, kernel
from barsight.core.errors import Failed

_STRETCH_PX = 16
_LENS_SIGMA_PX = 0.45
_FINE_PX = 0.02
_MIN_STRETCHES = 6
_PARTS = 5


@dataclass(frozen=True, eq=False)
class OutlineSearch:
    """Search window. reach_px: largest distance from the line at which the outline is searched for, in
    steps of step_px. outside_px, inside_px: extent of the profile beyond that, over the floor and over the
    bar.
    """

    reach_px: float
    step_px: float
    outside_px: float
    inside_px: float

    @property
    def shifts_px(self) -> Float64:
        return np.arange(-self.reach_px, self.reach_px + self.step_px / 2, self.step_px)


def find_outline(image: UInt8, line: Float64, radius_px: float, search: OutlineSearch) -> Float64 | Failed:
    """Find two points x, y (2, 2) of the outline near a x + b y + c = 0 (unit normal towards the bar).

    radius_px: approximate radius of the bar in the image. Failed `no-outline` if too little of it lies in the
    image.
    """
    stretches = _stretches(image, line, radius_px, search)
    if len(stretches.place_px) < _MIN_STRETCHES:
        return Failed(
            "no-outline", f"only {len(stretches.place_px)} stretches of an outline lie in the image"
        )
    return _best_line(stretches, line)


@dataclass(frozen=True, eq=False)
class _Stretches:
    """Fits of the stretches. place_px: (N,) their centres along the line, from its foot. misfit: (N, S)
    result of `_misfits` with the outline shifted by each of shifts_px (S,) towards the bar.
    """

    place_px: Float64
    shifts_px: Float64
    misfit: Float64


def _stretches(image: UInt8, line: Float64, radius_px: float, search: OutlineSearch) -> _Stretches:
    """Divide the line into stretches and compute the misfits of those whose profiles lie in the image."""
    height, width = image.shape
    margin = search.reach_px + max(search.outside_px, search.inside_px) + 1
    foot, along = _foot_and_direction(line)
    basis = _basis(radius_px, math.ceil(2 * search.reach_px + max(search.outside_px, search.inside_px)) + 1)
    offsets = np.arange(_STRETCH_PX) - (_STRETCH_PX - 1) / 2
    middle = round(float((np.array([(width - 1) / 2, (height - 1) / 2]) - foot) @ along))
    reach = math.ceil(math.hypot(height, width) / _STRETCH_PX) * _STRETCH_PX
    shifts = search.shifts_px
    places, misfits = [], []
    for place in range(middle - reach, middle + reach, _STRETCH_PX):
        core = foot + (place + offsets)[:, None] * along
        if (core > margin).all() and (core < np.array([width, height]) - 1 - margin).all():
            gray, away = _profile(image, core, line, search)
            misfit = np.empty(len(shifts))
            _misfits(gray, away, shifts, basis, misfit)
            misfits.append(misfit)
            places.append(place)
    together = np.array(misfits).reshape(len(places), len(shifts))
    return _Stretches(np.array(places, dtype=np.float64), shifts, together)


def _foot_and_direction(line: Float64) -> tuple[Float64, Float64]:
    return -line[2] * line[:2], np.array([-line[1], line[0]])


def _profile(image: UInt8, core: Float64, line: Float64, search: OutlineSearch) -> tuple[Float64, Float64]:
    """Sample pixels beside a stretch: gray values and distances from the line, px, positive on the bar."""
    across = np.arange(-search.reach_px - search.outside_px, search.reach_px + search.inside_px + 0.5, 1.0)
    columns = np.rint(core[:, :1] + across * line[0]).astype(np.intp)
    rows = np.rint(core[:, 1:] + across * line[1]).astype(np.intp)
    unique = np.unique(rows * image.shape[1] + columns)
    rows, columns = unique // image.shape[1], unique % image.shape[1]
    return image[rows, columns].astype(np.float64), line[0] * columns + line[1] * rows + line[2]


def _best_line(stretches: _Stretches, line: Float64) -> Float64:
    """Fit two points (2, 2) of the outline: shift and rotate the line to the lowest total misfit."""
    place = stretches.place_px
    centre, half = (place.max() + place.min()) / 2, max((place.max() - place.min()) / 2, 1.0)
    along = (place - centre) / half
    curves = [CubicSpline(stretches.shifts_px, misfit) for misfit in stretches.misfit]
    shift, turn = 0.0, 0.0
    reach = float(stretches.shifts_px[-1])
    for step in (reach / 20, reach / 80, reach / 320):
        shifts = shift + np.arange(-reach, reach + step / 2, step)
        turns = turn + np.arange(-reach, reach + step / 2, step)
        total = _total_misfit(stretches, curves, along, shifts, turns)
        row, column = np.unravel_index(int(total.argmin()), total.shape)
        shift, turn = float(shifts[row]), float(turns[column])
        reach = 8 * step
    foot, direction = _foot_and_direction(line)
    ends = np.array([-1.0, 1.0])
    points: Float64 = (
        foot + (centre + half * ends)[:, None] * direction + (shift + turn * ends)[:, None] * line[:2]
    )
    return points


def _total_misfit(
    stretches: _Stretches, curves: list[CubicSpline], along: Float64, shifts: Float64, turns: Float64
) -> Float64:
    """Sum the stretches' misfits (len(shifts), len(turns)), interpolated from their curves; outside the
    search window each counts with its worst value.
    """
    total = np.zeros((len(shifts), len(turns)))
    low, high = stretches.shifts_px[[0, -1]]
    for where, curve, worst in zip(along, curves, stretches.misfit.max(axis=1), strict=True):
        outline = shifts[:, None] + turns[None, :] * where
        inside = (outline >= low) & (outline <= high)
        total += np.where(inside, curve(outline.clip(low, high)), worst)
    return total


def _basis(radius_px: float, half_px: float) -> Float64:
    """Build the profile's basis (M, 5), blurred by the lens, on a fine grid from -half_px to half_px: 1
    and x for the floor; 1, cos and sin for the bar.
    """
    margin = 4 * _LENS_SIGMA_PX
    half = half_px + margin
    x = np.arange(-half, half + _FINE_PX / 2, _FINE_PX)
    outside = 1 / (1 + np.exp(np.clip(x / (_FINE_PX / 4), -60, 60)))
    sine = (1 - x / radius_px).clip(-1, 1)
    cosine = np.sqrt(1 - sine * sine)
    inside = 1 - outside
    parts = np.column_stack([outside, outside * x / half_px, inside, inside * cosine, inside * (1 - sine)])
    blurred = cv2.GaussianBlur(
        parts, (1, 2 * round(margin / _FINE_PX) + 1), sigmaX=1e-9, sigmaY=_LENS_SIGMA_PX / _FINE_PX
    )
    cut = round(margin / _FINE_PX)
    result: Float64 = blurred[cut : len(x) - cut]
    return result


@kernel()
def _misfits(gray: Float64, away: Float64, shifts: Float64, basis: Float64, misfit: Float64) -> None:
    """Compute the profile's negative log-likelihood per pixel, with the outline at each shift.

    Floor and bar differ in texture and so have separate variances; the set of pixels is the same for all
    shifts. gray, away: (N,) gray values and distances from the line, px. shifts: (S,) px. basis: (M, 5), see
    `_basis`. Fills misfit (S,).
    """
    half = (basis.shape[0] - 1) * _FINE_PX / 2
    size = gray.shape[0]
    for turn in range(shifts.shape[0]):
        design = np.empty((size, _PARTS))
        for pixel in range(size):
            place = (min(max(away[pixel] - shifts[turn], -half), half) + half) / _FINE_PX
            index = min(int(place), basis.shape[0] - 2)
            part = place - index
            for one in range(_PARTS):
                design[pixel, one] = basis[index, one] * (1 - part) + basis[index + 1, one] * part
        bar_variance, floor_variance = 1.0, 1.0
        for _ in range(2):
            fitted = _solve(design, gray, bar_variance, floor_variance)
            bar, bar_squares, floor_squares = 0.0, 0.0, 0.0
            for pixel in range(size):
                away_from_fit = gray[pixel]
                for one in range(_PARTS):
                    away_from_fit -= design[pixel, one] * fitted[one]
                share = design[pixel, 2]
                bar += share
                bar_squares += share * away_from_fit * away_from_fit
                floor_squares += (1 - share) * away_from_fit * away_from_fit
            bar_variance = bar_squares / max(bar, 1e-9) + 0.25
            floor_variance = floor_squares / max(size - bar, 1e-9) + 0.25
        misfit[turn] = (bar * math.log(bar_variance) + (size - bar) * math.log(floor_variance)) / size


@kernel()
def _solve(design: Float64, gray: Float64, bar_variance: float, floor_variance: float) -> Float64:
    """Solve weighted least squares (5,) with slight damping."""
    normal = np.zeros((_PARTS, _PARTS))
    right = np.zeros(_PARTS)
    for pixel in range(design.shape[0]):
        share = design[pixel, 2]
        weight = share / bar_variance + (1 - share) / floor_variance
        for one in range(_PARTS):
            right[one] += weight * design[pixel, one] * gray[pixel]
            for other in range(_PARTS):
                normal[one, other] += weight * design[pixel, one] * design[pixel, other]
    damping = 1e-6 * np.trace(normal)
    for one in range(_PARTS):
        normal[one, one] += damping
    fitted: Float64 = np.linalg.solve(normal, right).astype(np.float64)
    return fitted
