"""Form the residuals of the nominal attitude, with the mounting's error as an unknown.

A rig isn't mounted exactly as stated, and a girder hangs askew: all nodes share that error. Taken as drawn
anew at each of them, it would average out with confidence. So it is an unknown of its own, and only the sway
about it is drawn anew. At rest there is no sway, and the attitude itself is known.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from barsight.core.arrays import Bool, Float64, Int64
from barsight.motion.linear.chain_elimination import Chain
from barsight.motion.problem.problem import Problem, encoder_unknowns_of, poses_of

MIN_SIGMA_RAD = 1e-6


def add_attitudes(chain: Chain, problem: Problem, poses: Float64, unknowns: Float64) -> None:
    """Add the residuals to the chain's nodes and the encoders' `unknowns` (S,), the last three of which are
    the mounting's error. poses: (M, 4, 4).
    """
    if not problem.attitudes:
        return
    node, off, weight, sways = _residuals(problem, poses, unknowns)
    turn = np.arange(3)  # of GTSAM's pose, in body axes
    chain.own[node[:, None], turn, turn] += weight
    chain.gradient[node[:, None], turn] += weight * off
    if not problem.has_latency:
        return
    weight, mounting = weight * sways[:, None], len(unknowns) - 3 + turn
    chain.side[node[:, None], turn, mounting] -= weight
    chain.corner[mounting, mounting] += weight.sum(axis=0)
    chain.corner_gradient[mounting] -= (weight * off).sum(axis=0)


def attitudes_cost(values: Any, problem: Problem) -> float:
    """Compute the cost of the attitudes."""
    if not problem.attitudes:
        return 0.0
    _, off, weight, _ = _residuals(problem, poses_of(values), encoder_unknowns_of(values))
    return float((weight * off**2).sum()) / 2


def _residuals(problem: Problem, poses: Float64, unknowns: Float64) -> tuple[Int64, Float64, Float64, Bool]:
    """Compute node (A,), residual (A, 3) rad in body axes, weight (A, 3) and sway (A,) of each attitude."""
    node = np.array([attitude.node for attitude in problem.attitudes])
    nominal = np.array([attitude.rotation for attitude in problem.attitudes])
    sigma = np.array([attitude.sigma_rad for attitude in problem.attitudes])
    sways = np.array([attitude.sways for attitude in problem.attitudes])
    off = Rotation.from_matrix(nominal.transpose(0, 2, 1) @ poses[node, :3, :3]).as_rotvec()
    if problem.has_latency:
        off = off - sways[:, None] * unknowns[-3:]
    return node, off, np.maximum(sigma, MIN_SIGMA_RAD) ** -2, sways
