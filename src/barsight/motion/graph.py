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

from barsight.core.arrays import Bool, Float64
from barsight.core.pose import Pose
from barsight.core.types import RigDrift
from barsight.inertial.model import ImuBias
from barsight.motion import rig_drift
from barsight.motion.problem import Problem, StereoSightings

FARTHEST_OUTLIER_SIGMAS = 3.5
MOST_DRIFT_STEPS = 5
LEAST_STEP_SIGMAS = 0.3
LEAST_SIGHTINGS = 2
LEAST_FACTOR = 0.1


@dataclass(frozen=True, eq=False)
class Estimate:
    """poses: (M,). covariance: (M, 6, 6) rotation then translation, reference axes. velocity_mps: (M, 3) or
    None without IMU. biases: (M,). pixel_sigma_px: what the residuals show; used: (N,) sightings kept.
    drift: of the rig, None where no picture was used or the calibration is taken as exact.
    """

    poses: tuple[Pose, ...]
    covariance: Float64
    velocity_mps: Float64 | None
    biases: tuple[ImuBias, ...]
    pixel_sigma_px: float
    drift: RigDrift | None
    used: Bool


def solve(problem: Problem) -> Estimate:
    """After a first solution, drift of the rig included, sightings beyond 3.5 sigma leave and all sigmas
    grow or shrink to what was seen; then the drift is sought on and weighed against its prior. (A cut before
    the drift is known would take the very sightings that show it best.)
    """
    seen = problem.sightings
    used = np.ones(0 if seen is None else len(seen.node), np.bool_)
    if seen is not None:
        used = _often(seen, used)
    theta = np.zeros(2)
    values, graph = _optimised(problem, _start(problem), used, _shift(problem, theta))
    swing = np.zeros((len(problem.start), 6, 2))
    drift: RigDrift | None = None
    if seen is not None and used.any():
        if problem.placed and problem.offset_prior_px > 0:
            values, graph, theta, _ = _seek_drift(problem, values, graph, used, theta, 1)
        residual = _residuals(values, seen, used, _shift(problem, theta))
        share = np.abs(residual) / seen.sigma_px[:, None]
        factor = max(LEAST_FACTOR, 1.4826 * float(np.median(share[used])))
        used = _often(seen, used & (share.max(axis=1) < FARTHEST_OUTLIER_SIGMAS * factor))
        problem = replace(problem, sightings=replace(seen, sigma_px=factor * seen.sigma_px))
        values, graph = _optimised(problem, values, used, _shift(problem, theta))
        if problem.offset_prior_px > 0 and used.any():
            # Encoders that contradict the scale pull with Huber's weights at first: more steps than one.
            steps = MOST_DRIFT_STEPS if problem.placed else 1
            values, graph, theta, shown = _seek_drift(problem, values, graph, used, theta, steps)
            drift, swing = rig_drift.weigh(theta, shown.covariance, problem), shown.swing
            shift = _shift(problem, np.array([drift.yaw_rad, drift.scale]))
            values, graph = _optimised(problem, values, used, shift)
    poses = _poses(values, problem)
    covariance = _covariances(graph, values, poses, swing, drift)
    return _estimate(problem, values, poses, covariance, drift, used)


def _seek_drift(
    problem: Problem, values: Any, graph: Any, used: Bool, theta: Float64, steps: int
) -> tuple[Any, Any, Float64, rig_drift.Seen]:
    """Values, graph and the rig's drift by Gauss-Newton from `theta`, and how it was last seen."""
    seen = problem.sightings
    assert seen is not None
    for _ in range(steps):
        residual = _residuals(values, seen, used, _shift(problem, theta))
        shown = rig_drift.look(graph.linearize(values), problem, residual, used)
        theta = theta + shown.step
        values, graph = _optimised(problem, values.retract(shown.others), used, _shift(problem, theta))
        if (np.abs(shown.step) < LEAST_STEP_SIGMAS * np.sqrt(np.diag(shown.covariance))).all():
            break
    return values, graph, theta, shown


