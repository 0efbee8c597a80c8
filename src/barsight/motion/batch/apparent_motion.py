"""Model apparent slides and disparity biases of strips of the yard (ribs and gloss).

A ribbed bar is a screw: seen from further along, the side that faces the camera shows other ribs, which seem
to have slid along the bar; highlights do the same to mill scale. In the picture such a point turns about the
camera's axis, by 4e-4 rad where there are ribs: a tenth of a pixel over 250 px of travel. The points of a
bundle slide alike, which can't be told from a heading error. So slides are unknowns: one for each piece of
the yard, and each point's relative to its piece's. Their size is learnt from the recording: floors don't
slide, so they dominate.

A highlight on a round bar is the image of a lamp that lies behind the bar, so gloss also biases the
disparity, by 0.01 px on the pieces of a stack and not at all on floors. The travel known from encoders and
gyro fixes a point's position without the disparity, so each piece's disparity bias is an unknown too.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from barsight.core.arrays import Bool
from barsight.motion.linear.schur_complement import back_substitute
from barsight.motion.problem.gauss_newton import (
    GraphState,
    linearisation_point,
    observations_of,
    optimise_graph,
    rig_of,
)
from barsight.motion.problem.gtsam_factors import build_graph
from barsight.motion.problem.marginals import slide_variances
from barsight.motion.problem.normal_equations import System
from barsight.motion.problem.problem import Pieces, Problem

LENGTH_RATIO = 0.2
HEIGHT_RATIO = 0.07
"""Length of a piece along the path and its height, both as ratios to the points' median range."""
FIRST_SIGMA_RAD = 2e-4
MIN_SIGMA_RAD = 5e-6
FIRST_SIGMA_PX = 0.005
MIN_PIECES = 4
MIN_SEEN = 4
"""Minimum number of sightings of a point from which it counts for how far points slide."""
PRIOR_POINTS = 5
"""Weight, in points, of the mean square slide over all pieces as a prior for that of a single piece."""
PRIOR_PIECES = 2
"""Weight, in pieces, of `FIRST_SIGMA_PX` as a prior for the sigma of the pieces' disparity biases."""
ROUNDS = 3
STEPS = 2
"""Maximum optimisation steps in a round; each round starts where the previous one ended."""


def partition_points(problem: Problem, state: GraphState, used: Bool) -> Pieces | None:
    """Partition the points into strips across the path and by height. None without encoders, where there
    are too few strips, or where fewer points than strips are seen often enough to tell how far they slide.
    """
    seen = problem.sightings
    if seen is None or not problem.has_latency:
        return None
    camera = seen.camera
    disparity = float(np.median(seen.stereo[:, 0] - seen.stereo[:, 2] + camera.doffs_px))
    range_m = camera.focal_px * camera.baseline_m / disparity
    place = np.array([pose.translation for pose in problem.start])
    _, _, axes = np.linalg.svd(place - place.mean(axis=0), full_matrices=False)
    along = np.floor(state.points[:, :3] @ axes[0] / (LENGTH_RATIO * range_m))
    up = np.floor(state.points[:, 2] / (HEIGHT_RATIO * range_m) + 0.5)
    names, piece = np.unique(np.column_stack([along, up]), axis=0, return_inverse=True)
    telling = int((np.bincount(seen.track[used]) >= MIN_SEEN).sum())
    if len(names) < MIN_PIECES or telling < len(names):
        return None
    return Pieces(piece.ravel().astype(np.int64), np.full(len(names), FIRST_SIGMA_RAD), 0.5, FIRST_SIGMA_PX)


def solve_with_slides(
    problem: Problem, state: GraphState, used: Bool, rounds: int = ROUNDS
) -> tuple[Problem, GraphState, System]:
    """Solve with slides and disparity biases as unknowns and re-estimate their sigmas in each round by EM
    [Dempster 1977]; for the disparities by MacKay's update [MacKay 1992], which is faster where there is
    little to find.
    """
    pieces = problem.pieces or partition_points(problem, state, used)
    graph = build_graph(problem)
    if pieces is None:
        return problem, *optimise_graph(problem, graph, state, used)
    if not len(state.pieces):
        state = replace(state, pieces=np.zeros(2 * pieces.count))
    for left in reversed(range(rounds)):
        problem = replace(problem, pieces=pieces)
        state, system = optimise_graph(problem, graph, state, used, max_steps=STEPS)
        pieces = _learnt(problem, state, system, pieces, used)
        if left:
            del system
    return problem, state, system


def _learnt(problem: Problem, state: GraphState, system: System, pieces: Pieces, used: Bool) -> Pieces:
    seen = problem.sightings
    assert seen is not None
    variance = np.zeros(len(state.points))
    still, guess = np.zeros((len(problem.retained), 6)), linearisation_point(problem, state)
    none, points = np.zeros(2 * pieces.count + 2), state.points.copy()
    back_substitute(rig_of(seen), observations_of(problem, used), guess, still, none, points, variance)
    counts = np.bincount(seen.track[used], minlength=len(variance))
    good = counts >= MIN_SEEN
    slides, disparities = np.split(state.pieces, 2)
    square = (points[:, 3] - slides[pieces.piece]) ** 2 + variance
    everywhere = square[good].mean()
    total = np.bincount(pieces.piece[good], square[good], pieces.count) + PRIOR_POINTS * everywhere
    own = np.sqrt(total / (np.bincount(pieces.piece[good], minlength=pieces.count) + PRIOR_POINTS))
    own = np.maximum(own, MIN_SIGMA_RAD)
    spread, in_all = slide_variances(system, np.concatenate([1 / own, np.zeros(pieces.count)]))
    unit = replace(pieces, own_sigma_rad=own, share=1.0)
    scatter = (spread[: pieces.count] / own**2).sum() - in_all / (pieces.count + 1)
    slid = unit.cost(np.concatenate([slides, np.zeros(pieces.count)])) + scatter
    share = float(np.sqrt(2 * slid / pieces.count))
    known = spread[pieces.count :] / pieces.disparity_sigma_px**2
    square = disparities @ disparities + PRIOR_PIECES * FIRST_SIGMA_PX**2
    sigma = float(np.sqrt(square / ((1 - known).sum() + PRIOR_PIECES)))
    return Pieces(pieces.piece, own, share, sigma)
