"""Optimise all unknowns by Levenberg-Marquardt: points eliminated by kernels, the rest linearised by GTSAM.

The unknowns are in the order of `layout`, so the matrix is a band as wide as the longest track. The encoders'
unknowns, the slide common to all pieces of the yard and the rig's drift are coupled to many nodes and form
its border.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, E, V, X

from barsight.core.arrays import Bool, Float64
from barsight.core.linalg.levenberg_marquardt import Options, Termination, minimise
from barsight.core.linalg.skyline import Skyline
from barsight.motion.linear.chain_elimination import add_chain, eliminate_nodes
from barsight.motion.linear.ordering import Ordering
from barsight.motion.linear.reprojection_kernels import LinearisationPoint, Observations, Rig, residuals
from barsight.motion.linear.schur_complement import (
    ReducedSystem,
    back_substitute,
    eliminate_points,
    scatter_reduced,
)
from barsight.motion.problem.attitude_factors import add_attitudes, attitudes_cost
from barsight.motion.problem.encoder_factors import add_encoders, encoders_cost
from barsight.motion.problem.gtsam_factors import linearise_chain
from barsight.motion.problem.normal_equations import System
from barsight.motion.problem.problem import Pieces, Problem, StereoObservations, encoder_unknowns_of, poses_of
from barsight.motion.problem.rig_drift import HUBER_SIGMAS

MAX_ITERATIONS = 25
RELATIVE_GAIN = 1e-5


@dataclass(frozen=True, eq=False)
class GraphState:
    """values: GTSAM's, of all unknowns but the points (T, 4; the fourth is a point's slide, rad), the rig's
    drift (2,) and the pieces' (2 S,): slides, rad, and disparity biases, px.
    """

    values: Any
    points: Float64
    drift: Float64
    pieces: Float64 = field(default_factory=lambda: np.zeros(0))

    @cached_property
    def poses(self) -> Float64:
        """Return reference_from_body (M, 4, 4)."""
        return poses_of(self.values)


def rig_of(seen: StereoObservations) -> Rig:
    """Convert the cameras to the kernels' form."""
    c = seen.camera
    lens = np.array([c.focal_px, c.cx_px, c.cy_px, c.focal_px * c.baseline_m, c.doffs_px])
    mount = seen.body_from_rect0
    return Rig(lens, np.ascontiguousarray(mount.matrix[:3]), HUBER_SIGMAS)


def observations_of(problem: Problem, used: Bool) -> Observations:
    """Convert the sightings to the kernels' form."""
    seen = problem.sightings
    assert seen is not None
    scale = 1.0 if problem.sees_scale else 0.0
    points, pieces = len(seen.first) - 1, problem.pieces
    piece, tight = np.zeros(points, np.int64), np.zeros(points)
    if pieces is not None:
        piece, tight = pieces.piece, 1 / pieces.own_sigma_rad[pieces.piece]
    return Observations(
        seen.first, problem.places[seen.node], used, seen.stereo, 1 / seen.sigma_px, piece, tight, scale
    )


def linearisation_point(problem: Problem, state: GraphState) -> LinearisationPoint:
    """Convert the state to the kernels' form."""
    assert problem.sightings is not None
    left = state.poses[problem.retained] @ problem.sightings.body_from_rect0.matrix
    turn = left[:, :3, :3].transpose(0, 2, 1)
    camera = np.concatenate([turn, -turn @ left[:, :3, 3:]], axis=2)
    return LinearisationPoint(camera, state.points, np.concatenate([state.pieces, state.drift]))


def sighting_residuals(problem: Problem, state: GraphState, used: Bool) -> Float64:
    """Compute residuals (N, 3) px, seen minus predicted, 0 where unused."""
    assert problem.sightings is not None
    result = np.zeros((len(used), 3))
    residuals(
        rig_of(problem.sightings), observations_of(problem, used), linearisation_point(problem, state), result
    )
    return result


@dataclass(frozen=True, eq=False)
class _PoseIterate:
    """State with its cost and its system, made on first use and released with it: two are never held."""

    problem: Problem
    graph: Any
    used: Bool
    state: GraphState

    @cached_property
    def cost(self) -> float:
        return cost_of(self.problem, self.graph, self.state, self.used)

    @cached_property
    def system(self) -> System:
        return linearise_graph(self.problem, self.graph, self.state, self.used)

    def step(self, damping: float) -> _PoseIterate:
        step = self.system.step(self.problem.free, damping)
        return replace(self, state=retract(self.problem, self.state, self.used, *step))


def optimise_graph(
    problem: Problem,
    graph: Any,
    state: GraphState,
    used: Bool,
    max_steps: int = MAX_ITERATIONS,
    min_gain: float = RELATIVE_GAIN,
) -> tuple[GraphState, System]:
    """Find the state that fits best, and its system, by Levenberg-Marquardt.

    graph: GTSAM's factors of everything but sightings, encoders and attitudes. The rig's drift is kept fixed.
    min_gain: relative decrease of the cost from which a step is followed by another. Raises LinAlgError where
    the measurements leave an unknown undetermined.
    """
    found = minimise(_PoseIterate(problem, graph, used, state), Options(max_steps, min_gain, 0.0, 1e-5, 1e6))
    if found.termination is Termination.SINGULAR:
        raise np.linalg.LinAlgError("the measurements leave an unknown undetermined")
    return found.best.state, found.best.system