def _shift(problem: Problem, theta: Float64) -> Float64:
    """(N,) px by which a drift moves the sightings' right columns."""
    seen = problem.sightings
    return np.zeros(0) if seen is None else rig_drift.columns(seen) @ theta


def _estimate(
    problem: Problem,
    values: Any,
    poses: tuple[Pose, ...],
    covariance: Float64,
    drift: RigDrift | None,
    used: Bool,
) -> Estimate:
    velocity: Float64 | None = None
    biases: tuple[ImuBias, ...] = ()
    if problem.has_imu:
        nodes = range(len(poses))
        velocity = np.array([values.atVector(V(k)) for k in nodes])
        found = [values.atConstantBias(B(k)) for k in nodes]
        biases = tuple(ImuBias(np.array(b.gyroscope()), np.array(b.accelerometer())) for b in found)
    sigma = float(np.median(problem.sightings.sigma_px)) if problem.sightings else 0.0
    return Estimate(poses, covariance, velocity, biases, sigma, drift, used)


def _optimised(problem: Problem, values: Any, used: Bool, shift_px: Float64) -> tuple[Any, Any]:
    """The values that fit best, and the graph. shift_px: (N,) of each sighting's right column."""
    graph = gtsam.NonlinearFactorGraph()
    _add_priors(graph, problem)
    if problem.has_imu:
        _add_imu(graph, problem)
    if problem.sightings is not None:
        _add_points(values, problem.sightings, used)
        _add_stereo(graph, problem.sightings, used, shift_px)
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


def _robust(model: Any) -> Any:
    return gtsam.noiseModel.Robust.Create(
        gtsam.noiseModel.mEstimator.Huber.Create(rig_drift.HUBER_SIGMAS), model
    )


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


def _add_stereo(graph: Any, seen: StereoSightings, used: Bool, shift_px: Float64) -> None:
    camera = seen.camera
    calibration = gtsam.Cal3_S2Stereo(
        camera.focal_px, camera.focal_px, 0.0, camera.cx_px, camera.cy_px, camera.baseline_m
    )
    mounted = gtsam.Pose3(gtsam.Rot3(seen.body_from_rect0.rotation), seen.body_from_rect0.translation)
    for k in np.flatnonzero(used):
        model = _robust(gtsam.noiseModel.Isotropic.Sigma(3, seen.sigma_px[k]))
        u, v, right = seen.stereo[k]
        measured = gtsam.StereoPoint2(u, right - camera.doffs_px - shift_px[k], v)
        node, track = X(int(seen.node[k])), L(int(seen.track[k]))
        graph.add(gtsam.GenericStereoFactor3D(measured, model, node, track, calibration, mounted))


def _residuals(values: Any, seen: StereoSightings, used: Bool, shift_px: Float64) -> Float64:
    """(N, 3) px, 0 where unused."""
    residual = np.zeros((len(used), 3))
    camera = seen.camera
    for node in np.unique(seen.node[used]).tolist():
        rows = np.flatnonzero(used & (seen.node == node))
        points = np.array([values.atPoint3(L(int(seen.track[k]))) for k in rows])
        rect0_from_world = (_pose(values.atPose3(X(node)), "world") @ seen.body_from_rect0).inverse()
        x, y, z = rect0_from_world.apply(points).T
        u, v = camera.focal_px * x / z + camera.cx_px, camera.focal_px * y / z + camera.cy_px
        right = u - camera.focal_px * camera.baseline_m / z + camera.doffs_px + shift_px[rows]
        residual[rows] = seen.stereo[rows] - np.column_stack([u, v, right])
    return residual


def _covariances(
    graph: Any, values: Any, poses: tuple[Pose, ...], swing: Float64, drift: RigDrift | None
) -> Float64:
    marginals = gtsam.Marginals(graph, values)
    shared = np.zeros((2, 2)) if drift is None else drift.covariance
    result = np.zeros((len(poses), 6, 6))
    for k, pose in enumerate(poses):
        turned = np.zeros((6, 6))
        turned[:3, :3] = turned[3:, 3:] = pose.rotation
        own = marginals.marginalCovariance(X(k)) + swing[k] @ shared @ swing[k].T
        result[k] = turned @ own @ turned.T
    return result
