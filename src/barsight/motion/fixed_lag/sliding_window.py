"""Hold the fixed-lag window: unknowns and factors of the last few frames; what leaves stays as a prior.

A point begins anew after as many frames as the window holds, neighbouring points at different frames. So
every point that was seen at a leaving frame has ended and is eliminated as a whole, each sighting being used
once.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from barsight.core.arrays import Float64, Int64
from barsight.core.pose import Pose
from barsight.core.records.pairs import RectifiedCamera
from barsight.core.stamps import NS_PER_S
from barsight.inertial.model import BodyState, ImuBias
from barsight.inertial.preintegration import Preintegrated
from barsight.motion.fixed_lag.propagation import ACCELERATION_DENSITY, NavigationState
from barsight.motion.fixed_lag.window_equations import NewestNode
from barsight.motion.frontend.sightings import Sighting
from barsight.motion.problem.gauss_newton import GraphState
from barsight.motion.problem.problem import MIN_SIGMA_PX, Problem, StereoObservations
from barsight.motion.problem.stereo_factors import initial_points
from barsight.motion.problem.travel import Scales


@dataclass(frozen=True, eq=False)
class Window:
    """Contents of the fixed-lag window.

    problem: of the nodes held, numbered from 0, with their frames' sightings and stated sigmas. state: the
    unknowns; points, named by `names` (T,), are NaN while they have been seen only once. slide: turn of all
    pictures about the camera's axis, rad. frames: number of frames so far; frame_nodes: nodes of the frames
    held. noise: factor on the stated sigmas of the sightings, from their residuals. newest: covariance of the
    last node; drift_covariance: (2, 2) of the rig's drift. seen_ns, placed_ns: stamps of the last node with a
    picture and of the last one with an encoder position; stood: whether the prior of the attitude at rest has
    been added. scales: of the encoders, as `WindowSolution`.
    """

    problem: Problem
    state: GraphState
    names: Int64
    slide: float = 0.0
    frames: int = 0
    noise: float | None = None
    drift_covariance: Float64 | None = None
    frame_nodes: tuple[int, ...] = ()
    newest: NewestNode | None = None
    seen_ns: int | None = None
    placed_ns: int | None = None
    stood: bool = False
    scales: Scales | None = None

    def pose(self, node: int) -> Pose:
        """Return reference_from_body of a node."""
        pose = self.state.values.atPose3(X(node))
        target = self.problem.start[0].target
        return Pose(target, "body", pose.rotation().matrix(), np.asarray(pose.translation()))

    @property
    def body(self) -> BodyState:
        """Return the last node's state; needs an IMU."""
        last = len(self.problem.start) - 1
        pose = self.pose(last)
        return BodyState(pose.rotation, pose.translation, np.asarray(self.state.values.atVector(V(last))))

    @property
    def bias(self) -> ImuBias:
        """Return the last node's biases."""
        if not self.problem.has_imu:
            return ImuBias.none()
        found = self.state.values.atConstantBias(B(len(self.problem.start) - 1))
        return ImuBias(np.array(found.gyroscope()), np.array(found.accelerometer()))

    @property
    def covariance(self) -> Float64:
        """Compute the covariance (6, 6) of the last node's pose, rotation then translation in the reference's
        axes.
        """
        assert self.newest is not None
        rotation = np.kron(np.eye(2), self.pose(len(self.problem.start) - 1).rotation)
        shared = np.zeros((2, 2)) if self.drift_covariance is None else self.drift_covariance
        drift_jacobian_of_pose = self.newest.drift_jacobian_of_pose[:6]
        known = self.newest.covariance[:6, :6] + drift_jacobian_of_pose @ shared @ drift_jacobian_of_pose.T
        if self.newest.by_scales is not None:
            known = known + self.newest.by_scales @ self.newest.by_scales.T
        result: Float64 = rotation @ known @ rotation.T
        return result

    @property
    def navigation(self) -> NavigationState:
        """Return the last node as a state to propagate; without an IMU its velocity is the mean one since the
        frame before.
        """
        assert self.newest is not None
        last = len(self.problem.start) - 1
        pose, stamp_ns = self.pose(last), int(self.problem.stamp_ns[-1])
        shared = np.zeros((2, 2)) if self.drift_covariance is None else self.drift_covariance
        jacobian = self.newest.drift_jacobian_of_pose
        known = self.newest.covariance + jacobian @ shared @ jacobian.T
        rotation = np.eye(len(known))
        rotation[3:6, 3:6] = pose.rotation
        covariance = np.zeros((15, 15))
        covariance[: len(known), : len(known)] = rotation @ known @ rotation.T
        if self.problem.has_imu:
            return NavigationState(stamp_ns, pose.target, self.body, self.bias, covariance)
        velocity = np.zeros(3)
        if len(self.frame_nodes) > 1:
            before = self.frame_nodes[-2]
            seconds = (stamp_ns - int(self.problem.stamp_ns[before])) / NS_PER_S
            velocity = (pose.translation - self.pose(before).translation) / seconds
            covariance[6:9, 6:9] = np.eye(3) * ACCELERATION_DENSITY**2 * seconds
        body = BodyState(pose.rotation, pose.translation, velocity)
        return NavigationState(stamp_ns, pose.target, body, ImuBias.none(), covariance)


