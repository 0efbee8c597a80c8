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

from barsight.core.arrays import Bool
from barsight.motion.problem.encoder_factors import PLAY_M, travel_m
from barsight.motion.problem.gauss_newton import GraphState, linearise_graph
from barsight.motion.problem.gtsam_factors import build_graph
from barsight.motion.problem.problem import Problem, encoder_unknowns_of
from barsight.motion.problem.rig_drift import drift_floor, drift_prior

MAYBE_SIGMAS = 4.5
"""Significance from which a scale may be wrong, so that it becomes an unknown."""
MIN_WAY_M = 0.5
"""Minimum travel on an axis for its scale to be told."""


def doubtful_scales(problem: Problem, state: GraphState, used: Bool) -> tuple[int, ...]:
    """Find the axes whose encoder contradicts cameras and IMU in scale, at the optimum; those whose scale is
    an unknown already aren't asked.
    """
    way = travel_m(problem)
    axes = [axis for axis in np.flatnonzero(way > MIN_WAY_M).tolist() if axis not in problem.scaled]
    if not axes or not used.any():
        return ()
    known, count = encoder_unknowns_of(state.values), len(axes)
    values = gtsam.Values(state.values)
    values.erase(E(0))
    values.insert(E(0), np.append(known, np.zeros(count)))
    tried, state = replace(problem, scaled=(*problem.scaled, *axes)), replace(state, values=values)
    system = linearise_graph(tried, build_graph(tried), state, used)
    own, slope = system.schur(system.forward)
    size = len(own)
    at = np.r_[len(known) : len(known) + count, size - 2 : size]
    covariance = np.linalg.inv(own)[np.ix_(at, at)].astype(np.float64)
    best = -np.linalg.solve(own, slope)[at]
    best[count:] += state.drift
    covariance[count:, count:] += drift_floor(problem)
    prior = np.zeros_like(covariance)
    prior[[count, count + 1], [count, count + 1]] = drift_prior(problem) ** -2.0
    information = np.linalg.inv(covariance)
    combined = np.linalg.inv(information + prior)
    excess = (combined @ information @ best)[:count]
    sigma = np.sqrt(np.diag(combined)[:count] + (PLAY_M / way[axes]) ** 2)
    off = np.abs(excess) / sigma
    return tuple(axis for axis, sigmas in zip(axes, off, strict=True) if sigmas > MAYBE_SIGMAS)
