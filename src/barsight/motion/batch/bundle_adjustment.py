"""Estimate a whole recording in one factor graph: poses, velocities, biases and points."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from gtsam.symbol_shorthand import B, V, X

from barsight.core.arrays import Bool, Float64, Int64
from barsight.core.linalg.robust import mad_sigma
from barsight.core.motion_detail import InertialStates, NormalisedResiduals
from barsight.core.pose import Pose, skew
from barsight.core.records.trajectory import RigDrift
from barsight.inertial.model import ImuBias
from barsight.motion.batch.apparent_motion import solve_with_slides
from barsight.motion.batch.encoder_scale import doubtful_axes, scales_if_unknown, suspected_scales
from barsight.motion.batch.rig_drift_search import optimise_with_drift
from barsight.motion.problem.encoder_factors import (
    EncoderState,
    encoder_inliers,
    encoder_residuals,
    encoder_sigmas,
    encoder_state,
    with_known_way,
    with_unevenness,
)
from barsight.motion.problem.gauss_newton import (
    GraphState,
    linearise_graph,
    optimise_graph,
    sighting_residuals,
)
from barsight.motion.problem.gtsam_factors import build_graph, initial_values
from barsight.motion.problem.marginals import Marginals, marginals
from barsight.motion.problem.normal_equations import System
from barsight.motion.problem.problem import EncoderPosition, Problem, StereoObservations
from barsight.motion.problem.residuals import inertial_states, normalised_imu, normalised_reprojection
from barsight.motion.problem.rig_drift import with_matching_bias
from barsight.motion.problem.stereo_factors import (
    dof_correction,
    initial_points,
    spatial_inflation,
    temporal_inflation,
    well_observed,
)
from barsight.motion.problem.travel import Scales, widen_positions

FARTHEST_OUTLIER_SIGMAS = 3.5
MAX_ROUNDS = 3
MIN_AGREEING = 0.5
"""Minimum share of the encoder positions that must agree for the others to be left out: with fewer, which
sensor is wrong can't be told.
"""
MIN_FACTOR = 0.1
START_GAIN = 1e-3
"""Relative decrease of the cost below which the first solution stops: it only has to reveal outliers."""


@dataclass(frozen=True, eq=False)
class Estimate:
    """Solution of the batch problem: M nodes, of which F are frames.

    poses: (M,). covariance: (F, 6, 6) of the frames' poses, rotation then translation, in the reference's
    axes. relative: (F - 1, 6, 6) of each frame's pose relative to the previous frame, in its own axes.
    velocity_mps: (M, 3), None without IMU. biases: (M,). pixel_sigma_px: the sightings' noise as the
    residuals show it; used: (N,) sightings kept. drift: of the rig, None where no picture was used or the
    calibration is taken as exact. encoders: None without them. placed: P encoder positions; encoder_off_m,
    encoder_sigma_m: (P, 3) residual and sigma of each; encoder_used: (P,) those that agree.
    scaled: axes whose encoder's scale was estimated; suspected: axes and scales of those that were taken as
    right but may be wrong, which widens `covariance`. inertial, pictures, imu: of the nodes, stamped by the
    nodes' clock; points: (M,) sightings used at each.
    """

    poses: tuple[Pose, ...]
    covariance: Float64
    relative: Float64
    velocity_mps: Float64 | None
    biases: tuple[ImuBias, ...]
    pixel_sigma_px: float
    drift: RigDrift | None
    used: Bool
    encoders: EncoderState | None
    placed: tuple[EncoderPosition, ...]
    encoder_off_m: Float64
    encoder_sigma_m: Float64
    encoder_used: Bool
    scaled: tuple[int, ...]
    inertial: InertialStates | None
    pictures: NormalisedResiduals | None
    imu: NormalisedResiduals | None
    points: Int64
    suspected: tuple[tuple[int, ...], Scales] = ((), Scales(np.empty(0), np.empty((0, 0))))


def solve_batch(problem: Problem, frames: Int64) -> Estimate:
    """Solve the batch problem. frames: (F,) the nodes whose covariances are wanted, absolute and relative to
    the next of them.

    After a first solution, including the rig's drift, the encoder positions are re-estimated with the
    accelerations and the unevenness that it shows, sightings beyond 3.5 sigma are removed and all sigmas are
    scaled to the residuals. Then the drift is estimated again and weighed against its prior, and encoder
    positions beyond 5 sigma are removed. (Removing sightings before the drift is known would take the very
    ones that show it best.) Where an encoder's scale is doubtful, everything is estimated once more with
    that scale as an unknown; where it is suspected, it widens the poses. Raises LinAlgError where the
    measurements leave an unknown undetermined.
    """
    given = problem = replace(problem, asked=frames)
    used = np.ones(0 if problem.sightings is None else len(problem.sightings.node), np.bool_)
    if problem.sightings is not None:
        used = well_observed(problem.sightings, used)
    state = GraphState(initial_values(problem), initial_points(problem), np.zeros(2))
    state, system = optimise_graph(problem, build_graph(problem), state, used, min_gain=START_GAIN)
    seeks_drift = problem.sightings is not None and problem.offset_prior_px > 0 and bool(used.any())
    if problem.sightings is not None and used.any():
        if problem.has_latency and seeks_drift:
            state, system, _ = optimise_with_drift(problem, state, system, used, START_GAIN)
        del system
        seen, problem = problem.sightings, with_known_way(problem, state.values)
        problem = with_unevenness(problem, state.values)
        problem, state, system, used = _with_seen_noise(problem, seen, state, used)
    drift: RigDrift | None = None
    everywhere, agreed = problem, np.ones(len(problem.placed), np.bool_)
    for _ in range(MAX_ROUNDS):
        if seeks_drift:
            state, system, drift = optimise_with_drift(problem, state, system, used)
        now = encoder_inliers(state.values, everywhere)
        if (now == agreed).all() or now.mean() < MIN_AGREEING:
            break
        agreed = now
        chosen = tuple(place for place, kept in zip(everywhere.placed, agreed, strict=True) if kept)
        problem = replace(problem, placed=chosen)
        state, system = optimise_graph(problem, build_graph(problem), state, used)
    if seeks_drift and problem.has_latency:
        del system  # two are never held
        tried = scales_if_unknown(problem, state, used)
        if tried and (doubtful := doubtful_axes(problem, *tried)):
            return solve_batch(replace(given, scaled=(*problem.scaled, *doubtful)), frames)
        system = linearise_graph(problem, build_graph(problem), state, used)
        estimate = _estimate(frames, everywhere, problem, state, system, used, drift)
        suspected = suspected_scales(problem, *tried) if tried else estimate.suspected
        return _widened(replace(estimate, suspected=suspected), problem, frames)
    return _estimate(frames, everywhere, problem, state, system, used, drift)


def _estimate(
    frames: Int64, everywhere: Problem, problem: Problem, state: GraphState, system: System, used: Bool,
    drift: RigDrift | None,
) -> Estimate:  # fmt: skip
    """Read the estimate and its covariances from the solved system.

    frames: (F,), see `solve_batch`. everywhere: the problem including the encoder positions that were left
    out.
    """
    pairs = np.column_stack([np.arange(len(frames) - 1), np.arange(1, len(frames))])
    poses, found = _poses(state, problem), marginals(system, pairs)
    shown = tuple(poses[k] for k in frames)
    everything = np.full((len(poses), system.layout.size, system.layout.size), np.nan)
    everything[frames] = found.nodes
    velocity, biases = _inertial(state, problem)
    sigma = float(np.median(problem.sightings.sigma_px)) if problem.sightings else 0.0
    pictures, points = normalised_reprojection(problem, state, used)
    by_drift, shared = found.drift_jacobian_of_encoders, _covariance(drift)
    unknown = np.sqrt(found.encoder_sigmas**2 + np.einsum("si,ij,sj->s", by_drift, shared, by_drift))
    return Estimate(
        poses,
        covariances(found, shown, drift),
        relative_covariances(found, shown, drift, pairs),
        velocity,
        biases,
        sigma,
        drift and with_matching_bias(drift, problem),
        used,
        encoder_state(state.values, problem, unknown) if problem.has_latency else None,
        everywhere.placed,
        encoder_residuals(state.values, everywhere),
        encoder_sigmas(everywhere),
        encoder_inliers(state.values, everywhere),
        problem.scaled,
        inertial_states(problem, state, everything),
        pictures,
        normalised_imu(problem, state),
        points,
    )


def _covariance(drift: RigDrift | None) -> Float64:
    return np.zeros((2, 2)) if drift is None else drift.covariance


def _widened(estimate: Estimate, problem: Problem, frames: Int64) -> Estimate:
    """Add to the frames' positions by how much scales that are only suspected may shift them."""
    axes, scales = estimate.suspected
    if not axes or problem.travel is None:
        return estimate
    place = np.array([estimate.poses[k].translation for k in frames])
    shift = problem.travel.shifts(axes, scales.value, place)
    return replace(estimate, covariance=widen_positions(estimate.covariance, shift))