def linearise_graph(problem: Problem, graph: Any, state: GraphState, used: Bool) -> System:
    """Form the normal equations at a state."""
    layout, border, seen = problem.layout, problem.border, problem.sightings
    rows, size = layout.zeros(), len(layout.first)
    gradient, side = np.zeros(size), np.zeros((border, size))
    corner, corner_gradient = np.zeros((border, border)), np.zeros(border)
    whole = linearise_chain(graph, state.values, layout.size, len(problem.start))
    add_encoders(whole, problem, state.poses, encoder_unknowns_of(state.values))
    add_attitudes(whole, problem, state.poses, encoder_unknowns_of(state.values))
    chain, gaps = eliminate_nodes(whole, problem.retained)
    add_chain(chain, layout.node, rows)
    gradient[layout.nodes] = chain.gradient.ravel()
    own = slice(problem.encoder_unknowns)
    side[own, layout.nodes] = chain.side.reshape(len(layout.nodes), -1).T
    corner[own, own], corner_gradient[own] = chain.corner, chain.corner_gradient
    if seen is not None and used.any():
        reduced = ReducedSystem.empty(len(layout.node), layout.reach, layout.seen)
        eliminate_points(
            rig_of(seen), observations_of(problem, used), linearisation_point(problem, state), reduced
        )
        scatter_reduced(reduced, layout.node, layout.piece, rows, gradient, side, corner, corner_gradient)
    if problem.pieces is not None:
        _hold_pieces(problem.pieces, state.pieces, layout, rows, gradient, side, corner)
    return System(
        rows, gradient, side, corner, corner_gradient, layout, problem.retained, gaps, len(problem.start),
        problem.encoder_unknowns,
    )  # fmt: skip


def _hold_pieces(
    pieces: Pieces, unknowns: Float64, layout: Ordering, rows: Skyline, gradient: Float64, side: Float64,
    corner: Float64,
) -> None:  # fmt: skip
    """Add the prior of `Pieces.cost`.

    The common slide, the border's last unknown before the drift, is at its optimum.
    """
    sigma, (slides, disparities) = pieces.slide_sigma_rad, np.split(unknowns, 2)
    slide, disparity = layout.piece, layout.piece + 1
    rows.values[rows.offset[slide] + slide] += 2 / sigma**2
    rows.values[rows.offset[disparity] + disparity] += 1 / pieces.disparity_sigma_px**2
    gradient[slide] += 2 * (slides / sigma - pieces.common(unknowns)) / sigma
    gradient[disparity] += disparities / pieces.disparity_sigma_px**2
    side[-3, slide] -= 2 / sigma
    corner[-3, -3] += 2 * (pieces.count + 1)


def retract(
    problem: Problem, state: GraphState, used: Bool, step: Float64, pieces: Float64, border: Float64,
    seen_step: Float64 | None = None,
) -> GraphState:  # fmt: skip
    """Retract a step of the nodes', the pieces' and the border's unknowns; the points are back-substituted.
    seen_step: (K, 6) the poses' step as the pictures see it, where it differs.
    """
    by_node = step.reshape(len(problem.start), -1)
    vectors = gtsam.VectorValues()
    for k, part in enumerate(by_node):
        vectors.insert(X(k), part[:6])
        if problem.has_imu:
            vectors.insert(V(k), part[6:9])
            vectors.insert(B(k), part[9:])
    if problem.has_latency:
        vectors.insert(E(0), border[: problem.encoder_unknowns])
    points, shared = state.points, np.concatenate([pieces, border[-2:]])
    if problem.sightings is not None:
        points = points.copy()
        poses = np.ascontiguousarray(by_node[problem.retained, :6] if seen_step is None else seen_step)
        rig, observations = rig_of(problem.sightings), observations_of(problem, used)
        back_substitute(
            rig,
            observations,
            linearisation_point(problem, state),
            poses,
            shared,
            points,
            np.empty(len(points)),
        )
    return replace(
        state, values=state.values.retract(vectors), points=points, drift=state.drift + border[-2:],
        pieces=state.pieces + pieces,
    )  # fmt: skip


def cost_of(problem: Problem, graph: Any, state: GraphState, used: Bool) -> float:
    cost = float(graph.error(state.values)) + encoders_cost(state.values, problem)
    cost += attitudes_cost(state.values, problem)
    if problem.pieces is not None:
        cost += problem.pieces.cost(state.pieces)
    if problem.sightings is None:
        return cost
    seen, guess = problem.sightings, linearisation_point(problem, state)
    return cost + residuals(rig_of(seen), observations_of(problem, used), guess, np.zeros((len(used), 3)))
