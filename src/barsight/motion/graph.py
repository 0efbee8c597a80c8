"""The batch estimate: one factor graph over poses, velocities, biases and points, solved with GTSAM.

Stereo reprojections (Huber), preintegrated IMU between neighbouring nodes, the encoders' places (Huber),
and priors on attitude, biases and, where the body stands still, velocity.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, E, V, X

from barsight.core.arrays import Bool, Float64
from barsight.core.pose import Pose
from barsight.core.types import RigDrift
from barsight.inertial.model import ImuBias
from barsight.motion import rig_drift
from barsight.motion.encoders import EncoderState, add_encoders, agreeing, disagreement, encoder_state
from barsight.motion.problem import Problem, StereoSightings
from barsight.motion.stereo_factors import add_points, add_stereo, often, persistence, residuals

FARTHEST_OUTLIER_SIGMAS = 3.5
MOST_ROUNDS = 3
LEAST_AGREEING = 0.5
"""Where fewer of the encoders' places agree, none is left out: who is wrong can't be told."""
MOST_DRIFT_STEPS = 5
LEAST_STEP_PX = 0.02
LEAST_FACTOR = 0.1


@dataclass(frozen=True, eq=False)
class Estimate:
    """poses: (M,). covariance: (M, 6, 6) rotation then translation, reference axes. velocity_mps: (M, 3) or
    None without IMU. biases: (M,). pixel_sigma_px: what the residuals show; used: (N,) sightings kept.
    drift: of the rig, None where no picture was used or the calibration is taken as exact. encoders: None
    without. encoder_off_m: (P, 3) of each place, encoder_used: (P,) those that agree.
    """

    poses: tuple[Pose, ...]
    covariance: Float64
    velocity_mps: Float64 | None
    biases: tuple[ImuBias, ...]
    pixel_sigma_px: float
    drift: RigDrift | None
    used: Bool
    encoders: EncoderState | None
    encoder_off_m: Float64
    encoder_used: Bool


def solve(problem: Problem) -> Estimate:
    """After a first solution, drift of the rig included, sightings beyond 3.5 sigma leave and all sigmas
    grow or shrink to what was seen; then the drift is sought on and weighed against its prior, and encoder
    places beyond 5 sigma leave. (A cut before the drift is known would take the very sightings that show it
    best.)
    """
    theta = np.zeros(2)
    used = np.ones(0 if problem.sightings is None else len(problem.sightings.node), np.bool_)
    if problem.sightings is not None:
        used = often(problem.sightings, used)
    values, graph = _optimised(problem, _start(problem), used, _shift(problem, theta))
    swing = np.zeros((len(problem.start), 6, 2))
    drift: RigDrift | None = None
    if problem.sightings is not None and used.any():
        if problem.placed and problem.offset_prior_px > 0:
            values, graph, theta, _ = _seek_drift(problem, values, graph, used, theta, MOST_DRIFT_STEPS)
        problem, values, graph, used = _with_seen_noise(problem, problem.sightings, values, used, theta)
    everywhere, agreed = problem, np.ones(len(problem.placed), np.bool_)
    for _ in range(MOST_ROUNDS):
        if problem.sightings is not None and problem.offset_prior_px > 0 and used.any():
            # Encoders that contradict the scale pull with Huber's weights at first: more steps than one.
            steps = MOST_DRIFT_STEPS if problem.placed else 1
            values, graph, theta, shown = _seek_drift(problem, values, graph, used, theta, steps)
            drift, swing = rig_drift.weigh(theta, shown.covariance, problem), shown.swing
            theta = np.array([drift.yaw_rad, drift.scale])
            values, graph = _optimised(problem, values, used, _shift(problem, theta))
        now = agreeing(values, everywhere)
        if (now == agreed).all() or now.mean() < LEAST_AGREEING:
            break
        agreed = now
        chosen = tuple(place for place, kept in zip(everywhere.placed, agreed, strict=True) if kept)
        problem = replace(everywhere, placed=chosen)
        values, graph = _optimised(problem, values, used, _shift(problem, theta))
    poses = _poses(values, problem)
    marginals = gtsam.Marginals(graph, values)
    covariance = _covariances(marginals, poses, swing, drift)
    velocity, biases = _inertial(values, problem)
    sigma = float(np.median(problem.sightings.sigma_px)) if problem.sightings else 0.0
    return Estimate(
        poses, covariance, velocity, biases, sigma, drift, used,
        encoder_state(values, marginals) if problem.placed else None,
        disagreement(values, everywhere), agreeing(values, everywhere),
    )  # fmt: skip


def _with_seen_noise(
    problem: Problem, seen: StereoSightings, values: Any, used: Bool, theta: Float64
) -> tuple[Problem, Any, Any, Bool]:
    """The problem with the sightings' sigma as their residuals show it, and without the far ones, solved."""
    shift = _shift(problem, theta)
    residual = residuals(values, seen, used, shift)
    share = np.abs(residual) / seen.sigma_px[:, None]
    factor = max(LEAST_FACTOR, 1.4826 * float(np.median(share[used])))
    used = often(seen, used & (share.max(axis=1) < FARTHEST_OUTLIER_SIGMAS * factor))
    seen = replace(seen, sigma_px=factor * seen.sigma_px)
    problem = replace(problem, sightings=seen)
    values, graph = _optimised(problem, values, used, shift)
    wider = persistence(residuals(values, seen, used, shift), seen, used)
    if wider > 1:
        problem = replace(problem, sightings=replace(seen, sigma_px=wider * seen.sigma_px))
        values, graph = _optimised(problem, values, used, shift)
    return problem, values, graph, used


