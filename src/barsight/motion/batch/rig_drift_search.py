"""Search for the rig's drift from the present estimate, weighed against its prior at every step.

Over a short path yaw and scale look alike: the sightings alone would follow a valley far from the truth,
to where the linearisation no longer holds. So each step goes to the optimum of sightings and prior together.
"""

from __future__ import annotations

import numpy as np

from barsight.core.arrays import Bool
from barsight.core.records.trajectory import RigDrift
from barsight.motion.problem.gauss_newton import RELATIVE_GAIN, GraphState, optimise_graph, retract
from barsight.motion.problem.gtsam_factors import build_graph
from barsight.motion.problem.normal_equations import System
from barsight.motion.problem.problem import Problem
from barsight.motion.problem.rig_drift import combine_with_prior, drift_jacobian

MAX_STEPS = 6
MIN_STEP_PX = 0.02


def apply_estimated_drift(
    problem: Problem, state: GraphState, system: System, used: Bool
) -> tuple[GraphState, RigDrift]:
    """Move the state to the drift that sightings and prior together show; also return that drift."""
    own, slope = system.schur(system.forward)
    best = state.drift - np.linalg.solve(own, slope)[-2:]
    drift = combine_with_prior(best, np.linalg.inv(own)[-2:, -2:].astype(np.float64), problem)
    fixed = np.zeros(len(own))
    fixed[-2:] = np.array([drift.yaw_rad, drift.scale]) - state.drift
    return retract(problem, state, used, *system.step(problem.free, fixed=fixed)), drift


def optimise_with_drift(
    problem: Problem, state: GraphState, system: System, used: Bool, min_gain: float = RELATIVE_GAIN
) -> tuple[GraphState, System, RigDrift]:
    """Optimise the state together with the rig's drift, starting from a state that is optimal without it.

    min_gain: see `optimise_graph`.
    """
    seen, graph = problem.sightings, build_graph(problem)
    assert seen is not None
    by_drift = drift_jacobian(seen)
    for _ in range(MAX_STEPS):
        before = state.drift
        state, drift = apply_estimated_drift(problem, state, system, used)
        state, system = optimise_graph(problem, graph, state, used, min_gain=min_gain)
        if np.abs(by_drift @ (state.drift - before)).max() < MIN_STEP_PX:
            break
    return state, system, drift
