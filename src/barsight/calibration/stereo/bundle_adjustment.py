"""Adjust lenses, rig, board shape and all board poses in one least-squares problem.

cam0 sees a board point P_W at P_L = R_L P_W + T_L and cam1 sees it at P_R = R P_L + T [paper Eq. 1-3]; the
residuals are in pixels. Board poses are coupled only through the common parameters, so the normal equations
are solved by their Schur complement, whose inverse is the covariance of the common parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from barsight.calibration.boards.board_views import BoardView
from barsight.calibration.geometry.projection import Lens, project_lens
from barsight.core.arrays import Float64, Int64
from barsight.core.linalg.dense import solve_positive
from barsight.core.linalg.levenberg_marquardt import Options, minimise
from barsight.core.pose import skew

OPTIONS = Options(
    max_steps=100, min_gain_ratio=1e-12, first_damping=1e-3, min_damping=1e-12, max_damping=1e10
)
NEAREST_Z_M = 1e-3
SHAPE_PX = 0.2
"""Corner noise (px) at which the prior on the board's shape has the sigmas given by `shape_basis`."""


@dataclass(frozen=True, eq=False)
class CornerTable:
    """One camera's corners, sorted by view. view, ids: (N,). points_m: (N, 3). pixels: (N, 2).

    by_shape: (N, 3, S) derivatives of the points with respect to the board's shape.
    """

    view: Int64
    ids: Int64
    points_m: Float64
    pixels: Float64
    by_shape: Float64


@dataclass(frozen=True, eq=False)
class AdjustmentState:
    """The unknowns of the adjustment.

    lenses: one parameter vector per camera. rotation (3, 3), translation_m (3,): cam1_from_cam0.
    board_rotation (V, 3, 3), board_translation_m (V, 3): cam0_from_board of each view. shape: (S,) steps of
    the board's shape, empty for a flat board.
    """

    lenses: tuple[Float64, ...]
    rotation: Float64
    translation_m: Float64
    board_rotation: Float64
    board_translation_m: Float64
    shape: Float64


@dataclass(frozen=True, eq=False)
class AdjustmentResult:
    """Result of an adjustment.

    residuals_px: (N, 2) per camera, observed minus projected. reduced: (C, C) Schur complement of the common
    parameters at unit weights. view_reduced (V, C, C), scores (V, C): each view's share of it and of the
    common gradient. steps: number of steps taken.
    """

    state: AdjustmentState
    residuals_px: tuple[Float64, ...]
    reduced: Float64
    view_reduced: Float64
    scores: Float64
    steps: int
    converged: bool

    @property
    def rig_information(self) -> Float64:
        """Return the part of `reduced` for lenses and rig, with the board's shape eliminated."""
        count = self.reduced.shape[0] - self.state.shape.size
        mixed = self.reduced[:count, count:]
        return self.reduced[:count, :count] - mixed @ np.linalg.solve(self.reduced[count:, count:], mixed.T)


@dataclass(frozen=True, eq=False)
class _Normal:
    cost: float
    residuals: tuple[Float64, ...]
    common: Float64
    gradient: Float64
    mixed: Float64
    boards: Float64
    board_gradient: Float64
    view_common: Float64
    view_gradient: Float64


@dataclass(frozen=True, eq=False)
class _BoardIterate:
    """A state and its normal equations, which are computed on first use."""

    lens: Lens
    seen: tuple[CornerTable, ...]
    huber_px: float | None
    state: AdjustmentState

    @cached_property
    def normal(self) -> _Normal:
        return _linearise(self.lens, self.seen, self.state, self.huber_px)

    @property
    def cost(self) -> float:
        return self.normal.cost

    def step(self, damping: float) -> _BoardIterate:
        return replace(self, state=_move(self.state, self.normal, damping))


