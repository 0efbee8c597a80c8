"""Form and solve the window's normal equations, which are dense.

Order of the unknowns: node by node those of the frames held (pose, with an IMU velocity and biases; nodes
between frames are eliminated first, `gaps`), then the border: with encoders their unknowns and the slide that
all points in view share (`Window.slide`), then the rig's drift.

The encoders' scales are held at zero at first, like the rest of a Schmidt filter's [Schmidt 1966] states that
are only considered: what shows them is kept, so that one that becomes doubtful is known at once.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from barsight.core.arrays import Bool, Float64, Int64
from barsight.core.linalg import dense, skyline
from barsight.core.pose import Pose, skew
from barsight.motion.batch.encoder_scale import possible_scales, weigh_scales
from barsight.motion.linear.chain_elimination import (
    Chain,
    EliminatedNodes,
    add_chain,
    back_substitute_nodes,
    eliminate_nodes,
)
from barsight.motion.linear.schur_complement import (
    NO_PIECES,
    ReducedSystem,
    eliminate_points,
    scatter_reduced,
)
from barsight.motion.problem.attitude_factors import add_attitudes
from barsight.motion.problem.encoder_factors import add_encoders
from barsight.motion.problem.gauss_newton import (
    GraphState,
    linearisation_point,
    observations_of,
    retract,
    rig_of,
)
from barsight.motion.problem.gtsam_factors import build_graph, linearise_chain
from barsight.motion.problem.problem import Problem, encoder_unknowns_of
from barsight.motion.problem.rig_drift import LOOSE, combine_with_prior, drift_prior
from barsight.motion.problem.travel import Scales

SLIDE_SIGMA_RAD = 2.5e-4
"""Standard deviation of the slide common to all points in view: 1 to 4e-4 over stacks, nothing on floors
(`apparent_motion`).
"""
SLIDE_WAY_M = 5.0
"""Travel, m, over which the points in view are replaced and their common slide loses its correlation."""
MIN_WAY_M = 1e-4


@dataclass(frozen=True, eq=False)
class DenseEquations:
    """matrix (n, n) and gradient (n,) of the unknowns; gaps: nodes eliminated beforehand."""

    matrix: Float64
    gradient: Float64
    gaps: tuple[EliminatedNodes, ...]

    def __add__(self, other: DenseEquations) -> DenseEquations:
        return DenseEquations(
            self.matrix + other.matrix, self.gradient + other.gradient, self.gaps + other.gaps
        )


@dataclass(frozen=True, eq=False)
class NewestNode:
    """The last node's covariance (n, n), of pose (body axes), velocity (reference) and biases (accelerometer,
    gyro), with the rig's drift taken as known; drift_jacobian_of_pose (n, 2) of these by the drift.
    by_scales: (6, H) shifts of the pose by what scales that are held may be off; encoders that go on show
    nothing of these.
    """

    covariance: Float64
    drift_jacobian_of_pose: Float64
    by_scales: Float64 | None = None


@dataclass(frozen=True, eq=False)
class WindowSolution:
    """state, slide: after the `step` (n,). drift_covariance: (2, 2), None where the rig is taken as exact.
    scales: of `Problem.scaled`, those held as they would be if they weren't; None where nothing shows them.
    """

    state: GraphState
    slide: float
    step: Float64
    newest: NewestNode
    drift_covariance: Float64 | None
    scales: Scales | None


def border_of(problem: Problem, state: GraphState, slide: float) -> Float64:
    """Collect the border (b,): with encoders their unknowns and the slide, then the drift."""
    slides = [slide] if problem.has_latency else []
    return np.concatenate([encoder_unknowns_of(state.values), slides, state.drift])


def slide_twist(body_from_rect0: Pose) -> Float64:
    """Compute the body's twist (6,) (turn, shift, own axes) per unit of the pictures' turn about the camera's
    axis.
    """
    axis = body_from_rect0.rotation[:, 2]
    return np.concatenate([axis, skew(body_from_rect0.translation) @ axis])


def assemble_equations(
    problem: Problem, state: GraphState, used: Bool, first: int, end: int
) -> DenseEquations:
    """Assemble the equations of the used sightings and of everything else that ties nodes first...end - 1 to
    each other and to node `end`.
    """
    kept, size = problem.retained, problem.width
    last = min(end, len(problem.start) - 1)
    within = kept[(kept >= first) & (kept <= last)]
    chain, gaps = eliminate_nodes(_chain(problem, state, first, end, last), within - first)
    border = problem.encoder_unknowns + (3 if problem.has_latency else 2)
    count = len(kept) * size
    matrix, gradient = np.zeros((count + border, count + border)), np.zeros(count + border)
    if used.any():
        _add_pictures(problem, state, used, matrix, gradient)
    begin = int(np.searchsorted(kept, first)) * size
    columns = slice(begin, begin + chain.gradient.size)
    add_chain(chain, np.arange(columns.start, columns.stop, size), skyline.full(matrix))
    gradient[columns] += chain.gradient.ravel()
    encoders = slice(count, count + problem.encoder_unknowns)
    matrix[encoders, columns] += chain.side.reshape(chain.gradient.size, -1).T
    matrix[encoders, encoders] += np.tril(chain.corner)
    gradient[encoders] += chain.corner_gradient
    matrix += np.tril(matrix, -1).T
    gaps = tuple(replace(gap, first=gap.first + first, end=gap.end + first) for gap in gaps)
    return DenseEquations(matrix, gradient, gaps)


def _chain(problem: Problem, state: GraphState, first: int, end: int, last: int) -> Chain:
    """Linearise the chain of nodes first...last."""
    size = problem.width
    chain = linearise_chain(build_graph(problem, first, end), state.values, size, len(problem.start))
    placed = tuple(place for place in problem.placed if first <= place.node < end)
    add_encoders(chain, replace(problem, placed=placed), state.poses, encoder_unknowns_of(state.values))
    attitudes = tuple(one for one in problem.attitudes if first <= one.node < end)
    own = replace(problem, attitudes=attitudes)
    add_attitudes(chain, own, state.poses, encoder_unknowns_of(state.values))
    return chain.at(slice(first, last + 1))


def _add_pictures(
    problem: Problem, state: GraphState, used: Bool, matrix: Float64, gradient: Float64
) -> None:
    """Add the sightings' equations to the lower half of the matrix."""
    seen, nodes, size = problem.sightings, len(problem.retained), problem.width
    assert seen is not None
    reduced, border = ReducedSystem.empty(nodes, nodes), np.zeros((2, 2))
    eliminate_points(
        rig_of(seen), observations_of(problem, used), linearisation_point(problem, state), reduced
    )
    node = np.arange(nodes) * size
    scatter_reduced(
        reduced, node, NO_PIECES[:, 0], skyline.full(matrix), gradient, matrix[-2:], border, gradient[-2:]
    )
    matrix[-2:, -2:] += np.tril(border)
    if problem.has_latency:
        by_slide = np.zeros(len(gradient))
        by_slide[(node[:, None] + np.arange(6)).ravel()] = np.tile(slide_twist(seen.body_from_rect0), nodes)
        side = (matrix + np.tril(matrix, -1).T) @ by_slide
        matrix[-3] += side
        matrix[-2:, -3] += side[-2:]
        matrix[-3, -3:] = by_slide @ side, 0.0, 0.0
        gradient[-3] += by_slide @ gradient


