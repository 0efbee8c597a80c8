"""The batch estimate: one factor graph over poses, velocities, biases and points, solved with GTSAM.

Stereo reprojections (Huber), preintegrated IMU between neighbouring nodes, the encoders' places (Huber),
and priors on attitude, biases and, where the body stands still, velocity.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, L, V, X
from scipy.spatial.transform import Rotation

from barsight.core.arrays import Bool, Float64
from barsight.core.pose import Pose
from barsight.inertial.model import ImuBias
from barsight.motion.problem import Problem, StereoSightings

HUBER_SIGMAS = 2.2
"""For the length of three whitened numbers, of which 19 % are longer; 1.345 is for one."""
FARTHEST_OUTLIER_SIGMAS = 3.5
OFFSET_TRIAL_PX = 0.1
SECANT_STEPS = 4
LEAST_STEP_PX = 0.005
LEAST_SIGHTINGS = 2
LEAST_FACTOR = 0.1


@dataclass(frozen=True, eq=False)
class Offset:
    """What the right picture's columns are off by against the calibration, px, and its sigma.

    It makes every depth and every step too long or too short alike; the yaw between the cameras does it.
    """

    disparity_px: float
    sigma_px: float


@dataclass(frozen=True, eq=False)
class Estimate:
    """poses: (M,). covariance: (M, 6, 6) rotation then translation, reference axes. velocity_mps: (M, 3) or
    None without IMU. biases: (M,). pixel_sigma_px: what the residuals show; used: (N,) sightings kept.
    """

    poses: tuple[Pose, ...]
    covariance: Float64
    velocity_mps: Float64 | None
    biases: tuple[ImuBias, ...]
    pixel_sigma_px: float
    offset: Offset
    used: Bool


def solve(problem: Problem) -> Estimate:
    """After a first solution sightings beyond 3.5 sigma leave and all sigmas grow or shrink to what was seen;
    then the disparity
    offset is sought: at the best poses for a given offset the cost's slope along it is that of the residuals
    alone, so two solutions give the secant step, its curvature the offset's sigma, and the difference of
    their poses how the offset moves the trajectory.
    """
    seen = problem.sightings
    offset = Offset(0.0, 0.0)
    used = np.ones(0 if seen is None else len(seen.node), np.bool_)
    if seen is not None:
        used = _often(seen, used)
    values, graph = _optimised(problem, _start(problem), used, 0.0)
    swing = np.zeros((len(problem.start), 6))
    if seen is not None and used.any():
        residual = _residuals(values, seen, used, 0.0)
        share = np.abs(residual) / seen.sigma_px[:, None]
        factor = max(LEAST_FACTOR, 1.4826 * float(np.median(share[used])))
        used = _often(seen, used & (share.max(axis=1) < FARTHEST_OUTLIER_SIGMAS * factor))
        seen = replace(seen, sigma_px=factor * seen.sigma_px)
        problem = replace(problem, sightings=seen)
        values, graph = _optimised(problem, values, used, 0.0)
        if problem.offset_prior_px > 0 and used.any():
            values, graph, offset, swing = _with_offset(problem, values, used)
    poses = _poses(values, problem)
    covariance = _covariances(graph, values, poses)
    covariance += offset.sigma_px**2 * swing[:, :, None] * swing[:, None, :]
    return _estimate(problem, values, poses, covariance, offset, used)


def _with_offset(problem: Problem, values: Any, used: Bool) -> tuple[Any, Any, Offset, Float64]:
    """The disparity offset by secant steps, the values with it, and (M, 6) how the poses move with it per px.

    One step does without encoders; those that contradict the scale pull with Huber's weights at first, so
    that the curvature is only right near the end.
    """
    old, old_slope, old_poses = 0.0, _slope(values, problem, used, 0.0), _poses(values, problem)
    new = -float(np.sign(old_slope)) * OFFSET_TRIAL_PX
    curvature, swing = 1e-6, np.zeros((len(old_poses), 6))
    for _ in range(SECANT_STEPS if problem.placed else 1):
        values, _ = _optimised(problem, values, used, new)
        slope, poses = _slope(values, problem, used, new), _poses(values, problem)
        curvature = max((slope - old_slope) / (new - old), 1e-6)
        swing = np.array([_difference(a, b) for a, b in zip(old_poses, poses, strict=True)]) / (new - old)
        step = float(np.clip(-slope / curvature, -0.5, 0.5))
        old, old_slope, old_poses = new, slope, poses
        new = new + step
        if abs(step) < LEAST_STEP_PX:
            break
    offset = _offset(new, 1 / curvature, problem)
    values, graph = _optimised(problem, values, used, offset.disparity_px)
    return values, graph, offset, swing


def _estimate(
    problem: Problem, values: Any, poses: tuple[Pose, ...], covariance: Float64, offset: Offset, used: Bool
) -> Estimate:
    velocity: Float64 | None = None
    biases: tuple[ImuBias, ...] = ()
    if problem.has_imu:
        nodes = range(len(poses))
        velocity = np.array([values.atVector(V(k)) for k in nodes])
        found = [values.atConstantBias(B(k)) for k in nodes]
        biases = tuple(ImuBias(np.array(b.gyroscope()), np.array(b.accelerometer())) for b in found)
    sigma = float(np.median(problem.sightings.sigma_px)) if problem.sightings else 0.0
    return Estimate(poses, covariance, velocity, biases, sigma, offset, used)


def _optimised(problem: Problem, values: Any, used: Bool, offset_px: float) -> tuple[Any, Any]:
    """The values that fit best, and the graph."""
    graph = gtsam.NonlinearFactorGraph()
    _add_priors(graph, problem)
    if problem.has_imu:
        _add_imu(graph, problem)
    if problem.sightings is not None:
        _add_points(values, problem.sightings, used)
        _add_stereo(graph, problem.sightings, used, offset_px)
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(25)
    parameters.setRelativeErrorTol(1e-5)
    parameters.setLinearSolverType("MULTIFRONTAL_CHOLESKY")
    return gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize(), graph


def _slope(values: Any, problem: Problem, used: Bool, offset_px: float) -> float:
    """The cost's derivative by the disparity offset, per px."""
    seen = problem.sightings
    assert seen is not None
    residual = _residuals(values, seen, used, offset_px)[used] / seen.sigma_px[used, None]
    size = np.linalg.norm(residual, axis=1)
    weight = np.minimum(1.0, HUBER_SIGMAS / np.maximum(size, 1e-9))
    return -float((weight * residual[:, 2] / seen.sigma_px[used]).sum())