def observe(
    views: Sequence[BoardView], board_points_m: Float64, basis: Float64, cameras: int
) -> tuple[CornerTable, ...]:
    """Collect the corners of all views as flat arrays for the first `cameras` cameras; basis: from
    `shape_basis`.
    """
    gathered = []
    for camera in range(cameras):
        seen = [(number, view.cameras[camera]) for number, view in enumerate(views)]
        known = [(number, corners) for number, corners in seen if corners is not None]
        index = [np.full(corners.ids.size, number) for number, corners in known]
        ids = np.concatenate([corners.ids for _, corners in known]).astype(np.int64)
        pixels = np.concatenate([corners.pixels for _, corners in known])
        gathered.append(CornerTable(np.concatenate(index), ids, board_points_m[ids], pixels, basis[ids]))
    return tuple(gathered)


def adjust(
    lens: Lens, seen: tuple[CornerTable, ...], start: AdjustmentState, huber_px: float | None
) -> AdjustmentResult:
    """Run Levenberg-Marquardt from `start`. huber_px: residual above which the weight falls, None for no
    robust weights.

    With one camera, its lens and the board poses are solved for; with two, the rig too. The board's shape is
    solved for where `start` has one. `converged` is False where the maximum number of steps was reached.
    """
    found = minimise(_BoardIterate(lens, seen, huber_px, start), OPTIONS)
    state = found.best.state
    plain = _linearise(lens, seen, state, None)
    inverse = np.linalg.pinv(plain.boards, hermitian=True)
    lost = np.einsum("vci,vij,vdj->vcd", plain.mixed, inverse, plain.mixed)
    scores = plain.view_gradient - np.einsum("vci,vij,vj->vc", plain.mixed, inverse, plain.board_gradient)
    view_reduced = plain.view_common - lost
    return AdjustmentResult(
        state, plain.residuals, plain.common - lost.sum(axis=0), view_reduced, scores, found.steps,
        found.converged,
    )  # fmt: skip


def _linearise(
    lens: Lens, seen: tuple[CornerTable, ...], state: AdjustmentState, huber_px: float | None
) -> _Normal:
    width = len(lens.parameter_names)
    count = state.board_rotation.shape[0]
    shape = state.shape.size
    size = width * len(seen) + (6 if len(seen) == 2 else 0) + shape
    common, gradient = np.zeros((count, size, size)), np.zeros((count, size))
    mixed = np.zeros((count, size, 6))
    boards, board_gradient = np.zeros((count, 6, 6)), np.zeros((count, 6))
    cost, residuals = SHAPE_PX**2 * float(state.shape @ state.shape), []
    for camera, observed in enumerate(seen):
        residual, by_common, by_board = _derivatives(lens, observed, state, camera)
        length = np.linalg.norm(residual, axis=1)
        weight = np.ones_like(length)
        if huber_px is not None:
            weight = np.minimum(1.0, huber_px / np.maximum(length, 1e-12))
            cost += float(np.where(length > huber_px, huber_px * (2 * length - huber_px), length**2).sum())
        else:
            cost += float((length**2).sum())
        columns = np.arange(width) + camera * width
        if camera == 1:
            columns = np.concatenate([columns, 2 * width + np.arange(6)])
        columns = np.concatenate([columns, size - shape + np.arange(shape)])
        starts = np.flatnonzero(np.diff(observed.view, prepend=-1))
        ends = np.append(starts[1:], observed.view.size)
        for first, last in zip(starts, ends, strict=True):
            view, part = observed.view[first], slice(first, last)
            a = by_common[part].reshape(-1, columns.size)
            b = by_board[part].reshape(-1, 6)
            r = residual[part].ravel()
            w = np.repeat(weight[part], 2)[:, None]
            wa, wb = w * a, w * b
            common[view][np.ix_(columns, columns)] += a.T @ wa
            mixed[view][columns] += wa.T @ b
            boards[view] += b.T @ wb
            gradient[view][columns] += wa.T @ r
            board_gradient[view] += wb.T @ r
        residuals.append(residual)
    whole, pull = common.sum(axis=0), gradient.sum(axis=0)
    of_shape = np.arange(size - shape, size)
    whole[of_shape, of_shape] += SHAPE_PX**2
    pull[of_shape] -= SHAPE_PX**2 * state.shape
    return _Normal(
        cost, tuple(residuals), whole, pull, mixed, boards,
        board_gradient, common, gradient,
    )  # fmt: skip


