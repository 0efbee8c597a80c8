"""What seems to slide as it is passed: ribs and highlights move along their bar.

A ribbed bar is a screw: seen from further on, the side that faces the camera shows other ribs, which seem to
have slid along the bar; what highlights do to mill scale is alike. In the picture such a point turns about
the camera's axis, by 4e-4 rad where ribs are: a tenth of a pixel over 250 px of way. Points of a bundle slide
alike, which can't be told from a heading that is off; so slides are unknowns, each point's about its piece's
of the yard. How far they go is learnt from the recording: floors don't slide, and lead.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from barsight.core.arrays import Bool, Float64
from barsight.motion.elimination import substitute
from barsight.motion.graph import factors
from barsight.motion.problem import Pieces, Problem
from barsight.motion.solver import State, guess_of, optimise, rig_of, sights_of
from barsight.motion.system import System

LENGTH_SHARE = 0.2
HEIGHT_SHARE = 0.07
"""A piece is this long along the way, and this high, in terms of the points' distance."""
FIRST_SIGMA_RAD = 2e-4
LEAST_SIGMA_RAD = 5e-6
LEAST_PIECES = 4
LEAST_SEEN = 4
"""A point seen less often says nothing of how it slides."""
PRIOR_POINTS = 5
"""How many points' worth all pieces' scatter counts in that of one."""
ROUNDS = 3
STEPS = 2
"""Gauss-Newton's, in a round: each begins where the one before ended."""


def pieces_of(problem: Problem, state: State, used: Bool) -> Pieces | None:
    """Strips across the way, apart in height; None where there are too few of them, or fewer points than
    pieces that say how they slide."""
    seen = problem.sightings
    if seen is None or not problem.has_latency or problem.prior is not None:
        return None
    camera = seen.camera
    disparity = float(np.median(seen.stereo[:, 0] - seen.stereo[:, 2] + camera.doffs_px))
    range_m = camera.focal_px * camera.baseline_m / disparity
    place = np.array([pose.translation for pose in problem.start])
    _, _, axes = np.linalg.svd(place - place.mean(axis=0), full_matrices=False)
    along = np.floor(state.points[:, :3] @ axes[0] / (LENGTH_SHARE * range_m))
    up = np.floor(state.points[:, 2] / (HEIGHT_SHARE * range_m) + 0.5)
    names, piece = np.unique(np.column_stack([along, up]), axis=0, return_inverse=True)
    telling = int((np.bincount(seen.track[used]) >= LEAST_SEEN).sum())
    if len(names) < LEAST_PIECES or telling < len(names):
        return None
    return Pieces(piece.ravel().astype(np.int64), np.full(len(names), FIRST_SIGMA_RAD), 0.5)


def with_slides(
    problem: Problem, state: State, used: Bool, rounds: int = ROUNDS
) -> tuple[Problem, State, System]:
    """Solved with the slides as unknowns, and how far they go as they show it [EM: Dempster 1977]."""
    pieces = problem.pieces or pieces_of(problem, state, used)
    graph = factors(problem)
    if pieces is None:
        return problem, *optimise(problem, graph, state, used)
    if not len(state.slides):
        state = replace(state, slides=np.zeros(pieces.count))
    for _ in range(rounds):
        problem = replace(problem, pieces=pieces)
        state, system = optimise(problem, graph, state, used, most=STEPS)
        pieces = _learnt(problem, state, system, pieces, used)
    return problem, state, system


def _learnt(problem: Problem, state: State, system: System, pieces: Pieces, used: Bool) -> Pieces:
    seen = problem.sightings
    assert seen is not None
    variance = np.zeros(len(state.points))
    still, guess = np.zeros((len(problem.kept), 6)), guess_of(problem, state)
    none, points = np.zeros(pieces.count + 2), state.points.copy()
    substitute(rig_of(seen), sights_of(problem, used), guess, still, none, points, variance)
    counts = np.bincount(seen.track[used], minlength=len(variance))
    good = counts >= LEAST_SEEN
    square = (points[:, 3] - state.slides[pieces.piece]) ** 2 + variance
    everywhere = square[good].mean()
    total = np.bincount(pieces.piece[good], square[good], pieces.count) + PRIOR_POINTS * everywhere
    own = np.sqrt(total / (np.bincount(pieces.piece[good], minlength=pieces.count) + PRIOR_POINTS))
    own = np.maximum(own, LEAST_SIGMA_RAD)
    unit = replace(pieces, own_sigma_rad=own, share=1.0)
    whole = np.outer(state.slides, state.slides) + _covariance(system, pieces.count)
    share = float(np.sqrt((unit.information * whole).sum() / pieces.count))
    return replace(pieces, own_sigma_rad=own, share=share)


def _covariance(system: System, count: int) -> Float64:
    """(S, S) of the slides, the drift taken as known."""
    own, _ = system.schur(system.forward)
    first = len(own) - 2 - count
    return np.asarray(np.linalg.inv(own[:-2, :-2])[first:, first:], np.float64)