def covariances(found: Marginals, poses: tuple[Pose, ...], drift: RigDrift | None) -> Float64:
    """Compute pose covariances (F, 6, 6) in the reference's axes, including the uncertainty of the rig's
    drift.
    """
    shared = _covariance(drift)
    result = np.zeros((len(poses), 6, 6))
    for k, pose in enumerate(poses):
        rotation = np.zeros((6, 6))
        rotation[:3, :3] = rotation[3:, 3:] = pose.rotation
        own = found.poses[k] + found.drift_jacobian_of_pose[k] @ shared @ found.drift_jacobian_of_pose[k].T
        result[k] = rotation @ own @ rotation.T
    return result


def relative_covariances(
    found: Marginals, poses: tuple[Pose, ...], drift: RigDrift | None, pairs: Int64
) -> Float64:
    """Compute covariances (P, 6, 6) of the later pose relative to the earlier one, as rotation then
    translation of a small motion applied after it, in its own axes. Errors common to both cancel.
    """
    shared = _covariance(drift)
    result = np.empty((len(pairs), 6, 6))
    for p, (old, new) in enumerate(pairs.tolist()):
        moved = poses[new].inverse() @ poses[old]
        carried = np.kron(np.eye(2), moved.rotation)
        carried[3:, :3] = skew(moved.translation) @ moved.rotation
        drift_jacobian_of_pose = (
            found.drift_jacobian_of_pose[new] - carried @ found.drift_jacobian_of_pose[old]
        )
        both = carried @ found.cross[p]
        own = found.poses[new] + carried @ found.poses[old] @ carried.T - both - both.T
        result[p] = own + drift_jacobian_of_pose @ shared @ drift_jacobian_of_pose.T
    return result