def _offset(best_px: float, variance: float, problem: Problem) -> Offset:
    """The seen offset weighed against the calibration's.

    What rectification leaves differs from place to place in the picture. Near points lie low and far ones
    high, so that passes for an offset as large as itself; only encoders, which know the way, are above that.
    """
    prior = problem.offset_prior_px**2
    if not problem.placed:
        variance += prior
    share = prior / (prior + variance)
    return Offset(float(np.clip(share * best_px, -1.0, 1.0)), float((share * variance) ** 0.5))


def _poses(values: Any, problem: Problem) -> tuple[Pose, ...]:
    target = problem.start[0].target
    return tuple(_pose(values.atPose3(X(k)), target) for k in range(len(problem.start)))


def _difference(old: Pose, new: Pose) -> Float64:
    """(6,) rotation vector and translation from old to new, reference axes."""
    turn = Rotation.from_matrix(new.rotation @ old.rotation.T).as_rotvec()
    return np.concatenate([turn, new.translation - old.translation])


def _gtsam_pose(pose: Pose) -> Any:
    return gtsam.Pose3(gtsam.Rot3(pose.rotation), pose.translation)


def _pose(pose: Any, target: str) -> Pose:
    return Pose(target, "body", pose.rotation().matrix(), np.asarray(pose.translation()))


def _sigmas(*sigmas: float) -> Any:
    return gtsam.noiseModel.Diagonal.Sigmas(np.array(sigmas, np.float64))