def _seek_drift(
    problem: Problem, values: Any, graph: Any, used: Bool, theta: Float64, steps: int
) -> tuple[Any, Any, Float64, rig_drift.Seen]:
    """Values, graph and the rig's drift by Gauss-Newton from `theta`, and how it was last seen."""
    seen = problem.sightings
    assert seen is not None
    for _ in range(steps):
        residual = residuals(values, seen, used, _shift(problem, theta))
        shown = rig_drift.look(graph.linearize(values), problem, residual, used)
        theta = theta + shown.step
        values, graph = _optimised(problem, values.retract(shown.others), used, _shift(problem, theta))
        if np.abs(rig_drift.columns(seen) * shown.step).max() < LEAST_STEP_PX:
            break
    return values, graph, theta, shown


def _shift(problem: Problem, theta: Float64) -> Float64:
    """(N,) px by which a drift moves the sightings' right columns."""
    seen = problem.sightings
    return np.zeros(0) if seen is None else rig_drift.columns(seen) @ theta


def _inertial(values: Any, problem: Problem) -> tuple[Float64 | None, tuple[ImuBias, ...]]:
    """(M, 3) velocities and the biases, where there is an IMU."""
    if not problem.has_imu:
        return None, ()
    nodes = range(len(problem.start))
    found = [values.atConstantBias(B(k)) for k in nodes]
    biases = tuple(ImuBias(np.array(b.gyroscope()), np.array(b.accelerometer())) for b in found)
    return np.array([values.atVector(V(k)) for k in nodes]), biases


def _optimised(problem: Problem, values: Any, used: Bool, shift_px: Float64) -> tuple[Any, Any]:
    """The values that fit best, and the graph. shift_px: (N,) of each sighting's right column."""
    graph = gtsam.NonlinearFactorGraph()
    _add_priors(graph, problem)
    add_encoders(graph, problem)
    if problem.has_imu:
        _add_imu(graph, problem)
    if problem.sightings is not None:
        add_points(values, problem.sightings, used)
        add_stereo(graph, problem.sightings, used, shift_px)
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(25)
    parameters.setRelativeErrorTol(1e-5)
    parameters.setLinearSolverType("MULTIFRONTAL_CHOLESKY")
    return gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize(), graph


def _poses(values: Any, problem: Problem) -> tuple[Pose, ...]:
    target = problem.start[0].target
    return tuple(_pose(values.atPose3(X(k)), target) for k in range(len(problem.start)))


def _gtsam_pose(pose: Pose) -> Any:
    return gtsam.Pose3(gtsam.Rot3(pose.rotation), pose.translation)


def _pose(pose: Any, target: str) -> Pose:
    return Pose(target, "body", pose.rotation().matrix(), np.asarray(pose.translation()))


def _sigmas(*sigmas: float) -> Any:
    return gtsam.noiseModel.Diagonal.Sigmas(np.array(sigmas, np.float64))


def _start(problem: Problem) -> Any:
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
    if problem.placed:
        values.insert(E(0), np.zeros(1))
    return values


def _add_priors(graph: Any, problem: Problem) -> None:
    if problem.first_fixed:
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


def _add_imu(graph: Any, problem: Problem) -> None:
    bias = gtsam.imuBias.ConstantBias(problem.bias.accel_mps2, problem.bias.gyro_radps)
    model = _sigmas(*[problem.accel_bias_sigma_mps2] * 3, *[problem.gyro_bias_sigma_radps] * 3)
    graph.add(gtsam.PriorFactorConstantBias(B(0), bias, model))
    for k in range(len(problem.start)):
        sigma = 1e-3 if k in problem.still else 10.0
        model = gtsam.noiseModel.Isotropic.Sigma(3, sigma)
        graph.add(gtsam.PriorFactorVector(V(k), np.zeros(3), model))
    gap = _sigmas(*[0.01] * 3, *[1e-3] * 3)
    for k, part in enumerate(problem.preintegrated):
        if part is None:
            none = gtsam.imuBias.ConstantBias()
            graph.add(gtsam.BetweenFactorConstantBias(B(k), B(k + 1), none, gap))
            continue
        factor = gtsam.CombinedImuFactor(X(k), V(k), X(k + 1), V(k + 1), B(k), B(k + 1), part.measurements)
        graph.add(factor)


def _covariances(marginals: Any, poses: tuple[Pose, ...], swing: Float64, drift: RigDrift | None) -> Float64:
    shared = np.zeros((2, 2)) if drift is None else drift.covariance
    result = np.zeros((len(poses), 6, 6))
    for k, pose in enumerate(poses):
        turned = np.zeros((6, 6))
        turned[:3, :3] = turned[3:, 3:] = pose.rotation
        own = marginals.marginalCovariance(X(k)) + swing[k] @ shared @ swing[k].T
        result[k] = turned @ own @ turned.T
    return result
