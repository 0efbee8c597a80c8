"""Solve a window by one step and marginalise what leaves it.

The earlier frames are solved already. So the newest one is placed by the known points beforehand, and
outliers are removed. What leaves is linearised once, together with the rest, and stays as a prior.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, E, V, X

from barsight.core.arrays import Bool, Float64
from barsight.core.linalg import dense
from barsight.core.pose import Pose
from barsight.motion.batch.bundle_adjustment import MIN_AGREEING, robust_noise
from barsight.motion.batch.encoder_scale import doubtful_axes
from barsight.motion.fixed_lag.sliding_window import Window
from barsight.motion.fixed_lag.window_equations import (
    DenseEquations,
    assemble_equations,
    border_of,
    marginal_prior,
    prior_equations,
    propagate_slide,
    solve_step,
)
from barsight.motion.linear.motion_only_kernel import frame_equations
from barsight.motion.linear.schur_complement import back_substitute
from barsight.motion.problem.encoder_factors import encoder_inliers
from barsight.motion.problem.gauss_newton import (
    GraphState,
    linearisation_point,
    observations_of,
    rig_of,
    sighting_residuals,
)
from barsight.motion.problem.problem import MarginalPrior, Problem
from barsight.motion.problem.stereo_factors import (
    spatial_inflation,
    temporal_inflation,
    well_observed,
)

NOISE_RATIO = 0.2
"""Weight of a single window's noise in the running estimate of the noise."""
MIN_POINTS = 30
"""Minimum number of known points seen again for the newest frame to be placed before the window is solved."""
STEPS = 2
"""Number of Gauss-Newton steps for the newest frame alone."""


@dataclass(frozen=True, eq=False)
class MarginalisedPart:
    """Part of a window to marginalise: the first `nodes` nodes and the points `ended` (T,), with their
    equations and the step taken since.
    """

    nodes: int
    ended: Bool
    equations: DenseEquations
    step: Float64


@dense.one_blas_thread()
def solve_window(window: Window, held: int) -> tuple[Window, MarginalisedPart | None]:
    """Solve the window, and select what must leave for `held` frames to remain. Raises LinAlgError where the
    measurements leave an unknown undetermined.
    """
    problem = replace(window.problem, asked=np.array(window.frame_nodes))
    state, noise, stated = window.state, window.noise, problem.sightings
    used = np.zeros(0, np.bool_)
    if stated is not None:
        problem = replace(problem, sightings=replace(stated, sigma_px=(noise or 1.0) * stated.sigma_px))
        used = well_observed(stated, np.ones(len(stated.node), np.bool_))
    if stated is not None and used.any():
        state = _placed_by_points(problem, state, used)
        residual = sighting_residuals(problem, state, used)
        factor, used = robust_noise(residual, stated, used)
        shown = replace(stated, sigma_px=factor * stated.sigma_px)
        now = factor * temporal_inflation(residual, shown, used) * spatial_inflation(residual, shown, used)
        noise = now if noise is None else (1 - NOISE_RATIO) * noise + NOISE_RATIO * now
        problem = replace(problem, sightings=replace(stated, sigma_px=noise * stated.sigma_px))
    count = window.frame_nodes[-held] if len(window.frame_nodes) > held else 0
    ended = np.zeros(len(window.names), np.bool_)
    equations = prior_equations(problem, state, window.slide)
    leaving: MarginalisedPart | None = None
    goes = np.zeros_like(used)
    if count:
        if stated is not None:
            ended[stated.track[stated.node < count]] = True
            goes = ended[stated.track]
        equations = left = equations + assemble_equations(problem, state, used & goes, 0, count)
    equations = equations + assemble_equations(problem, state, used & ~goes, count, len(problem.start))
    found = solve_step(problem, state, window.slide, used, equations)
    at = [problem.scaled.index(axis) for axis in problem.held]
    doubtful = doubtful_axes(problem, problem.held, found.scales and found.scales.chosen(at))
    if doubtful:
        problem = replace(problem, held=tuple(axis for axis in problem.held if axis not in doubtful))
        found = solve_step(problem, state, window.slide, used, equations)
    if count:
        leaving = MarginalisedPart(count, ended, left, found.step)
    fits = encoder_inliers(found.state.values, problem)
    kept = tuple(place for place, fit in zip(problem.placed, fits, strict=True) if fit)
    if len(kept) <= MIN_AGREEING * len(problem.placed):
        kept = problem.placed
    if stated is not None:
        mounting = _about_axis(stated.body_from_rect0, found.slide - window.slide)
        stated = replace(stated, body_from_rect0=mounting)
    result = replace(
        window, problem=replace(window.problem, placed=kept, sightings=stated, held=problem.held),
        state=found.state, scales=found.scales or window.scales,
        slide=found.slide, noise=noise, drift_covariance=found.drift_covariance, newest=found.newest,
    )  # fmt: skip
    return result, leaving


