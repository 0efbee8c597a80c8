"""Build GTSAM's factors of everything but sightings, encoders and attitudes, and linearise them:
preintegrated IMU between neighbouring nodes; priors on biases, the encoders' unknowns and, where the body
stands still, velocity.
"""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, E, V, X

from barsight.core.arrays import Float64, Int64
from barsight.core.pose import Pose
from barsight.motion.linear.chain_elimination import Chain, add_products
from barsight.motion.problem.attitude_factors import MIN_SIGMA_RAD
from barsight.motion.problem.problem import Problem, encoder_unknowns_of

WIDTHS = {"x": 6, "v": 3, "b": 6}
OFFSETS = {"x": 0, "v": 6, "b": 9}
"""Offsets of a node's unknowns: pose, with an IMU velocity and biases."""
ENCODER_SCALE_SIGMA = 0.1
"""Prior standard deviation of an encoder's scale, where it is an unknown."""


def build_graph(problem: Problem, first: int = 0, end: int | None = None) -> Any:
    """Build the graph, without sightings, encoders and attitudes, of the factors of nodes first...end - 1
    (None: all) and, by the IMU, of each with the next.
    """
    graph = gtsam.NonlinearFactorGraph()
    nodes = range(first, len(problem.start) if end is None else end)
    _add_priors(graph, problem, nodes)
    if problem.has_imu:
        _add_imu(graph, problem, nodes)
    return graph


def initial_values(problem: Problem) -> Any:
    """Build GTSAM's initial values."""
    values = gtsam.Values()
    bias = gtsam.imuBias.ConstantBias(problem.bias.accel_mps2, problem.bias.gyro_radps)
    place = np.array([pose.translation for pose in problem.start])
    time_s = (problem.stamp_ns - problem.stamp_ns[0]) / 1e9
    velocity = np.gradient(place, time_s, axis=0) if len(place) > 1 else np.zeros_like(place)
    for k, pose in enumerate(problem.start):
        values.insert(X(k), _gtsam_pose(pose))
        if problem.has_imu:
            values.insert(V(k), velocity[k])
            values.insert(B(k), bias)
    if problem.has_latency:
        values.insert(E(0), _encoder_start(problem))
    return values


def _encoder_start(problem: Problem) -> Float64:
    """Begin with no latency, the jumps as stated and, where a scale is known, with it."""
    start = np.zeros(problem.encoder_unknowns)
    if problem.known_scales is not None:
        free = ~np.isin(problem.scaled, problem.held)
        start[problem.scale_places] = np.where(free, problem.known_scales.value, 0.0)
    return start


def linearise_chain(graph: Any, values: Any, width: int, nodes: int) -> Chain:
    """Linearise a graph of each node with the next and the encoders' unknowns. width: unknowns per node."""
    shared = len(encoder_unknowns_of(values))
    chain = Chain.empty(nodes, width, shared)
    add_products(*_sparse_rows(graph, values, width, nodes * width, shared), chain)
    return chain


def _sparse_rows(
    graph: Any, values: Any, width: int, size: int, shared: int
) -> tuple[Int64, Int64, Float64, Float64]:
    """Convert GTSAM's whitened rows to the form of `add_products`; the `shared` unknowns of the encoders
    begin at `size`.
    """
    linear = graph.linearize(values)
    if linear.size() == 0:
        return np.zeros(1, np.int64), np.empty(0, np.int64), np.empty(0), np.empty(0)
    row, column, value = linear.sparseJacobian_()
    where: list[Int64] = []
    for key in linear.keyVector():
        kind, node = chr(gtsam.symbolChr(key)), gtsam.symbolIndex(key)
        if kind == "e":
            where.append(size + np.arange(shared))
        else:
            where.append(node * width + OFFSETS[kind] + np.arange(WIDTHS[kind]))
    unknown = np.concatenate(where)
    row, column = row.astype(np.int64) - 1, column.astype(np.int64) - 1
    right = np.zeros(int(row.max()) + 1)
    of_right = column == len(unknown)
    right[row[of_right]] = value[of_right]
    row, column, value = row[~of_right], column[~of_right], value[~of_right]
    order = np.argsort(row, kind="stable")
    first = np.searchsorted(row[order], np.arange(len(right) + 1)).astype(np.int64)
    return first, unknown[column[order]], np.ascontiguousarray(value[order]), right


def _add_priors(graph: Any, problem: Problem, nodes: range) -> None:
    begins = problem.prior is None and 0 in nodes
    if problem.first_fixed and begins:
        sigmas = _sigmas(1e-6, 1e-6, 1e-6, 1e-6, 1e-6, 1e-6)
        if problem.has_imu:
            # Gravity corrects the first attitude about level axes; its heading stays fixed.
            up = problem.start[0].rotation.T @ np.array([0.0, 0.0, 1.0])
            spread = np.deg2rad(1.0) ** 2 * (np.eye(3) - np.outer(up, up)) + 1e-12 * np.eye(3)
            whole = np.diag([0.0, 0, 0, 1e-12, 1e-12, 1e-12])
            whole[:3, :3] = spread
            sigmas = gtsam.noiseModel.Gaussian.Covariance(whole)
        graph.add(gtsam.PriorFactorPose3(X(0), _gtsam_pose(problem.start[0]), sigmas))
    if problem.has_latency and begins:
        known, at = problem.known_scales, problem.scale_places
        scales = [ENCODER_SCALE_SIGMA] * len(problem.scaled)
        jumps = (jump.sigma_m for jump in problem.jumps)
        mounting = [max(problem.mounting_sigma_rad, MIN_SIGMA_RAD)] * 3
        sigmas = np.array([problem.encoder_latency_sigma_s, *jumps, *scales, *mounting])
        mean, covariance = np.zeros(len(sigmas)), np.diag(sigmas**2)
        if known is not None:
            mean[at], covariance[at, at] = known.value, known.covariance
        noise = gtsam.noiseModel.Gaussian.Covariance(covariance)
        graph.add(gtsam.PriorFactorVector(E(0), mean, noise))


def _add_imu(graph: Any, problem: Problem, nodes: range) -> None:
    bias = gtsam.imuBias.ConstantBias(problem.bias.accel_mps2, problem.bias.gyro_radps)
    model = _sigmas(*[problem.accel_bias_sigma_mps2] * 3, *[problem.gyro_bias_sigma_radps] * 3)
    if problem.prior is None and 0 in nodes:
        graph.add(gtsam.PriorFactorConstantBias(B(0), bias, model))
    for k in nodes:
        sigma = 1e-3 if k in problem.still else 10.0
        model = gtsam.noiseModel.Isotropic.Sigma(3, sigma)
        graph.add(gtsam.PriorFactorVector(V(k), np.zeros(3), model))
    gap = _sigmas(*[0.01] * 3, *[1e-3] * 3)
    for k, part in zip(nodes, problem.preintegrated[nodes.start : nodes.stop], strict=False):
        if part is None:
            none = gtsam.imuBias.ConstantBias()
            graph.add(gtsam.BetweenFactorConstantBias(B(k), B(k + 1), none, gap))
            continue
        factor = gtsam.CombinedImuFactor(X(k), V(k), X(k + 1), V(k + 1), B(k), B(k + 1), part.measurements)
        graph.add(factor)


def _gtsam_pose(pose: Pose) -> Any:
    return gtsam.Pose3(gtsam.Rot3(pose.rotation), pose.translation)


def _sigmas(*sigmas: float) -> Any:
    return gtsam.noiseModel.Diagonal.Sigmas(np.array(sigmas, np.float64))
