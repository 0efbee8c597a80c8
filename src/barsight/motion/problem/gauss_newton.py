"""Gauss-Newton over all unknowns: points taken out by kernels, the rest linearised by GTSAM.

Unknowns stand as `layout` has them, so the matrix is a band as wide as the longest track; the encoders'
latency, what all pieces of the yard share and the rig's drift touch many nodes and stand at its border.
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
from barsight.core.linalg.skyline import Band
from barsight.motion.linear import skyline
from barsight.motion.linear.chain_elimination import without_gaps
from barsight.motion.linear.ordering import Layout
from barsight.motion.linear.reprojection_kernels import Guess, Rig, Sights, residuals
from barsight.motion.linear.schur_complement import Reduced, eliminate, spread, substitute
from barsight.motion.problem.encoder_factors import add_encoders, encoders_cost
from barsight.motion.problem.gtsam_factors import chain_of
from barsight.motion.problem.normal_equations import System
from barsight.motion.problem.problem import Pieces, Problem, StereoSightings, latency_of, poses_of
from barsight.motion.problem.rig_drift import HUBER_SIGMAS

MOST_ITERATIONS = 25
RELATIVE_GAIN = 1e-5


@dataclass(frozen=True, eq=False)
class State:
    """values: GTSAM's, of all but the points (T, 4; the fourth is a point's slide, rad), the rig's
    drift (2,) and of the pieces (2 S,) the slides, rad, and what their disparities are too large by, px."""

    values: Any
    points: Float64
    drift: Float64
    pieces: Float64 = field(default_factory=lambda: np.zeros(0))

    @cached_property
    def poses(self) -> Float64:
        """(M, 4, 4) reference_from_body."""
        return poses_of(self.values)


def rig_of(seen: StereoSightings) -> Rig:
    """The cameras as the kernels take them."""
    c = seen.camera
    lens = np.array([c.focal_px, c.cx_px, c.cy_px, c.focal_px * c.baseline_m, c.doffs_px])
    mount = seen.body_from_rect0
    return Rig(lens, np.ascontiguousarray(mount.matrix[:3]), HUBER_SIGMAS)


def sights_of(problem: Problem, used: Bool) -> Sights:
    """The sightings as the kernels take them."""
    seen = problem.sightings
    assert seen is not None
    scale = 1.0 if problem.sees_scale else 0.0
    points, pieces = len(seen.first) - 1, problem.pieces
    piece, tight = np.zeros(points, np.int64), np.zeros(points)
    if pieces is not None:
        piece, tight = pieces.piece, 1 / pieces.own_sigma_rad[pieces.piece]
    return Sights(
        seen.first, problem.places[seen.node], used, seen.stereo, 1 / seen.sigma_px, piece, tight, scale
    )


def guess_of(problem: Problem, state: State) -> Guess:
    """The state as the kernels take it."""
    assert problem.sightings is not None
    left = state.poses[problem.kept] @ problem.sightings.body_from_rect0.matrix
    turn = left[:, :3, :3].transpose(0, 2, 1)
    camera = np.concatenate([turn, -turn @ left[:, :3, 3:]], axis=2)
    return Guess(camera, state.points, np.concatenate([state.pieces, state.drift]))


def sighting_residuals(problem: Problem, state: State, used: Bool) -> Float64:
    """(N, 3) px seen minus predicted, 0 where unused."""
    assert problem.sightings is not None
    result = np.zeros((len(used), 3))
    residuals(rig_of(problem.sightings), sights_of(problem, used), guess_of(problem, state), result)
    return result


@dataclass(frozen=True, eq=False)
class _Iterate:
    """A state, its cost and, made on use and let go with it, its system: never are two held."""

    problem: Problem
    graph: Any
    used: Bool
    state: State

    @cached_property
    def cost(self) -> float:
        return cost_of(self.problem, self.graph, self.state, self.used)

    @cached_property
    def system(self) -> System:
        return linearise(self.problem, self.graph, self.state, self.used)

    def step(self, damping: float) -> _Iterate:
        step = self.system.step(self.problem.free, damping)
        return replace(self, state=moved(self.problem, self.state, self.used, *step))


def optimise(
    problem: Problem,
    graph: Any,
    state: State,
    used: Bool,
    most: int = MOST_ITERATIONS,
    least_gain: float = RELATIVE_GAIN,
) -> tuple[State, System]:
    """Find the state that fits best, and its system, by Levenberg-Marquardt.

    graph: GTSAM's factors of all but sightings and encoders. The rig's drift stays. least_gain: the share of
    the cost that a step must save for another to follow. Raises LinAlgError where the measurements leave an
    unknown undetermined.
    """
    found = minimise(_Iterate(problem, graph, used, state), Options(most, least_gain, 0.0, 1e-5, 1e6))
    if found.termination is Termination.SINGULAR:
        raise np.linalg.LinAlgError("the measurements leave an unknown undetermined")
    return found.best.state, found.best.system


def linearise(problem: Problem, graph: Any, state: State, used: Bool) -> System:
    """The system at a state."""
    layout, border, seen = problem.layout, problem.border, problem.sightings
    rows, size = layout.zeros(), len(layout.first)
    gradient, side = np.zeros(size), np.zeros((border, size))
    corner, corner_gradient = np.zeros((border, border)), np.zeros(border)
    whole = chain_of(graph, state.values, layout.size, len(problem.start))
    add_encoders(whole, problem, state.poses, latency_of(state.values))
    chain, gaps = without_gaps(whole, problem.kept)
    skyline.add_chain(chain.rows, layout.node, rows)
    gradient[layout.nodes] = chain.gradient
    if problem.has_latency:
        side[0, layout.nodes] = chain.side
        corner[0, 0], corner_gradient[0] = chain.corner, chain.corner_gradient
    if seen is not None and used.any():
        reduced = Reduced.empty(len(layout.node), layout.reach, layout.seen)
        eliminate(rig_of(seen), sights_of(problem, used), guess_of(problem, state), reduced)
        spread(reduced, layout.node, layout.piece, rows, gradient, side, corner, corner_gradient)
    if problem.pieces is not None:
        _hold_pieces(problem.pieces, state.pieces, layout, rows, gradient, side, corner)
    return System(
        rows, gradient, side, corner, corner_gradient, layout, problem.kept, gaps, len(problem.start),
        problem.has_latency,
    )  # fmt: skip


def _hold_pieces(
    pieces: Pieces, unknowns: Float64, layout: Layout, rows: Band, gradient: Float64, side: Float64,
    corner: Float64,
) -> None:  # fmt: skip
    """Adds what `Pieces.cost` says. What slides have in common, the border's last but the drift, is where it
    costs least."""
    sigma, (slides, disparities) = pieces.slide_sigma_rad, np.split(unknowns, 2)
    slide, disparity = layout.piece, layout.piece + 1
    rows.values[rows.offset[slide] + slide] += 2 / sigma**2
    rows.values[rows.offset[disparity] + disparity] += 1 / pieces.disparity_sigma_px**2
    gradient[slide] += 2 * (slides / sigma - pieces.common(unknowns)) / sigma
    gradient[disparity] += disparities / pieces.disparity_sigma_px**2
    side[-3, slide] -= 2 / sigma
    corner[-3, -3] += 2 * (pieces.count + 1)


def moved(
    problem: Problem, state: State, used: Bool, step: Float64, pieces: Float64, border: Float64,
    seen_step: Float64 | None = None,
) -> State:  # fmt: skip
    """The state after a step of the nodes', the pieces' and the border's unknowns; the points follow.
    seen_step: (K, 6) by which pictures move, where not as the poses do.
    """
    by_node = step.reshape(len(problem.start), -1)
    vectors = gtsam.VectorValues()
    for k, part in enumerate(by_node):
        vectors.insert(X(k), part[:6])
        if problem.has_imu:
            vectors.insert(V(k), part[6:9])
            vectors.insert(B(k), part[9:])
    if problem.has_latency:
        vectors.insert(E(0), border[:1])
    points, shared = state.points, np.concatenate([pieces, border[-2:]])
    if problem.sightings is not None:
        points = points.copy()
        poses = np.ascontiguousarray(by_node[problem.kept, :6] if seen_step is None else seen_step)
        rig, sights = rig_of(problem.sightings), sights_of(problem, used)
        substitute(rig, sights, guess_of(problem, state), poses, shared, points, np.empty(len(points)))
    return replace(
        state, values=state.values.retract(vectors), points=points, drift=state.drift + border[-2:],
        pieces=state.pieces + pieces,
    )  # fmt: skip


def cost_of(problem: Problem, graph: Any, state: State, used: Bool) -> float:
    cost = float(graph.error(state.values)) + encoders_cost(state.values, problem)
    if problem.pieces is not None:
        cost += problem.pieces.cost(state.pieces)
    if problem.sightings is None:
        return cost
    seen, guess = problem.sightings, guess_of(problem, state)
    return cost + residuals(rig_of(seen), sights_of(problem, used), guess, np.zeros((len(used), 3)))
