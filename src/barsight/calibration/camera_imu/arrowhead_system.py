"""Solve block-tridiagonal least squares with dense common unknowns (an arrowhead matrix).

Each sample has ROWS whitened residuals that depend on the unknowns of ORDER neighbouring control points and
on the common parameters. A banded Cholesky factorisation eliminates the chain of control points; what
remains, the Schur complement, is the information matrix of the common parameters.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from barsight.calibration.camera_imu.pose_spline import STATE
from barsight.calibration.camera_imu.spline_kernels import ORDER
from barsight.core.arrays import Float64, Int64, kernel
from barsight.core.linalg import skyline
from barsight.core.linalg.skyline import Skyline

ROWS = 6
LOCAL = STATE * ORDER
RIDGE = 1e-12
"""Ridge added to the diagonal as a fraction of its median, so that unobserved control points stay
solvable.
"""


@dataclass(frozen=True, eq=False)
class Samples:
    """Whitened rows of K samples.

    residual: (K, ROWS), measured minus predicted. first: (K,) first control point. by_chain: (K, ROWS, LOCAL)
    and by_common: (K, ROWS, P), derivatives of the prediction.
    """

    first: Int64
    residual: Float64
    by_chain: Float64
    by_common: Float64


@dataclass(frozen=True, eq=False)
class RandomWalks:
    """Random-walk prior on the biases: the biases of neighbouring control points differ by `sigma` (6,), gyro
    first, then accelerometer.

    difference: (M - 1, 6), the biases of the next control point minus those of this one.
    """

    difference: Float64
    sigma: Float64


@dataclass(frozen=True, eq=False)
class ArrowheadSystem:
    """The normal equations.

    chain: (N, LOCAL) lower band as for `skyline.uniform_band`. border: (N, P). common: (P, P).
    chain_gradient (N,) and common_gradient (P,) point downhill.
    """

    chain: Float64
    border: Float64
    common: Float64
    chain_gradient: Float64
    common_gradient: Float64


@dataclass(frozen=True, eq=False)
class EliminatedChain:
    """The factorised chain and the reduced system.

    through: (N, P), chain^-1 border. information: (P, P), the Schur complement of the common parameters.
    """

    factor: Skyline
    through: Float64
    information: Float64

    def chain_solve(self, right: Float64) -> Float64:
        """Solve for chain^-1 right (N,)."""
        solved = right.reshape(-1, 1).copy()
        skyline.solve_forward(self.factor, solved)
        skyline.solve_back_dense(self.factor, solved)
        return solved[:, 0]


def assemble(samples: Samples, walks: RandomWalks, control_points: int) -> ArrowheadSystem:
    """Assemble the normal equations J^T J dx = -J^T r of all samples and random walks."""
    count, width = control_points * STATE, samples.by_common.shape[2]
    chain, border = np.zeros((count, LOCAL)), np.zeros((count, width))
    gradient, common, common_gradient = np.zeros(count), np.zeros((width, width)), np.zeros(width)
    _add(
        samples.first, samples.residual, samples.by_chain, samples.by_common, chain, border, gradient, common,
        common_gradient,
    )  # fmt: skip
    information = 1 / walks.sigma**2
    whole = chain.reshape(control_points, STATE, LOCAL)
    bias = np.arange(6, STATE)
    whole[:-1, bias, LOCAL - 1] += information
    whole[1:, bias, LOCAL - 1] += information
    whole[1:, bias, LOCAL - 1 - STATE] -= information
    pull = walks.difference * information
    slope = gradient.reshape(control_points, STATE)
    slope[:-1, 6:] += pull
    slope[1:, 6:] -= pull
    return ArrowheadSystem(chain, border, common, gradient, common_gradient)


def eliminate(system: ArrowheadSystem, damping: float = 0.0) -> EliminatedChain:
    """Form the Schur complement of the common unknowns; `damping` scales both diagonals.

    Raises LinAlgError where the chain is not determined.
    """
    chain = system.chain.copy()
    diagonal = system.chain[:, -1].reshape(-1, STATE)
    chain[:, -1] += (damping * diagonal + RIDGE * np.median(diagonal, axis=0)).ravel()
    factor = skyline.uniform_band(chain)
    if not skyline.factorise_skyline(factor):
        raise np.linalg.LinAlgError("the chain is not determined")
    through = system.border.copy()
    skyline.solve_forward(factor, through)
    skyline.solve_back_dense(factor, through)
    common = system.common + damping * np.diag(np.diag(system.common))
    return EliminatedChain(factor, through, common - np.einsum("np,nq->pq", system.border, through))


def step(system: ArrowheadSystem, eliminated: EliminatedChain) -> tuple[Float64, Float64]:
    """Solve for the Newton step of chain (N,) and common parameters (P,)."""
    alone = eliminated.chain_solve(system.chain_gradient)
    target = system.common_gradient - np.einsum("np,n->p", system.border, alone)
    scale = 1 / np.sqrt(np.maximum(np.diag(eliminated.information), 1e-300))
    unit = eliminated.information * scale[:, None] * scale
    values, vectors = np.linalg.eigh(unit)
    values = np.maximum(values, 1e-12 * values[-1])
    common = scale * (vectors @ ((vectors.T @ (scale * target)) / values))
    return alone - np.einsum("np,p->n", eliminated.through, common), common


def project_out_chain(samples: Samples, through: Float64) -> Float64:
    """Project the chain out of the common Jacobian (K, ROWS, P): B - A chain^-1 border."""
    out = samples.by_common.copy()
    _project(samples.first, samples.by_chain, through, out)
    return out


def apply_jacobian(samples: Samples, chain: Float64, common: Float64) -> Float64:
    """Multiply the Jacobian by a step of the unknowns to obtain the change of the predictions (K, ROWS)."""
    change: Float64 = np.einsum("krp,p->kr", samples.by_common, common)
    _predict(samples.first, samples.by_chain, chain, change)
    return change


def gradient_of(samples: Samples, residual: Float64, count: int) -> tuple[Float64, Float64]:
    """Compute the gradient, chain (count,) and common (P,), for other whitened residuals (K, ROWS)."""
    gradient = np.zeros(count)
    _pull(samples.first, samples.by_chain, residual, gradient)
    return gradient, np.einsum("krp,kr->p", samples.by_common, residual)


@kernel()
def _add(
    first: Int64, residual: Float64, by_chain: Float64, by_common: Float64, chain: Float64, border: Float64,
    gradient: Float64, common: Float64, common_gradient: Float64,
) -> None:  # fmt: skip
    """Accumulate the normal equations of all samples, in place.

    first: (K,), residual: (K, ROWS), by_chain: (K, ROWS, LOCAL), by_common: (K, ROWS, P), see `Samples`.
    chain: (N, LOCAL) lower band, border: (N, P), gradient: (N,), common: (P, P), common_gradient: (P,), see
    `ArrowheadSystem`. Columns that are all zero are skipped.
    """
    width = by_common.shape[2]
    live = np.empty(LOCAL, np.int64)
    columns = np.empty((LOCAL, ROWS))
    for k in range(first.size):
        base = first[k] * STATE
        used = 0
        for a in range(LOCAL):
            size = 0.0
            for r in range(ROWS):
                columns[used, r] = by_chain[k, r, a]
                size += abs(columns[used, r])
            if size > 0:
                live[used] = a
                used += 1
        for m in range(used):
            j = base + live[m]
            total = 0.0
            for r in range(ROWS):
                total += columns[m, r] * residual[k, r]
            gradient[j] += total
            for n in range(m, used):
                total = 0.0
                for r in range(ROWS):
                    total += columns[m, r] * columns[n, r]
                chain[base + live[n], LOCAL - 1 - live[n] + live[m]] += total
            for p in range(width):
                total = 0.0
                for r in range(ROWS):
                    total += columns[m, r] * by_common[k, r, p]
                border[j, p] += total
        for r in range(ROWS):
            for p in range(width):
                value = by_common[k, r, p]
                if value != 0.0:
                    common_gradient[p] += value * residual[k, r]
                    for q in range(width):
                        common[p, q] += value * by_common[k, r, q]


@kernel()
def _project(first: Int64, by_chain: Float64, through: Float64, out: Float64) -> None:
    """Subtract by_chain @ through from out (K, ROWS, P), in place, to project the chain out of the Jacobian.

    first: (K,) control points; by_chain: (K, ROWS, LOCAL); through: (N, P), see `EliminatedChain`.
    """
    for k in range(first.size):
        base = first[k] * STATE
        for r in range(ROWS):
            for a in range(LOCAL):
                value = by_chain[k, r, a]
                if value != 0.0:
                    for p in range(out.shape[2]):
                        out[k, r, p] -= value * through[base + a, p]


@kernel()
def _predict(first: Int64, by_chain: Float64, chain: Float64, out: Float64) -> None:
    """Add the Jacobian times a step of the chain (N,) to out (K, ROWS), in place.

    first: (K,) control points; by_chain: (K, ROWS, LOCAL).
    """
    for k in range(first.size):
        base = first[k] * STATE
        for r in range(ROWS):
            total = 0.0
            for a in range(LOCAL):
                total += by_chain[k, r, a] * chain[base + a]
            out[k, r] += total


@kernel()
def _pull(first: Int64, by_chain: Float64, residual: Float64, gradient: Float64) -> None:
    """Add the transposed Jacobian times residual (K, ROWS) to the chain's gradient (N,), in place.

    first: (K,) control points; by_chain: (K, ROWS, LOCAL).
    """
    for k in range(first.size):
        base = first[k] * STATE
        for r in range(ROWS):
            for a in range(LOCAL):
                gradient[base + a] += by_chain[k, r, a] * residual[k, r]
