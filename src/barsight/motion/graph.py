"""GTSAM's factors of all but the sightings: preintegrated IMU between neighbouring nodes, the encoders'
places (Huber), and priors on attitude, biases and, where the body stands still, velocity.
"""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, E, V, X

from barsight.core.pose import Pose
from barsight.motion.encoders import add_encoders
from barsight.motion.problem import Problem


def factors(problem: Problem, before: int | None = None) -> Any:
    """The graph of a problem without its sightings; of the IMU only what touches nodes `before` the given."""
    graph = gtsam.NonlinearFactorGraph()
    _add_priors(graph, problem)
    add_encoders(graph, problem)
    if problem.has_imu:
        _add_imu(graph, problem, len(problem.start) if before is None else before)
    return graph


def start_values(problem: Problem) -> Any:
    """GTSAM's values to begin from."""
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
        values.insert(E(0), np.zeros(1))
    return values


def _add_priors(graph: Any, problem: Problem) -> None:
    if problem.first_fixed and problem.prior is None:
        sigmas = _sigmas(1e-6, 1e-6, 1e-6, 1e-6, 1e-6, 1e-6)
        if problem.has_imu:
            # Gravity turns the first attitude about level axes; its heading stays where it is.
            up = problem.start[0].rotation.T @ np.array([0.0, 0.0, 1.0])
            spread = np.deg2rad(1.0) ** 2 * (np.eye(3) - np.outer(up, up)) + 1e-12 * np.eye(3)
            whole = np.diag([0.0, 0, 0, 1e-12, 1e-12, 1e-12])
            whole[:3, :3] = spread
            sigmas = gtsam.noiseModel.Gaussian.Covariance(whole)
        graph.add(gtsam.PriorFactorPose3(X(0), _gtsam_pose(problem.start[0]), sigmas))
    for attitude in problem.attitudes:
        rotation = gtsam.Rot3(attitude.rotation)
        graph.add(gtsam.PoseRotationPrior3D(X(attitude.node), rotation, _sigmas(*attitude.sigma_rad)))


def _add_imu(graph: Any, problem: Problem, before: int) -> None:
    bias = gtsam.imuBias.ConstantBias(problem.bias.accel_mps2, problem.bias.gyro_radps)
    model = _sigmas(*[problem.accel_bias_sigma_mps2] * 3, *[problem.gyro_bias_sigma_radps] * 3)
    if problem.prior is None:
        graph.add(gtsam.PriorFactorConstantBias(B(0), bias, model))
    for k in range(before):
        sigma = 1e-3 if k in problem.still else 10.0
        model = gtsam.noiseModel.Isotropic.Sigma(3, sigma)
        graph.add(gtsam.PriorFactorVector(V(k), np.zeros(3), model))
    gap = _sigmas(*[0.01] * 3, *[1e-3] * 3)
    for k, part in enumerate(problem.preintegrated[:before]):
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
