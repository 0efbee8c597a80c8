"""Cross-validate a calibration: solve two halves of the views separately and compare them with their
sigmas.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from barsight.calibration.boards.board_views import BoardView
from barsight.calibration.boards.board_warp import shape_basis
from barsight.calibration.geometry.projection import project_lens
from barsight.calibration.stereo.bundle_adjustment import AdjustmentResult, adjust, observe
from barsight.calibration.stereo.calibration import StereoCalibration, calibrated_rig
from barsight.calibration.stereo.projection_uncertainty import (
    depth_derivatives,
    picture_grid,
    rotation_free_projector,
    sample_pairs,
    sizes_of,
    triangulate_depth,
)
from barsight.core.arrays import Bool, Float64
from barsight.core.errors import Failed

FEWEST_PER_HALF = 3
MAX_BLOCKS = 16


@dataclass(frozen=True, eq=False)
class CrossValidation:
    """Differences between the two halves, as RMS over the covered cells (px) or over the points (mm).

    difference_px, predicted_px: of the projection, per camera.
    ranges_m, depth_mm, depth_predicted_mm: (R,) difference in depth of the same pixel pairs at each range.
    baseline_mm, baseline_predicted_mm: of the baseline, for information only.
    """

    difference_px: tuple[float, float]
    predicted_px: tuple[float, float]
    ranges_m: tuple[float, ...]
    depth_mm: tuple[float, ...]
    depth_predicted_mm: tuple[float, ...]
    baseline_mm: float
    baseline_predicted_mm: float

    @property
    def ratio(self) -> float:
        """Return the largest ratio of difference to predicted sigma over projections and depths."""
        pairs = [*zip(self.difference_px, self.predicted_px, strict=True)]
        pairs += [*zip(self.depth_mm, self.depth_predicted_mm, strict=True)]
        return max(measured / predicted for measured, predicted in pairs if predicted > 0)


def cross_validate(calibration: StereoCalibration, ranges_m: Sequence[float]) -> CrossValidation | Failed:
    """Solve two halves separately, made of alternating blocks of neighbouring views, so that the
    near-duplicate neighbours in a film stay together. Failed `few-views` where a half has fewer than three.
    """
    both = [view for view in calibration.views if view.cam0 is not None and view.cam1 is not None]
    block = max(len(both) // MAX_BLOCKS, 1)
    halves = [[v for n, v in enumerate(both) if n // block % 2 == half] for half in (0, 1)]
    if min(len(half) for half in halves) < FEWEST_PER_HALF:
        return Failed("few-views", f"{len(both)} views are too few to solve two halves apart")
    try:
        solved = [_solve_half(calibration, half) for half in halves]
        spread = np.sum([_half_covariance(calibration, s) for s in solved], axis=0)
        return _compare(calibration, solved, spread, tuple(ranges_m))
    except (np.linalg.LinAlgError, ValueError):
        return Failed("undetermined", "half of the views alone don't determine the calibration")


def _solve_half(calibration: StereoCalibration, half: list[BoardView]) -> AdjustmentResult:
    index = {view.name: number for number, view in enumerate(calibration.views)}
    rows = np.array([index[view.name] for view in half])
    state = replace(
        calibration.state,
        board_rotation=calibration.state.board_rotation[rows],
        board_translation_m=calibration.state.board_translation_m[rows],
    )
    seen = observe(half, calibration.board.points_m, shape_basis(calibration.board), 2)
    return adjust(calibration.lens, seen, state, None)


def _half_covariance(calibration: StereoCalibration, half: AdjustmentResult) -> Float64:
    """Widen the covariance of a half for correlation within views as the full solution's was widened.

    With S and S_h the information of the full solution and of the half: S_h^-1/2 (S^1/2 C S^1/2) S_h^-1/2,
    which is sigma^2 S_h^-1 where C is sigma^2 S^-1.
    """
    scale = 1 / np.sqrt(np.diag(calibration.information))
    unit = scale[:, None] * scale
    root = _power(calibration.information * unit, 0.5)
    widening = root @ (calibration.covariance / unit) @ root
    inverse_root = _power(half.rig_information * unit, -0.5)
    covariance: Float64 = inverse_root @ widening @ inverse_root * unit
    return covariance


def _power(matrix: Float64, exponent: float) -> Float64:
    """Raise a symmetric positive definite matrix to a power.

    Raises LinAlgError where a direction is not determined.
    """
    values, vectors = np.linalg.eigh(matrix)
    if values[0] < 1e-13 * values[-1]:
        raise np.linalg.LinAlgError("undetermined")
    powered: Float64 = (vectors * values**exponent) @ vectors.T
    return powered


def _compare(
    calibration: StereoCalibration,
    solved: list[AdjustmentResult],
    spread: Float64,
    ranges_m: tuple[float, ...],
) -> CrossValidation:
    width = len(calibration.lens.parameter_names)
    difference, predicted = [], []
    for camera in (0, 1):
        grid = picture_grid(calibration, camera)
        free = rotation_free_projector(calibration.lens, calibration.state.lenses[camera], grid)
        ends = [project_lens(calibration.lens, s.state.lenses[camera], grid.rays).pixels for s in solved]
        own = slice(camera * width, (camera + 1) * width)
        by = project_lens(calibration.lens, calibration.state.lenses[camera], grid.rays).by_lens.reshape(
            -1, width
        )
        covered = np.repeat(grid.covered, 2)
        effect = (free @ by)[covered]
        change = (free @ (ends[0] - ends[1]).ravel())[covered]
        difference.append(float(np.sqrt(2 * (change**2).mean())))
        variance = np.einsum("nc,cd,nd->n", effect, spread[own, own], effect)
        predicted.append(float(np.sqrt(2 * variance.mean())))
    sizes = sizes_of(calibration.rig)
    rigs = [calibrated_rig(calibration.lens, s.state, sizes) for s in solved]
    number, left, right = sample_pairs(calibration.rig, ranges_m)
    by = depth_derivatives(calibration, left, right)
    depth = triangulate_depth(rigs[0], left, right) - triangulate_depth(rigs[1], left, right)
    variance = np.einsum("nc,cd,nd->n", by, spread, by)
    seen = tuple(k for k in range(len(ranges_m)) if (number == k).any())
    direction = calibration.state.translation_m / np.linalg.norm(calibration.state.translation_m)
    return CrossValidation(
        (difference[0], difference[1]), (predicted[0], predicted[1]),
        tuple(ranges_m[k] for k in seen),
        tuple(_rms_mm(depth**2, number == k) for k in seen),
        tuple(_rms_mm(variance, number == k) for k in seen),
        abs(rigs[0].baseline_m - rigs[1].baseline_m) * 1e3,
        float(np.sqrt(direction @ spread[-3:, -3:] @ direction)) * 1e3,
    )  # fmt: skip


def _rms_mm(squares: Float64, chosen: Bool) -> float:
    return float(np.sqrt(squares[chosen].mean())) * 1e3