def add_nodes(
    window: Window, stamp_ns: list[int], poses: list[Pose], velocity_mps: list[Float64],
    parts: tuple[Preintegrated | None, ...],
) -> Window:  # fmt: skip
    """Add nodes at later stamps (IMU's clock), initialised with the given poses and velocities; parts: the
    motion to each of them from the node before.
    """
    values, problem = gtsam.Values(window.state.values), window.problem
    bias = gtsam.imuBias.ConstantBias(window.bias.accel_mps2, window.bias.gyro_radps)
    for k, (pose, velocity) in enumerate(zip(poses, velocity_mps, strict=True), start=len(problem.start)):
        values.insert(X(k), gtsam.Pose3(gtsam.Rot3(pose.rotation), pose.translation))
        if problem.has_imu:
            values.insert(V(k), velocity)
            values.insert(B(k), bias)
    problem = replace(
        problem, start=(*problem.start, *poses), stamp_ns=np.append(problem.stamp_ns, stamp_ns),
        preintegrated=(*problem.preintegrated, *parts),
    )  # fmt: skip
    return replace(window, problem=problem, state=replace(window.state, values=values))


def add_frame(
    window: Window, sighting: Sighting | None, camera: RectifiedCamera, body_from_rect0: Pose, held: int
) -> Window:
    """Make the last node a frame with this `sighting`; points begin anew every `held` frames."""
    node, count = len(window.problem.start) - 1, window.frames
    grew = replace(window, frames=count + 1, frame_nodes=(*window.frame_nodes, node))
    if sighting is None:
        return grew
    grew = replace(grew, seen_ns=int(window.problem.stamp_ns[-1]))
    name = sighting.track * 1_000_000 + (count + sighting.track) // held
    nodes, sigma = np.full(len(name), node), np.hypot(sighting.sigma_px, MIN_SIGMA_PX)
    stereo, mount = sighting.stereo, body_from_rect0
    old = window.problem.sightings
    if old is not None:
        name, nodes = np.append(window.names[old.track], name), np.append(old.node, nodes)
        stereo, sigma = np.vstack([old.stereo, stereo]), np.append(old.sigma_px, sigma)
        mount = old.body_from_rect0
    order = np.argsort(name, kind="stable")
    first = np.diff(name[order], prepend=-1) > 0
    names = name[order][first]
    seen = StereoObservations(nodes[order], np.cumsum(first) - 1, stereo[order], sigma[order], camera, mount)
    points = np.full((len(names), 4), np.nan)
    points[np.searchsorted(names, window.names)] = _placed(window)
    return replace(
        grew, problem=replace(window.problem, sightings=seen), names=names,
        state=replace(window.state, points=points),
    )  # fmt: skip


def _placed(window: Window) -> Float64:
    """Collect the points (T, 4); those seen only once are initialised from that sighting."""
    points = window.state.points.copy()
    new = np.flatnonzero(np.isnan(points[:, 0]))
    if len(new):
        points[new] = initial_points(window.problem, window.state.poses, new)
    return points