def prior_equations(problem: Problem, state: GraphState, slide: float) -> DenseEquations:
    """Evaluate the marginal prior at the present state; as long as nothing has been marginalised, the prior
    of the common slide.
    """
    border = border_of(problem, state, slide)
    whole = len(problem.retained) * problem.width + len(border)
    matrix, gradient, prior = np.zeros((whole, whole)), np.zeros(whole), problem.prior
    if prior is not None:
        count = len(prior.matrix) - len(border)
        at = np.concatenate([np.arange(count), np.arange(whole - len(border), whole)])
        since = np.concatenate([prior.since(state.values), border - prior.border])
        matrix[np.ix_(at, at)] = prior.matrix
        gradient[at] = prior.gradient + prior.matrix @ since
    elif problem.has_latency:
        matrix[-3, -3], gradient[-3] = SLIDE_SIGMA_RAD**-2, slide * SLIDE_SIGMA_RAD**-2
    return DenseEquations(matrix, gradient, ())


def solve_step(
    problem: Problem, state: GraphState, slide: float, used: Bool, equations: DenseEquations
) -> WindowSolution:
    """Solve for the full step. Raises LinAlgError where the measurements leave an unknown undetermined."""
    size, matrix = problem.width, equations.matrix.copy()
    matrix[[-2, -1], [-2, -1]] += 1 / np.array(LOOSE) ** 2
    begin = len(problem.retained) * size
    held = begin + _held_places(problem)
    order = np.append(np.delete(np.arange(len(matrix)), held), held)
    whole = dense.cholesky(matrix[np.ix_(order, order)])
    pulled = dense.solve_lower(whole, equations.gradient[order])
    free = len(order) - len(held)
    factor, forward = whole[:free, :free], pulled[:free]
    covariance, by_drift = None, np.zeros(2)
    weighs_drift = problem.offset_prior_px > 0 and bool(used.any())
    if weighs_drift:
        own = factor[-2:, -2:]
        best = state.drift - dense.solve_lower(own, forward[-2:], transposed=True)
        drift = combine_with_prior(best, np.linalg.inv(own @ own.T).astype(np.float64), problem)
        by_drift, covariance = np.array([drift.yaw_rad, drift.scale]) - state.drift, drift.covariance
    left = -forward[:-2] - by_drift @ factor[-2:, :-2]
    step = np.zeros(len(order))
    step[order[:free]] = np.append(dense.solve_lower(factor[:-2, :-2], left, transposed=True), by_drift)
    own = factor[begin - size :, begin - size :]
    information = own @ own.T
    inverse = np.linalg.inv(information[:-2, :-2]).astype(np.float64)
    jacobian = -inverse @ information[:-2, -2:]
    newest = NewestNode(inverse[:size, :size], jacobian[:size])
    slid = float(step[-3]) if problem.has_latency else 0.0
    stepped = _stepped(problem, state, used, step, equations.gaps)
    scales = None
    if weighs_drift and problem.scaled and covariance is not None:
        spread = (inverse + jacobian @ covariance @ jacobian.T)[size:, size:]
        scales = _scales(problem, encoder_unknowns_of(stepped.values), spread)
        if len(held):
            own = whole[free - 2 :, free - 2 :]
            best = -dense.solve_lower(own, pulled[free - 2 :], transposed=True)
            best[:2] += state.drift
            scales = _with_held(problem, scales, best, np.linalg.inv(own @ own.T).astype(np.float64))
            newest = _widened(problem, newest, scales, whole[begin - size :, begin - size :])
    return WindowSolution(stepped, slide + slid, step, newest, covariance, scales)


