"""Find encoders whose scale is wrong, by cameras and IMU.

An encoder with a wrong wheel, gear or unit travels too far or too short everywhere. The estimate, which
takes the encoders' metre as right, then turns the right camera instead (`rig_drift`): both change the depth.
But a turn changes far depths more than near ones and all directions alike, and the IMU measures the crane's
accelerations by itself. So a wrong scale is told by a score test [Rao 1948]: the equations at the solution,
once more with the scales as unknowns, give what these would be.
"""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import E

from barsight.core.arrays import Bool, Float64
from barsight.motion.problem.encoder_factors import PLAY_M, SURE_SCALE_SIGMAS, travel_m
from barsight.motion.problem.gauss_newton import GraphState, linearise_graph
from barsight.motion.problem.gtsam_factors import build_graph
from barsight.motion.problem.problem import Problem, encoder_unknowns_of
from barsight.motion.problem.rig_drift import drift_floor, drift_prior
from barsight.motion.problem.travel import Scales

MAYBE_SIGMAS = 4.5
"""Significance from which a scale may be wrong, so that it becomes an unknown."""
SUSPECTED_SIGMAS = 3.3
"""Significance from which a scale that isn't an unknown counts in the sigma of a whole recording's poses."""
WIDER_SIGMAS = 1.0
"""Significance from which a scale that isn't an unknown yet counts in the sigma of what is known by then; it
counts in full where it is one sigma more.
"""
MIN_WAY_M = 0.5
"""Minimum travel on an axis for its scale to be told."""


def scales_if_unknown(
    problem: Problem, state: GraphState, used: Bool
) -> tuple[tuple[int, ...], Scales] | None:
    """Estimate, at the optimum, the scales that aren't unknowns: their axes, and their values as unknowns."""
    moved = np.flatnonzero(travel_m(problem) > MIN_WAY_M).tolist()
    axes = tuple(axis for axis in moved if axis not in problem.scaled)
    if not axes or not used.any():
        return None
    known, count = encoder_unknowns_of(state.values), len(axes)
    begin = problem.scale_places.stop
    values = gtsam.Values(state.values)
    values.erase(E(0))
    values.insert(E(0), np.insert(known, begin, np.zeros(count)))
    tried, state = replace(problem, scaled=(*problem.scaled, *axes)), replace(state, values=values)
    system = linearise_graph(tried, build_graph(tried), state, used)
    own, slope = system.schur(system.forward)
    size = len(own)
    at = np.r_[begin : begin + count, size - 2 : size]
    covariance = np.linalg.inv(own)[np.ix_(at, at)].astype(np.float64)
    best = -np.linalg.solve(own, slope)[at].astype(np.float64)
    best[count:] += state.drift
    return axes, weigh_scales(problem, best, covariance)


def suspected_scales(
    problem: Problem, axes: tuple[int, ...], scales: Scales
) -> tuple[tuple[int, ...], Scales]:
    """Select the axes whose scale is taken as right but may be wrong, with its value and sigma on each."""
    value, sigmas = scales_alone(problem, axes, scales)
    at = np.flatnonzero(sigmas > SUSPECTED_SIGMAS)
    sigma = np.abs(value[at]) / sigmas[at]
    return tuple(np.array(axes, np.int64)[at].tolist()), Scales(value[at], np.diag(sigma**2))


def weigh_scales(problem: Problem, best: Float64, covariance: Float64) -> Scales:
    """Weigh scales and the rig's drift (S + 2,), as the equations alone would have them, against the drift's
    prior: the scales.
    """
    covariance, prior = covariance.copy(), np.zeros_like(covariance)
    covariance[-2:, -2:] += drift_floor(problem)
    prior[[-2, -1], [-2, -1]] = drift_prior(problem) ** -2.0
    information = np.linalg.inv(covariance)
    combined = np.linalg.inv(information + prior).astype(np.float64)
    return Scales((combined @ information @ best)[:-2], combined[:-2, :-2])


def doubtful_axes(problem: Problem, axes: tuple[int, ...], scales: Scales | None) -> tuple[int, ...]:
    """Select the axes whose encoder may have a wrong scale: none, unless one of them contradicts cameras and
    IMU; then also those that could be wrong in its stead, since a turned camera shows on all axes alike.
    """
    if scales is None or not axes:
        return ()
    _, sigmas = scales_alone(problem, axes, scales)
    if sigmas.max() <= MAYBE_SIGMAS:
        return ()
    near = (sigmas > 0) & (sigmas.max() ** 2 - sigmas**2 < SURE_SCALE_SIGMAS**2)
    return tuple(np.array(axes, np.int64)[near].tolist())


def possible_scales(problem: Problem, axes: tuple[int, ...], scales: Scales) -> Float64:
    """Weigh how wrong the scales (S,) of some axes may be that are taken as right: the more significant, the
    nearer to the value that cameras and IMU show.
    """
    value, sigmas = scales_alone(problem, axes, scales)
    return value * np.clip(sigmas - WIDER_SIGMAS, 0.0, 1.0)


def scales_alone(problem: Problem, axes: tuple[int, ...], scales: Scales) -> tuple[Float64, Float64]:
    """Estimate the scale (S,) of each axis with the others taken as right, and its significance (S,) in
    sigma: 0 where the encoder travelled too little.
    """
    way = travel_m(problem)[list(axes)]
    information = np.linalg.inv(scales.covariance + np.diag((PLAY_M / way) ** 2))
    own = np.diag(information)
    value: Float64 = information @ scales.value / own
    return value, np.where(way > MIN_WAY_M, np.abs(value) * np.sqrt(own), 0.0)
