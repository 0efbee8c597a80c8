"""The rig's drift sought from where the estimate stands, and weighed against its prior at every step.

Over a short way yaw and scale look alike: sightings alone would follow a valley far from the truth, where
what is linear here no longer holds. So each step goes to where sightings and prior together want it.
"""

from __future__ import annotations

import numpy as np

from barsight.core.arrays import Bool
from barsight.core.types import RigDrift
from barsight.motion.problem.gauss_newton import RELATIVE_GAIN, State, moved, optimise
from barsight.motion.problem.gtsam_factors import factors
from barsight.motion.problem.normal_equations import System
from barsight.motion.problem.problem import Problem
from barsight.motion.problem.rig_drift import columns, weigh

MOST_STEPS = 6
LEAST_STEP_PX = 0.02


def drifted(problem: Problem, state: State, system: System, used: Bool) -> tuple[State, RigDrift]:
    """The state moved to the drift that sightings and prior together show, and that drift."""
    own, slope = system.schur(system.forward)
    best = state.drift - np.linalg.solve(own, slope)[-2:]
    drift = weigh(best, np.linalg.inv(own)[-2:, -2:].astype(np.float64), problem)
    fixed = np.zeros(len(own))
    fixed[-2:] = np.array([drift.yaw_rad, drift.scale]) - state.drift
    return moved(problem, state, used, *system.step(problem.free, fixed=fixed)), drift


def sought(
    problem: Problem, state: State, system: System, used: Bool, least_gain: float = RELATIVE_GAIN
) -> tuple[State, System, RigDrift]:
    """The best state with its drift, from one that is good without. least_gain: see `optimise`."""
    seen, graph = problem.sightings, factors(problem)
    assert seen is not None
    by_drift = columns(seen)
    for _ in range(MOST_STEPS):
        before = state.drift
        state, drift = drifted(problem, state, system, used)
        state, system = optimise(problem, graph, state, used, least_gain=least_gain)
        if np.abs(by_drift @ (state.drift - before)).max() < LEAST_STEP_PX:
            break
    return state, system, drift
