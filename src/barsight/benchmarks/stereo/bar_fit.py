"""Fit one cylinder above a floor plane to a whole disparity map, for the bar's diameter.

The floor is a plane, whose disparity is linear in the image; it is fitted away from the bar. A cylinder
(position, direction, radius) in front of it then predicts the disparity of each pixel near the bar: the
pixels on the bar constrain its position and curvature, and the edges, where the map changes from bar to
floor, constrain its width. Residuals are divided by the method's own sigma, scaled to be consistent with each
other, and enter through Cauchy's robust loss. Only the map is used, not the images.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.optimize import fmin

from barsight.core.arrays import Bool, Float64, kernel
from barsight.core.errors import Failed
from barsight.core.linalg.robust import mad_sigma
from barsight.core.records.disparity import Disparity
from barsight.core.records.pairs import RectifiedCamera

_ROUNDS = 3
_MIN_PIXELS = 200
_REACH_RADII = 2.0
_CLEAR_RADII = 1.6
_CAUCHY_SIGMAS = 2.4
_MAX_PRODUCT = 1e100


class BarPixels(NamedTuple):
    """Pixels near a bar. rays: (N, 2) x, y with z = 1. behind: (N,) disparity of the floor, px. scale:
    focal length times baseline, px m; doffs: px. found: (N,) disparity in the map, px.
    """

    rays: Float64
    behind: Float64
    scale: float
    doffs: float
    found: Float64


@dataclass(frozen=True, eq=False)
class BarGuess:
    """Rough bar in `rect0`: a point of its axis, its direction and its radius."""

    centre_m: Float64
    axis: Float64
    radius_m: float


@dataclass(frozen=True, eq=False)
class BarFit:
    """The fitted cylinder."""

    centre_m: Float64
    axis: Float64
    radius_m: float


def fit_bar(disparity: Disparity, camera: RectifiedCamera, guess: BarGuess) -> BarFit | Failed:
    """Fit the cylinder, starting from a guess that is correct to about a quarter of the radius.

    Failed `no-floor` or `no-bar` if too few pixels have a disparity, `diverged` if the radius leaves 0.3...3
    times the guess.
    """
    beside = _beside_the_axis(camera, guess)
    near = np.abs(beside) < _REACH_RADII * guess.radius_m
    known = np.isfinite(disparity.disparity_px) & (disparity.sigma_px > 0)
    floor = _fit_floor(disparity, known & (np.abs(beside) > _CLEAR_RADII * guess.radius_m))
    if floor is None:
        return Failed("no-floor", "too few pixels of the floor have a disparity")
    rows, columns = np.nonzero(near & known)
    if rows.size < _MIN_PIXELS:
        return Failed("no-bar", f"only {rows.size} pixels near the bar have a disparity")
    rays = np.column_stack([(columns - camera.cx_px), (rows - camera.cy_px)]) / camera.focal_px
    behind = floor[0] * columns + floor[1] * rows + floor[2]
    found = disparity.disparity_px[rows, columns].astype(np.float64)
    sigma = disparity.sigma_px[rows, columns].astype(np.float64)
    pixels = BarPixels(rays, behind, camera.focal_px * camera.baseline_m, camera.doffs_px, found)
    frame, place = _frame(guess), np.zeros(5)
    for _ in range(_ROUNDS):
        off = _residuals(*_placed(place, frame, guess.radius_m), pixels)
        kappa = max(mad_sigma(off / sigma), 1e-3)
        place = _descend(place, (frame, guess.radius_m, pixels, 1 / (_CAUCHY_SIGMAS * kappa * sigma)))
    centre, axis, radius = _placed(place, frame, guess.radius_m)
    if not 0.3 < radius / guess.radius_m < 3:
        return Failed("diverged", f"the fit ends at a radius of {1000 * radius:.1f} mm")
    return BarFit(centre, axis, radius)


def _beside_the_axis(camera: RectifiedCamera, guess: BarGuess) -> Float64:
    """Compute the signed distance (H, W), m, of each pixel's ray from the guessed axis."""
    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays = np.stack(
        [
            (columns - camera.cx_px) / camera.focal_px,
            (rows - camera.cy_px) / camera.focal_px,
            np.ones(columns.shape),
        ],
        axis=-1,
    )
    normal = np.cross(guess.centre_m, guess.axis)
    normal = normal / np.linalg.norm(normal)
    beside: Float64 = (rays @ normal) * guess.centre_m[2]
    return beside


