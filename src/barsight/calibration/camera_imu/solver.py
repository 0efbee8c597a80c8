"""Solve a camera-IMU calibration and measure the scatter of its residuals."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from barsight.calibration.camera_imu.arrowhead_system import (
    ROWS,
    ArrowheadSystem,
    EliminatedChain,
    Samples,
    apply_jacobian,
    assemble,
    eliminate,
    gradient_of,
    step,
)
from barsight.calibration.camera_imu.pose_spline import STATE
from barsight.calibration.camera_imu.problem import (
    CameraImuProblem,
    CameraImuState,
    Linearised,
    linearise_camera_imu,
    retract_state,
)
from barsight.core.arrays import Float64, Int64
from barsight.core.linalg.levenberg_marquardt import Options, minimise

OPTIONS = Options(max_steps=100, min_gain_ratio=1e-8, first_damping=1e-6, min_damping=1e-9, max_damping=1e8)


@dataclass(frozen=True, eq=False)
class Solution:
    """A solved state. linearised, eliminated: the system there, without damping or robust weights. steps:
    number of steps taken.
    """

    state: CameraImuState
    linearised: Linearised
    eliminated: EliminatedChain
    steps: int
    converged: bool


@dataclass(frozen=True, eq=False)
class ResidualSpread:
    """Scatter of each sensor's residuals relative to the assumed sigma, and the part that the fit absorbs.

    factor: scatter over assumed sigma. absorbed: share of the sensor's degrees of freedom that the unknowns
    take up. after: (LAGS,) autocorrelation of the residuals. after_expected: that of white noise after the
    same fit.
    """

    factor: float
    absorbed: float
    after: Float64
    after_expected: Float64


LAGS = 4
PROBES = 2


@dataclass(frozen=True, eq=False)
class _CameraImuIterate:
    """A state and its linearisation, which is computed on first use."""

    problem: CameraImuProblem
    huber: float | None
    state: CameraImuState

    @cached_property
    def here(self) -> Linearised:
        return linearise_camera_imu(self.problem, self.state, self.huber)

    @cached_property
    def system(self) -> ArrowheadSystem:
        return assemble(self.here.samples, self.here.walks, len(self.state.spline.places_m))

    @property
    def cost(self) -> float:
        return self.here.cost

    def step(self, damping: float) -> _CameraImuIterate:
        chain, common = step(self.system, eliminate(self.system, damping))
        return replace(self, state=retract_state(self.state, chain.reshape(-1, STATE), common))


def solve_camera_imu(problem: CameraImuProblem, start: CameraImuState, huber: float | None) -> Solution:
    """Run Levenberg-Marquardt from `start`, with huber as in `linearise_camera_imu`.

    Raises LinAlgError where the body's trajectory is not determined.
    """
    found = minimise(_CameraImuIterate(problem, huber, start), OPTIONS)
    state, linearised = found.best.state, found.best.here
    if huber is not None:
        linearised = linearise_camera_imu(problem, state, None)
    eliminated = eliminate(assemble(linearised.samples, linearised.walks, len(state.spline.places_m)))
    return Solution(state, linearised, eliminated, found.steps, found.converged)


def sensor_spreads(
    problem: CameraImuProblem, solution: Solution, seed: int = 0
) -> tuple[ResidualSpread, ResidualSpread, ResidualSpread]:
    """Estimate the scatter of picture, gyro and accelerometer residuals, corrected for what the fit absorbs.

    The residuals of a picture are its six whitened rows, the joint information of all its corners about the
    pose.

    White noise passed through the same fit shows how much of each sensor's scatter the unknowns absorb (the
    trace of the hat matrix [Hutchinson 1989]) and how the fit correlates the residuals.
    """
    samples = solution.linearised.samples
    rng = np.random.default_rng(seed)
    first = samples.residual.shape[0] - problem.imu.time_s.size
    noise = rng.normal(size=(PROBES, *samples.residual.shape))
    fitted = np.array([_fitted(samples, solution, draw) for draw in noise])
    parts = (
        (slice(0, first), slice(0, ROWS)), (slice(first, None), slice(0, 3)),
        (slice(first, None), slice(3, 6)),
    )  # fmt: skip
    out = []
    for part in parts:
        residual, drawn, taken = samples.residual[part], noise[:, *part], fitted[:, *part]
        absorbed = float((drawn * taken).sum() / PROBES)
        factor = float(np.sqrt((residual**2).sum() / max(residual.size - absorbed, 1.0)))
        expected = np.mean([autocorrelation(one) for one in drawn - taken], axis=0)
        out.append(ResidualSpread(factor, absorbed / residual.size, autocorrelation(residual), expected))
    return out[0], out[1], out[2]


def autocorrelation(series: Float64) -> Float64:
    """Compute the autocorrelation (LAGS,) of a series (S, A), pooled over its axes."""
    power = float((series**2).sum())
    return np.array([float((series[k:] * series[:-k]).sum()) / power for k in range(1, LAGS + 1)])


def _fitted(samples: Samples, solution: Solution, residual: Float64) -> Float64:
    """Project other whitened residuals (K, ROWS) onto the fit's column space."""
    eliminated = solution.eliminated
    chain, common = gradient_of(samples, residual, eliminated.through.shape[0])
    alone = eliminated.chain_solve(chain)
    moved_common = np.linalg.pinv(eliminated.information, hermitian=True) @ (
        common - np.einsum("np,n->p", eliminated.through, chain)
    )
    return apply_jacobian(
        samples, alone - np.einsum("np,p->n", eliminated.through, moved_common), moved_common
    )


def block_scores(samples: Samples, by_common: Float64, block: Int64, blocks: int) -> tuple[Float64, Float64]:
    """Sum the gradient (B, P) and information (B, P, P) of the common parameters over each block of time.

    by_common: (K, ROWS, P) as `project_out_chain` returns it; block: (K,) block index of each sample.
    """
    width = by_common.shape[2]
    score, information = np.zeros((blocks, width)), np.zeros((blocks, width, width))
    order = np.argsort(block, kind="stable")
    edges = np.searchsorted(block[order], np.arange(blocks + 1))
    for number in range(blocks):
        rows = order[edges[number] : edges[number + 1]]
        flat = by_common[rows].reshape(-1, width)
        score[number] = np.einsum("np,n->p", flat, samples.residual[rows].ravel())
        information[number] = np.einsum("np,nq->pq", flat, flat)
    return score, information