def _held_places(problem: Problem) -> Int64:
    """Return the places in the border of the scales that are held."""
    if not problem.has_latency:
        return np.empty(0, np.int64)
    places: Int64 = problem.scale_places.start + np.flatnonzero(np.isin(problem.scaled, problem.held))
    return places


def _scales(problem: Problem, unknowns: Float64, covariance: Float64) -> Scales:
    """Read the scales that aren't held from the encoders' unknowns (S,). covariance: of the border without
    those held.
    """
    free = np.flatnonzero(~np.isin(problem.scaled, problem.held))
    spread, at = np.zeros((len(problem.scaled),) * 2), problem.scale_places.start + np.arange(len(free))
    spread[np.ix_(free, free)] = covariance[np.ix_(at, at)]
    return Scales(unknowns[problem.scale_places], spread)


def _with_held(problem: Problem, scales: Scales, best: Float64, covariance: Float64) -> Scales:
    """Add the scales that are held. best, covariance: (2 + H,) of the rig's drift and of these, as the
    equations alone would have them.
    """
    held = np.flatnonzero(np.isin(problem.scaled, problem.held))
    last = np.roll(np.arange(len(best)), -2)
    found = weigh_scales(problem, best[last], covariance[np.ix_(last, last)])
    value, spread = scales.value.copy(), scales.covariance.copy()
    value[held], spread[np.ix_(held, held)] = found.value, found.covariance
    return Scales(value, spread)


