"""Compute marginal covariances of a solved system: each node's block, and its dependence on the border."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from barsight.core.arrays import Float64, Int64
from barsight.core.linalg.dense import one_blas_thread
from barsight.core.linalg.skyline import inverse_blocks, solve_back_dense, solve_forward
from barsight.motion.problem.normal_equations import System

NO_PAIRS = np.empty((0, 2), np.int64)


@dataclass(frozen=True, eq=False)
class Marginals:
    """Marginal covariances of the system's K nodes. poses: (K, 6, 6) in GTSAM's order and body axes, with the
    rig's drift taken as known. encoder_sigmas: (S,) of the encoders' unknowns, likewise.
    drift_jacobian_of_pose: (K, 6, 2) derivatives of the poses by the drift; drift_jacobian_of_encoders: (S,
    2) those of the encoders' unknowns. nodes: (K, n, n) of all of a node's unknowns, with the whole
    border taken as known. cross: (P, 6, 6) of pairs of poses, as `poses`; NaN for pairs too far apart for the
    band.
    """

    poses: Float64
    encoder_sigmas: Float64
    drift_jacobian_of_pose: Float64
    drift_jacobian_of_encoders: Float64
    nodes: Float64
    cross: Float64


@one_blas_thread()
def marginals(system: System, pairs: Int64 = NO_PAIRS) -> Marginals:
    """Compute the marginals of a system at its optimum. pairs: (P, 2) of these nodes, the earlier first."""
    layout = system.layout
    own, _ = system.schur(system.forward)
    count, size = len(layout.node), layout.size
    nodes = np.empty((count, size, size))
    cross = np.empty((len(pairs), size, size))
    inverse_blocks(system.factor, layout.node, np.empty(len(layout.first)), nodes, pairs, cross)
    cross = cross[:, :6, :6]
    poses = nodes[:, :6, :6]
    by_border = -_to_border(system)[layout.poses].reshape(count, 6, -1)
    drift_jacobian_of_pose, encoders, by_drift = by_border[:, :, -2:], np.empty(0), np.empty((0, 2))
    if len(own) > 2:
        variance = np.linalg.inv(own[:-2, :-2])
        encoders = np.sqrt(np.diag(variance)[: system.encoder_unknowns])
        by_drift = -(variance @ own[:-2, -2:])[: system.encoder_unknowns]
        to_border = by_border[:, :, :-2]
        poses = poses + to_border @ variance @ to_border.transpose(0, 2, 1)
        drift_jacobian_of_pose = drift_jacobian_of_pose - to_border @ variance @ own[:-2, -2:]
        cross = cross + to_border[pairs[:, 0]] @ variance @ to_border[pairs[:, 1]].transpose(0, 2, 1)
    return Marginals(poses, encoders, drift_jacobian_of_pose, by_drift, nodes, cross)


@one_blas_thread()
def slide_variances(system: System, weights: Float64) -> tuple[Float64, float]:
    """Compute the variances (2 S,) of the pieces' slides and disparities, and that of their sum weighted by
    `weights` (2 S,), with the rig's drift taken as known.
    """
    at, count = system.layout.pieces, len(system.layout.first)
    diagonal, none = np.empty(count), np.empty((0, 1, 1))
    inverse_blocks(system.factor, NO_PAIRS[:, 0], diagonal, none, NO_PAIRS, none)
    own, _ = system.schur(system.forward)
    variance = np.linalg.inv(own[:-2, :-2])
    to_border = _to_border(system)[at, :-2]
    each = diagonal[at] + np.einsum("sb,bc,sc->s", to_border, variance, to_border)
    whole = np.zeros((count, 1))
    whole[at, 0] = weights
    solve_forward(system.factor, whole)
    of_sum = weights @ to_border
    return each, float(whole[:, 0] @ whole[:, 0] + of_sum @ variance @ of_sum)


def _to_border(system: System) -> Float64:
    """Solve for the matrix's inverse times its coupling to the border (n, b)."""
    result = system.forward[:, 1:].copy()
    solve_back_dense(system.factor, result)
    return result
