"""Propagate a calibration's covariance to pixels over the picture and to depth over the range.

A rotation of the whole camera isn't a lens error (its mounting absorbs it), so projections are compared after
the best common rotation, as mrcal does for points far away.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from barsight.calibration.geometry.camera import Camera
from barsight.calibration.geometry.projection import Lens, project_lens
from barsight.calibration.geometry.rig import StereoRig
from barsight.calibration.stereo.bundle_adjustment import retract_adjustment
from barsight.calibration.stereo.calibration import StereoCalibration, calibrated_rig
from barsight.core.arrays import Bool, Float64

COLUMNS, ROWS = 16, 12
STEP_SIGMAS = 0.05


@dataclass(frozen=True, eq=False)
class PictureGrid:
    """Grid over one camera's picture. x_px: (COLUMNS,), y_px: (ROWS,). pixels: (ROWS * COLUMNS, 2).

    rays: (N, 3) viewing rays of the pixels, z = 1. covered: (N,) true for cells with corners of the views
    used.
    """

    x_px: Float64
    y_px: Float64
    pixels: Float64
    rays: Float64
    covered: Bool


def picture_grid(calibration: StereoCalibration, camera: int) -> PictureGrid:
    """Sample one camera's picture on a grid."""
    model = (calibration.rig.cam0, calibration.rig.cam1)[camera]
    x = (np.arange(COLUMNS) + 0.5) * model.width / COLUMNS - 0.5
    y = (np.arange(ROWS) + 0.5) * model.height / ROWS - 0.5
    pixels = np.stack(np.meshgrid(x, y), axis=2).reshape(-1, 2)
    seen = calibration.observed[camera].pixels
    column = np.clip((seen[:, 0] + 0.5) * COLUMNS / model.width, 0, COLUMNS - 1).astype(int)
    row = np.clip((seen[:, 1] + 0.5) * ROWS / model.height, 0, ROWS - 1).astype(int)
    covered = np.zeros((ROWS, COLUMNS), np.bool_)
    covered[row, column] = True
    return PictureGrid(x, y, pixels, model.rays(pixels), covered.ravel())


def rotation_free_projector(lens: Lens, parameters: Float64, grid: PictureGrid) -> Float64:
    """Build the projector (2N, 2N) that removes from pixel changes the rotation that fits the covered
    cells best.
    """
    by_point = project_lens(lens, parameters, grid.rays).by_point
    x, y, z = grid.rays.T
    zero = np.zeros_like(x)
    cross = np.stack([zero, z, -y, -z, zero, x, y, -x, zero], axis=1).reshape(-1, 3, 3)
    turn = (by_point @ cross).reshape(-1, 3)
    weight = np.repeat(np.where(grid.covered, 1.0, 1e-6), 2)[:, None]
    fit = np.linalg.solve(turn.T @ (weight * turn), (weight * turn).T)
    free: Float64 = np.eye(len(turn)) - turn @ fit
    return free


def projection_sigma(calibration: StereoCalibration, camera: int, covariance: Float64) -> Float64:
    """Propagate a covariance to projections: standard deviation (N,) px along the larger axis at the
    grid's rays.
    """
    grid = picture_grid(calibration, camera)
    width = len(calibration.lens.parameter_names)
    parameters = calibration.state.lenses[camera]
    by_lens = project_lens(calibration.lens, parameters, grid.rays).by_lens.reshape(-1, width)
    effect = rotation_free_projector(calibration.lens, parameters, grid) @ by_lens
    own = slice(camera * width, (camera + 1) * width)
    pairs = effect.reshape(-1, 2, width)
    spread = pairs @ covariance[own, own] @ pairs.transpose(0, 2, 1)
    sigma: Float64 = np.sqrt(np.maximum(np.linalg.eigvalsh(spread)[:, 1], 0))
    return sigma