def robust_noise(residual: Float64, seen: StereoObservations, used: Bool) -> tuple[float, Bool]:
    """Estimate the scale factor of the sightings' sigmas from their residuals (N, 3) px, and remove
    outliers.
    """
    ratio = np.abs(residual) / seen.sigma_px[:, None]
    factor = max(MIN_FACTOR, mad_sigma(ratio[used]) * dof_correction(seen, used))
    return factor, well_observed(seen, used & (ratio.max(axis=1) < FARTHEST_OUTLIER_SIGMAS * factor))


def _with_seen_noise(
    problem: Problem, seen: StereoObservations, state: GraphState, used: Bool
) -> tuple[Problem, GraphState, System, Bool]:
    """Solve again without outliers and with the sightings' sigmas as their residuals show them."""
    residual = sighting_residuals(problem, state, used)
    factor, used = robust_noise(residual, seen, used)
    seen = replace(seen, sigma_px=factor * seen.sigma_px)
    problem, state, system = solve_with_slides(replace(problem, sightings=seen), state, used)
    residual = sighting_residuals(problem, state, used)
    wider = temporal_inflation(residual, seen, used) * spatial_inflation(residual, seen, used)
    if wider > 1:
        del system
        problem = replace(problem, sightings=replace(seen, sigma_px=wider * seen.sigma_px))
        problem, state, system = solve_with_slides(problem, state, used, rounds=1)
    return problem, state, system, used


def _inertial(state: GraphState, problem: Problem) -> tuple[Float64 | None, tuple[ImuBias, ...]]:
    """Extract the velocities (M, 3) and the biases; None and () without an IMU."""
    if not problem.has_imu:
        return None, ()
    nodes = range(len(problem.start))
    found = [state.values.atConstantBias(B(k)) for k in nodes]
    biases = tuple(ImuBias(np.array(b.gyroscope()), np.array(b.accelerometer())) for b in found)
    return np.array([state.values.atVector(V(k)) for k in nodes]), biases


def _poses(state: GraphState, problem: Problem) -> tuple[Pose, ...]:
    target = problem.start[0].target
    return tuple(_pose(state.values.atPose3(X(k)), target) for k in range(len(problem.start)))


def _pose(pose: Any, target: str) -> Pose:
    return Pose(target, "body", pose.rotation().matrix(), np.asarray(pose.translation()))