def _robust(model: Any) -> Any:
    return gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Huber.Create(HUBER_SIGMAS), model)


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
    for place in problem.placed:
        model = _robust(gtsam.noiseModel.Isotropic.Sigma(3, place.sigma_m))
        graph.add(gtsam.GPSFactor(X(place.node), place.position_m, model))
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


def _often(seen: StereoSightings, used: Bool) -> Bool:
    """Sightings of points that are seen often enough to check each other."""
    names, inverse = np.unique(seen.track, return_inverse=True)
    counts = np.bincount(inverse[used], minlength=len(names))
    result: Bool = used & (counts[inverse] >= LEAST_SIGHTINGS)
    return result


def _add_points(values: Any, seen: StereoSightings, used: Bool) -> None:
    """Landmarks that `values` lacks, triangulated from their first sighting; unused ones leave."""
    camera, stereo = seen.camera, seen.stereo
    depth = camera.focal_px * camera.baseline_m / (stereo[:, 0] - stereo[:, 2] + camera.doffs_px)
    x = (stereo[:, 0] - camera.cx_px) / camera.focal_px * depth
    y = (stereo[:, 1] - camera.cy_px) / camera.focal_px * depth
    points = seen.body_from_rect0.apply(np.column_stack([x, y, depth]))
    kept = set(seen.track[used].tolist())
    for track in np.unique(seen.track[~used]).tolist():
        if track not in kept and values.exists(L(track)):
            values.erase(L(track))
    for k in np.flatnonzero(used):
        key = L(int(seen.track[k]))
        if not values.exists(key):
            values.insert(key, values.atPose3(X(int(seen.node[k]))).transformFrom(points[k]))


def _add_stereo(graph: Any, seen: StereoSightings, used: Bool, offset_px: float) -> None:
    camera = seen.camera
    calibration = gtsam.Cal3_S2Stereo(
        camera.focal_px, camera.focal_px, 0.0, camera.cx_px, camera.cy_px, camera.baseline_m
    )
    mounted = gtsam.Pose3(gtsam.Rot3(seen.body_from_rect0.rotation), seen.body_from_rect0.translation)
    for k in np.flatnonzero(used):
        model = _robust(gtsam.noiseModel.Isotropic.Sigma(3, seen.sigma_px[k]))
        u, v, right = seen.stereo[k]
        measured = gtsam.StereoPoint2(u, right - camera.doffs_px - offset_px, v)
        node, track = X(int(seen.node[k])), L(int(seen.track[k]))
        graph.add(gtsam.GenericStereoFactor3D(measured, model, node, track, calibration, mounted))


def _residuals(values: Any, seen: StereoSightings, used: Bool, offset_px: float) -> Float64:
    """(N, 3) px, 0 where unused."""
    residual = np.zeros((len(used), 3))
    camera = seen.camera
    for node in np.unique(seen.node[used]).tolist():
        rows = np.flatnonzero(used & (seen.node == node))
        points = np.array([values.atPoint3(L(int(seen.track[k]))) for k in rows])
        rect0_from_world = (_pose(values.atPose3(X(node)), "world") @ seen.body_from_rect0).inverse()
        x, y, z = rect0_from_world.apply(points).T
        u, v = camera.focal_px * x / z + camera.cx_px, camera.focal_px * y / z + camera.cy_px
        right = u - camera.focal_px * camera.baseline_m / z + camera.doffs_px + offset_px
        residual[rows] = seen.stereo[rows] - np.column_stack([u, v, right])
    return residual


def _covariances(graph: Any, values: Any, poses: tuple[Pose, ...]) -> Float64:
    marginals = gtsam.Marginals(graph, values)
    result = np.zeros((len(poses), 6, 6))
    for k, pose in enumerate(poses):
        turned = np.zeros((6, 6))
        turned[:3, :3] = turned[3:, 3:] = pose.rotation
        result[k] = turned @ marginals.marginalCovariance(X(k)) @ turned.T
    return result