def triangulate_depth(rig: StereoRig, left: Float64, right: Float64) -> Float64:
    """Triangulate raw pixel pairs (N, 2): depth (N,) m along cam0's axis of the point nearest to both
    rays.
    """
    pose = rig.cam0_from_cam1
    a = rig.cam0.rays(left)
    b = rig.cam1.rays(right) @ pose.rotation.T
    t = pose.translation
    aa, ab, bb = (a * a).sum(1), (a * b).sum(1), (b * b).sum(1)
    at, bt = a @ t, b @ t
    below = aa * bb - ab * ab
    along_a, along_b = (at * bb - bt * ab) / below, (at * ab - bt * aa) / below
    middle = (along_a[:, None] * a + along_b[:, None] * b + t) / 2
    depth: Float64 = middle[:, 2]
    return depth


def sample_pairs(rig: StereoRig, ranges_m: Sequence[float]) -> tuple[Float64, Float64, Float64]:
    """Sample pixel pairs of points that both cameras see: range index (N,), left (N, 2), right (N, 2).

    A 7x5 grid over cam0's picture is placed at each range; points outside cam1's picture are left out.
    """
    x, y = np.meshgrid(np.linspace(0.1, 0.9, 7) * rig.cam0.width, np.linspace(0.1, 0.9, 5) * rig.cam0.height)
    left = np.column_stack([x.ravel(), y.ravel()])
    rays = rig.cam0.rays(left)
    cam1_from_cam0 = rig.cam0_from_cam1.inverse()
    numbers, lefts, rights = [], [], []
    for number, depth in enumerate(ranges_m):
        points = cam1_from_cam0.apply(rays * depth)
        ahead = points[:, 2] > 0.05
        right = np.full_like(left, -1.0)
        right[ahead] = rig.cam1.project(points[ahead])
        inside = ahead & _inside(rig.cam1, right)
        numbers.append(np.full(int(inside.sum()), number))
        lefts.append(left[inside])
        rights.append(right[inside])
    return np.concatenate(numbers), np.concatenate(lefts), np.concatenate(rights)


def depth_derivatives(calibration: StereoCalibration, left: Float64, right: Float64) -> Float64:
    """Differentiate triangulated depths with respect to the common parameters: (N, C) m, with pixels held
    fixed.
    """
    sizes = sizes_of(calibration.rig)
    steps = STEP_SIGMAS * np.sqrt(np.diag(calibration.covariance))
    columns = []
    for number, step in enumerate(steps):
        ends = []
        for sign in (1.0, -1.0):
            change = np.zeros(steps.size)
            change[number] = sign * step
            rig = calibrated_rig(calibration.lens, retract_adjustment(calibration.state, change), sizes)
            ends.append(triangulate_depth(rig, left, right))
        columns.append((ends[0] - ends[1]) / (2 * step))
    return np.column_stack(columns)


def depth_sigma(calibration: StereoCalibration, ranges_m: Sequence[float]) -> Float64:
    """Propagate a covariance to depth: (R, 2) m, the median and largest standard deviation over the picture
    at each range due to the calibration alone; NaN where both cameras see no common point.
    """
    number, left, right = sample_pairs(calibration.rig, ranges_m)
    by = depth_derivatives(calibration, left, right)
    sigma = np.sqrt(np.einsum("nc,cd,nd->n", by, calibration.covariance, by))
    result = np.full((len(ranges_m), 2), np.nan)
    for k in range(len(ranges_m)):
        if (number == k).any():
            result[k] = np.median(sigma[number == k]), sigma[number == k].max()
    return result


def sizes_of(rig: StereoRig) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return the width and height of each camera's pictures."""
    return (rig.cam0.width, rig.cam0.height), (rig.cam1.width, rig.cam1.height)


def _inside(camera: Camera, pixels: Float64) -> Bool:
    lowest, highest = np.zeros(2), np.array([camera.width - 1, camera.height - 1])
    return np.asarray(((pixels > lowest) & (pixels < highest)).all(axis=1))
