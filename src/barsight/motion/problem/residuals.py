"""Compute velocity, biases and every sensor's normalised residuals of a solved problem."""

from __future__ import annotations

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V

from barsight.core.arrays import Bool, Float64, Int64
from barsight.core.motion_detail import InertialStates, NormalisedResiduals
from barsight.motion.problem.gauss_newton import GraphState, sighting_residuals
from barsight.motion.problem.gtsam_factors import build_graph
from barsight.motion.problem.problem import EncoderPosition, Problem

IMU_PARTS = 9
"""Number of leading elements of GTSAM's residual that are used: three each of turn, way and speed; those of
the biases' random walk follow.
"""


def inertial_states(problem: Problem, state: GraphState, covariance: Float64) -> InertialStates | None:
    """Extract velocity and biases of all nodes (on their own clock). covariance: (M, n, n) as
    `Marginals.nodes`.

    The velocity is NaN where the IMU ties the node to neither neighbour.
    """
    if not problem.has_imu:
        return None
    count = len(problem.start)
    sigma = np.sqrt(np.einsum("nii->ni", covariance)[:, 6:])
    biases = [state.values.atConstantBias(B(k)) for k in range(count)]
    velocity = np.array([state.values.atVector(V(k)) for k in range(count)])
    tied = np.array([part is not None for part in problem.preintegrated])
    alone = ~(np.append(tied, False) | np.append(False, tied))
    velocity[alone] = sigma[alone, :3] = np.nan
    return InertialStates(
        problem.stamp_ns, velocity, sigma[:, :3],
        np.array([bias.gyroscope() for bias in biases]), sigma[:, 6:],
        np.array([bias.accelerometer() for bias in biases]), sigma[:, 3:6],
    )  # fmt: skip


def normalised_reprojection(
    problem: Problem, state: GraphState, used: Bool
) -> tuple[NormalisedResiduals | None, Int64]:
    """Compute the RMS of each node's used sightings in units of their sigmas, and their number (M,)."""
    seen = problem.sightings
    nodes = len(problem.start)
    if seen is None or not used.any():
        return None, np.zeros(nodes, np.int64)
    square = (sighting_residuals(problem, state, used)[used] / seen.sigma_px[used, None]) ** 2
    count = np.bincount(seen.node[used], minlength=nodes)
    mean = np.column_stack([np.bincount(seen.node[used], part, nodes) for part in square.T])
    shown = count > 0
    values = np.sqrt(mean[shown] / count[shown, None])
    return NormalisedResiduals(("u", "v", "right u"), problem.stamp_ns[shown], values), count


def normalised_imu(problem: Problem, state: GraphState) -> NormalisedResiduals | None:
    """Compute the RMS over the axes of the IMU residuals between each node and the one before, stamped by the
    later node.
    """
    if not problem.has_imu:
        return None
    graph, rows = build_graph(problem), []
    for k in range(graph.size()):
        factor = graph.at(k)
        if isinstance(factor, gtsam.CombinedImuFactor):
            whitened = factor.noiseModel().whiten(factor.unwhitenedError(state.values))
            rows.append(np.sqrt((whitened[:IMU_PARTS].reshape(3, 3) ** 2).mean(axis=1)))
    tied = [part is not None for part in problem.preintegrated]
    return NormalisedResiduals(
        ("turn", "way", "speed"), problem.stamp_ns[1:][tied], np.array(rows).reshape(-1, 3)
    )


def normalised_encoders(
    node_ns: Int64, placed: tuple[EncoderPosition, ...], in_sigmas: Float64
) -> NormalisedResiduals | None:
    """List the encoders' residuals (P, 3), in sigma, stamped by their nodes."""
    if not placed:
        return None
    return NormalisedResiduals(("x", "y", "z"), node_ns[[place.node for place in placed]], in_sigmas)