def _derivatives(
    lens: Lens, observed: CornerTable, state: AdjustmentState, camera: int
) -> tuple[Float64, Float64, Float64]:
    """Compute the residuals (N, 2) and the derivatives of the projection with respect to steps of the common
    parameters (N, 2, C) and of the board (N, 2, 6).
    """
    rotation = state.board_rotation[observed.view]
    rotated = np.einsum("nij,nj->ni", rotation, observed.points_m + observed.by_shape @ state.shape)
    by_shape = rotation @ observed.by_shape
    point = rotated + state.board_translation_m[observed.view]
    by_board = np.concatenate([-skew(rotated), np.broadcast_to(np.eye(3), (len(point), 3, 3))], axis=2)
    if camera == 1:
        rig_turned = point @ state.rotation.T
        point = rig_turned + state.translation_m
        by_board, by_shape = state.rotation @ by_board, state.rotation @ by_shape
    point = np.column_stack([point[:, :2], np.maximum(point[:, 2], NEAREST_Z_M)])
    projected = project_lens(lens, state.lenses[camera], point)
    by_common = projected.by_lens
    if camera == 1:
        by_rig = np.concatenate([-skew(rig_turned), np.broadcast_to(np.eye(3), (len(point), 3, 3))], axis=2)
        by_common = np.concatenate([by_common, projected.by_point @ by_rig], axis=2)
    by_common = np.concatenate([by_common, projected.by_point @ by_shape], axis=2)
    return observed.pixels - projected.pixels, by_common, projected.by_point @ by_board


def _move(state: AdjustmentState, normal: _Normal, damping: float) -> AdjustmentState:
    """Take one damped step. Raises LinAlgError where the equations have no solution."""
    boards = normal.boards + damping * normal.boards * np.eye(6) + 1e-12 * np.eye(6)
    common = normal.common + damping * np.diag(np.diag(normal.common))
    inverse = np.linalg.inv(boards)
    through = normal.mixed @ inverse
    reduced = common - np.einsum("vci,vdi->cd", through, normal.mixed)
    target = normal.gradient - np.einsum("vci,vi->c", through, normal.board_gradient)
    step = solve_positive(reduced, target)
    rest = normal.board_gradient - np.einsum("vci,c->vi", normal.mixed, step)
    return retract_adjustment(state, step, np.einsum("vij,vj->vi", inverse, rest))


def retract_adjustment(
    state: AdjustmentState, common: Float64, boards: Float64 | None = None
) -> AdjustmentState:
    """Retract a step (C,) of the common parameters and (V, 6) of the board poses, with rotations from the
    left.

    A step without the board's shape leaves the shape unchanged.
    """
    width = state.lenses[0].size
    lenses = tuple(
        lens + common[camera * width : (camera + 1) * width] for camera, lens in enumerate(state.lenses)
    )
    moved = replace(state, lenses=lenses)
    if len(lenses) == 2:
        turn = Rotation.from_rotvec(common[2 * width : 2 * width + 3]).as_matrix()
        moved = replace(
            moved, rotation=turn @ state.rotation,
            translation_m=state.translation_m + common[2 * width + 3 : 2 * width + 6],
        )  # fmt: skip
        if common.size > 2 * width + 6:
            moved = replace(moved, shape=state.shape + common[2 * width + 6 :])
    if boards is not None:
        turns = Rotation.from_rotvec(boards[:, :3]).as_matrix()
        moved = replace(
            moved,
            board_rotation=turns @ state.board_rotation,
            board_translation_m=state.board_translation_m + boards[:, 3:],
        )
    return moved
