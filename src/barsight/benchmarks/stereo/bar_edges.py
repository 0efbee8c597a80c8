"""Measure a bar's diameter from its two outlines in each image and from its disparities.

An outline is a plane through the camera centre; the two planes give the bar's direction and the ratio of its
radius to its distance, and the disparities of the bar's points give the distance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from barsight.benchmarks.stereo.bar_fit import BarFit
from barsight.benchmarks.stereo.bar_outline import OutlineSearch, find_outline
from barsight.core.arrays import Float64, UInt8
from barsight.core.errors import Failed
from barsight.core.linalg.robust import mad_sigma
from barsight.core.records.disparity import Disparity
from barsight.core.records.pairs import RectifiedCamera, RectifiedPair

_MIN_REACH_PX = 4.0
_REACH_RADII = 0.4
_INSIDE_RATIO = 0.7
_MIN_PIXELS = 200


@dataclass(frozen=True, eq=False)
class Outlines:
    """normals: (2, 3) unit, towards the bar, of the planes through the camera centre and each outline."""

    normals: Float64


def edge_diameter(disparity: Disparity, pair: RectifiedPair, start: BarFit) -> float | Failed:
    """Measure the diameter, m: the mean of both images, each from its outlines and the distance by disparity.

    start: fit to the disparity map, around whose outlines the outlines are searched for, up to 4 px or 0.4 of
    the radius away. Failed `no-outline` if too few stretches lie in an image, `no-points` if too few of the
    bar's points have a disparity.
    """
    camera = pair.camera
    seen_left = find_outlines(pair.left, camera, start)
    if isinstance(seen_left, Failed):
        return seen_left
    axis, towards, sine = _cone(seen_left)
    distance = _distance(disparity, camera, axis, towards, sine)
    if distance is None:
        return Failed("no-points", "too few of the bar's points have a disparity")
    # In the right camera's frame the principal point is doffs_px to the right and the bar is shifted left.
    right_camera = replace(camera, cx_px=camera.cx_px + camera.doffs_px)
    baseline = np.array([camera.baseline_m, 0.0, 0.0])
    moved = replace(start, centre_m=start.centre_m - baseline)
    seen_right = find_outlines(pair.right, right_camera, moved)
    if isinstance(seen_right, Failed):
        return 2 * sine * distance
    _, _, right_sine = _cone(seen_right)
    across = towards * distance - baseline
    right_distance = float(np.linalg.norm(across - axis * float(axis @ across)))
    return sine * distance + right_sine * right_distance


def _cone(outlines: Outlines) -> tuple[Float64, Float64, float]:
    """Intersect the outline planes: direction of the axis, direction towards it, and radius over distance."""
    first, second = outlines.normals
    axis = np.cross(first, second)
    axis /= np.linalg.norm(axis)
    towards = first + second
    towards /= np.linalg.norm(towards)
    return axis, towards, float(first @ towards)


def find_outlines(image: UInt8, camera: RectifiedCamera, start: BarFit) -> Outlines | Failed:
    """Find the two outlines near those of `start`."""
    radius_px = camera.focal_px * start.radius_m / float(start.centre_m[2])
    reach = max(_MIN_REACH_PX, _REACH_RADII * radius_px)
    searches = (OutlineSearch(reach, 0.2, 5.0, 5.0), OutlineSearch(1.0, 0.1, 4.0, min(4.0, 0.6 * radius_px)))
    planes = []
    for normal in tangent_planes(start.centre_m, start.axis, start.radius_m):
        plane = normal
        for search in searches:
            points = find_outline(image, _image_line(plane, camera), radius_px, search)
            if isinstance(points, Failed):
                return points
            plane = _plane_through(points, camera)
            plane *= np.sign(plane @ normal)
        planes.append(plane)
    return Outlines(np.array(planes))


def _plane_through(points_px: Float64, camera: RectifiedCamera) -> Float64:
    """Compute the unit normal (3,) of the plane through the camera centre and two image points."""
    rays = (np.column_stack([points_px, np.zeros(2)]) - [camera.cx_px, camera.cy_px, 0]) / camera.focal_px
    rays[:, 2] = 1
    plane: Float64 = np.cross(rays[0], rays[1])
    return plane / np.linalg.norm(plane)


def tangent_planes(centre_m: Float64, axis: Float64, radius_m: float) -> Float64:
    """Compute unit normals (2, 3), towards the axis, of the tangent planes through the camera centre."""
    across = centre_m - axis * float(axis @ centre_m)
    distance = float(np.linalg.norm(across))
    towards = across / distance
    side = np.cross(axis, towards)
    sine = radius_m / distance
    cosine = math.sqrt(1 - sine * sine)
    return np.array([sine * towards + cosine * side, sine * towards - cosine * side])


def _image_line(normal: Float64, camera: RectifiedCamera) -> Float64:
    """Project a plane to its image line (3,): a x + b y + c is the distance, px, positive at the bar."""
    a, b = normal[0] / camera.focal_px, normal[1] / camera.focal_px
    c = normal[2] - a * camera.cx_px - b * camera.cy_px
    line: Float64 = np.array([a, b, c]) / math.hypot(a, b)
    return line


def _distance(
    disparity: Disparity, camera: RectifiedCamera, axis: Float64, towards: Float64, sine: float
) -> float | None:
    """Estimate the distance from the camera to the axis, m: the robust mean over the bar's inner points.

    A point at depth z on a ray r lies on the cylinder of distance D and radius D sine if D solves
    |z r_perp - D towards|^2 = (D sine)^2, where r_perp is the ray without its component along the axis.
    """
    rows, columns = np.nonzero(np.isfinite(disparity.disparity_px) & (disparity.sigma_px > 0))
    rays = np.column_stack(
        [
            (columns - camera.cx_px) / camera.focal_px,
            (rows - camera.cy_px) / camera.focal_px,
            np.ones(rows.size),
        ]
    )
    rays -= np.outer(rays @ axis, axis)
    length = np.linalg.norm(rays, axis=1)
    front = rays @ towards
    aside = np.sqrt((length**2 - front**2).clip(0, None)) / length
    inner = aside < _INSIDE_RATIO * sine
    if inner.sum() < _MIN_PIXELS:
        return None
    shift = disparity.disparity_px[rows, columns][inner] + camera.doffs_px
    sigma = disparity.sigma_px[rows, columns][inner] / shift
    # z |r_perp| = D (cos - sqrt(sine^2 - sin^2)), with sin and cos of the angle between r_perp and `towards`.
    depth_ratio = np.sqrt(1 - aside[inner] ** 2) - np.sqrt(sine**2 - aside[inner] ** 2)
    # In disparities: shift = f b |r_perp| / (D depth_ratio), so 1 / D is linear in the measurement.
    inverse = shift * depth_ratio / (camera.focal_px * camera.baseline_m * length[inner])
    weight = 1 / sigma**2
    found = float(np.median(inverse))
    for _ in range(20):
        away = (inverse - found) / (sigma * found)
        kappa = max(mad_sigma(away), 1e-6)
        robust = weight / (1 + (away / (2.4 * kappa)) ** 2)
        found = float((robust * inverse).sum() / robust.sum())
    return 1 / found