def _fit_floor(disparity: Disparity, where: Bool) -> Float64 | None:
    """Fit the floor's disparity (3,), a * column + b * row + c, robustly; None for too few pixels."""
    rows, columns = np.nonzero(where)
    if rows.size < _MIN_PIXELS:
        return None
    design = np.column_stack([columns, rows, np.ones(rows.size)]).astype(np.float64)
    values = disparity.disparity_px[rows, columns].astype(np.float64)
    sigma = disparity.sigma_px[rows, columns].astype(np.float64)
    # The start must tolerate many outliers: a constant disparity, the median.
    plane = np.array([0.0, 0.0, float(np.median(values))])
    for step in range(15):
        residual = np.abs(values - design @ plane) / sigma
        kappa = max(mad_sigma(residual), 1e-3) * (4 if step < 5 else _CAUCHY_SIGMAS)
        root = 1 / (sigma * np.sqrt(1 + (residual / kappa) ** 2))
        plane = np.linalg.lstsq(design * root[:, None], values * root, rcond=None)[0]
    return plane


def _frame(guess: BarGuess) -> Float64:
    """Build the guess's frame (4, 3): centre, axis, sideways direction and direction towards the camera."""
    sideways = np.cross(guess.axis, guess.centre_m)
    sideways = sideways / np.linalg.norm(sideways)
    return np.array([guess.centre_m, guess.axis, sideways, np.cross(sideways, guess.axis)])


def _placed(place: Float64, frame: Float64, radius_m: float) -> tuple[Float64, Float64, float]:
    """Apply parameters (5,), in radii of the guess: shifts sideways and towards the camera, tilts of the
    axis in the same directions, and growth of the radius.
    """
    centre = frame[0] + radius_m * (place[0] * frame[2] + place[1] * frame[3])
    axis = frame[1] + radius_m * (place[2] * frame[2] + place[3] * frame[3])
    return centre, axis / np.linalg.norm(axis), radius_m * math.exp(place[4])


def _descend(start: Float64, problem: tuple[Float64, float, BarPixels, Float64]) -> Float64:
    """Minimise the loss, which has small steps where pixels change surface, by Nelder and Mead's simplex."""
    simplex = np.vstack([start, start + 0.1 * np.eye(5)])
    best: Float64 = fmin(
        _loss,
        start,
        args=problem,
        xtol=1e-4,
        ftol=1e-7,
        maxiter=1200,
        maxfun=1500,
        disp=False,
        initial_simplex=simplex,
    )
    return best


def _loss(place: Float64, frame: Float64, radius_m: float, pixels: BarPixels, weight: Float64) -> float:
    return _cauchy(*_placed(place, frame, radius_m), pixels, weight)


@kernel()
def _residual(centre: Float64, axis: Float64, radius: float, pixels: BarPixels, index: int) -> float:
    """Compute one pixel's residual: its disparity minus that of the nearer of cylinder and floor on its ray.

    centre: (3,) m; axis: (3,) unit vector; radius: m.
    """
    x, y = pixels.rays[index, 0], pixels.rays[index, 1]
    slide = axis[0] * x + axis[1] * y + axis[2]
    lift = axis[0] * centre[0] + axis[1] * centre[1] + axis[2] * centre[2]
    ex, ey, ez = x - slide * axis[0], y - slide * axis[1], 1 - slide * axis[2]
    px, py, pz = centre[0] - lift * axis[0], centre[1] - lift * axis[1], centre[2] - lift * axis[2]
    a = ex * ex + ey * ey + ez * ez
    b = ex * px + ey * py + ez * pz
    root = b * b - a * (px * px + py * py + pz * pz - radius * radius)
    predicted = pixels.behind[index]
    if root > 0:
        predicted = max(predicted, pixels.scale * a / (b - math.sqrt(root)) - pixels.doffs)
    return float(pixels.found[index] - predicted)


@kernel()
def _cauchy(centre: Float64, axis: Float64, radius: float, pixels: BarPixels, weight: Float64) -> float:
    """Compute the mean Cauchy loss of the pixels' residuals.

    centre: (3,) m; axis: (3,) unit vector; radius: m. weight: (N,) 1 / px.
    """
    total, product = 0.0, 1.0
    for index in range(len(weight)):
        away = _residual(centre, axis, radius, pixels, index) * weight[index]
        product *= 1 + away * away
        # One logarithm for many factors, because logarithms dominate the run time.
        if product > _MAX_PRODUCT:
            total += math.log(product)
            product = 1.0
    return float((total + math.log(product)) / len(weight))


@kernel()
def _residuals(centre: Float64, axis: Float64, radius: float, pixels: BarPixels) -> Float64:
    """Compute residuals (N,), px: each pixel's disparity minus that of the cylinder or of the floor.

    centre: (3,) m; axis: (3,) unit vector; radius: m.
    """
    off = np.empty(len(pixels.found))
    for index in range(len(off)):
        off[index] = _residual(centre, axis, radius, pixels, index)
    return off