def _stepped(
    problem: Problem, state: GraphState, used: Bool, step: Float64, gaps: tuple[EliminatedNodes, ...]
) -> GraphState:
    size, count = problem.width, len(problem.retained)
    encoders = step[count * size :][: problem.encoder_unknowns]
    by_node = step[: count * size].reshape(count, size)
    by_node = back_substitute_nodes(by_node, encoders, problem.retained, gaps, len(problem.start))
    pictures = by_node[problem.retained, :6]
    if problem.has_latency and problem.sightings is not None:
        pictures = pictures + step[-3] * slide_twist(problem.sightings.body_from_rect0)
    border = np.concatenate([encoders, step[-2:]])
    return retract(problem, state, used, by_node, np.empty(0), border, pictures)


def _widened(problem: Problem, newest: NewestNode, scales: Scales, factor: Float64) -> NewestNode:
    """Add to the last node by how much scales that are held may be shifting it. factor: of the last node, the
    border, and the scales that are held.
    """
    at = np.flatnonzero(np.isin(problem.scaled, problem.held))
    off = possible_scales(problem, problem.held, scales.chosen(at))
    if not off.any():
        return newest
    information = factor @ factor.T
    free = len(information) - len(off)
    own = information[:free, :free]
    own[[-2, -1], [-2, -1]] += drift_prior(problem) ** -2.0
    moved = -np.linalg.solve(own, information[:free, free:])[: len(newest.covariance)] * off
    return replace(newest, by_scales=moved[:6].astype(np.float64))


def marginal_prior(left: DenseEquations, step: Float64, count: int) -> tuple[Float64, Float64]:
    """Marginalise the first `count` unknowns: matrix and gradient of all others, after the step."""
    matrix, slope = left.matrix, left.gradient + left.matrix @ step
    gain = dense.solve_positive(matrix[:count, :count], matrix[:count, count:]).T
    own = matrix[count:, count:] - gain @ matrix[:count, count:]
    return (own + own.T) / 2, slope[count:] - gain @ slope[:count]


def propagate_slide(
    matrix: Float64, gradient: Float64, slide: float, way_m: float
) -> tuple[Float64, Float64]:
    """Propagate the slide in a prior's matrix and gradient over a path: a share of it persists, the rest is
    drawn anew [Uhlenbeck and Ornstein 1930].
    """
    keeps = float(np.exp(-max(way_m, MIN_WAY_M) / SLIDE_WAY_M))
    fresh = 1 / ((1 - keeps**2) * SLIDE_SIGMA_RAD**2)
    old = matrix[-3, -3] + keeps**2 * fresh
    side, pull = matrix[-3].copy(), gradient[-3] - keeps * (1 - keeps) * slide * fresh
    side[-3] = -keeps * fresh
    matrix, gradient = matrix.copy(), gradient.copy()
    matrix[-3], matrix[:, -3], gradient[-3] = 0.0, 0.0, (1 - keeps) * slide * fresh
    matrix[-3, -3] = fresh
    return matrix - np.outer(side, side / old), gradient - side * (pull / old)