def _about_axis(body_from_rect0: Pose, angle: float) -> Pose:
    """Turn the camera about its own axis."""
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return replace(body_from_rect0, rotation=body_from_rect0.rotation @ turn)


def _placed_by_points(problem: Problem, state: GraphState, used: Bool) -> GraphState:
    """Place the newest frame by the known points, then the points that it sees by all frames."""
    seen, node = problem.sightings, len(problem.start) - 1
    assert seen is not None
    rig, observations = rig_of(seen), observations_of(problem, used)
    if (seen.node[used] == node).sum() >= MIN_POINTS:
        values = gtsam.Values(state.values)
        for _ in range(STEPS):
            normal, gradient = np.zeros((6, 6)), np.zeros(6)
            frame_equations(
                rig,
                observations,
                linearisation_point(problem, state),
                len(problem.retained) - 1,
                normal,
                gradient,
            )
            values.update(X(node), values.atPose3(X(node)).retract(-dense.solve_positive(normal, gradient)))
            state = replace(state, values=values)
    points, still = state.points.copy(), np.zeros((len(problem.retained), 6))
    shown = np.zeros(len(points), np.bool_)
    shown[seen.track[seen.node == node]] = True
    observations = observations._replace(used=used & shown[seen.track])
    back_substitute(
        rig,
        observations,
        linearisation_point(problem, state),
        still,
        np.zeros(2),
        points,
        np.empty(len(points)),
    )
    return replace(state, points=points)


@dense.one_blas_thread()
def marginalise(window: Window, leaving: MarginalisedPart) -> Window:
    """Marginalise the part that leaves."""
    problem, count = window.problem, leaving.nodes
    stayed = np.array([k - count for k in window.frame_nodes if k >= count])
    gone = len(window.frame_nodes) - len(stayed)
    matrix, gradient = marginal_prior(leaving.equations, leaving.step, gone * problem.width)
    if problem.has_latency:
        way = window.state.poses[count, :3, 3] - window.state.poses[0, :3, 3]
        matrix, gradient = propagate_slide(matrix, gradient, window.slide, float(np.linalg.norm(way)))
    values, border = _renumbered(window.state, problem, count), border_of(problem, window.state, window.slide)
    prior = MarginalPrior(stayed, values, border, matrix, gradient)
    seen, names, points = problem.sightings, window.names, window.state.points
    if seen is not None:
        stays, place = ~leaving.ended[seen.track], np.cumsum(~leaving.ended) - 1
        seen = replace(
            seen, node=seen.node[stays] - count, track=place[seen.track[stays]], stereo=seen.stereo[stays],
            sigma_px=seen.sigma_px[stays],
        )  # fmt: skip
        names, points = names[~leaving.ended], points[~leaving.ended]
    left = replace(
        problem, start=problem.start[count:], stamp_ns=problem.stamp_ns[count:],
        preintegrated=problem.preintegrated[count:], prior=prior, sightings=seen,
        placed=tuple(replace(p, node=p.node - count) for p in problem.placed if p.node >= count),
        attitudes=tuple(replace(a, node=a.node - count) for a in problem.attitudes if a.node >= count),
        still=tuple(k - count for k in problem.still if k >= count),
    )  # fmt: skip
    return replace(
        window, problem=left, state=replace(window.state, values=values, points=points), names=names,
        frame_nodes=tuple(stayed.tolist()),
    )  # fmt: skip


def _renumbered(state: GraphState, problem: Problem, count: int) -> gtsam.Values:
    nodes = range(count, len(problem.start))
    values = gtsam.Values()
    if problem.has_imu:
        biases = gtsam.VectorValues()
        for k in nodes:
            biases.insert(B(k - count), state.values.atConstantBias(B(k)).vector())
        values = _no_biases(len(nodes)).retract(biases)
    for k in nodes:
        values.insert(X(k - count), state.values.atPose3(X(k)))
        if problem.has_imu:
            values.insert(V(k - count), state.values.atVector(V(k)))
    if problem.has_latency:
        values.insert(E(0), state.values.atVector(E(0)))
    return values


@cache
def _no_biases(count: int) -> gtsam.Values:
    """Make zero biases to which vectors are added: inserting a bias itself takes thirty times as long."""
    values = gtsam.Values()
    for k in range(count):
        values.insert(B(k), gtsam.imuBias.ConstantBias())
    return values
