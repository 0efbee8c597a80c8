"""The last few frames' unknowns and what binds them, as a problem of their own; what leaves stays as a prior.

A point begins anew after as many frames as the window holds, each at another frame than its neighbours. So
every point that was seen at a frame which leaves has ended and is taken out whole, each sighting used once.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, E, V, X

from barsight.core.arrays import Bool, Float64, Int64
from barsight.core.pose import Pose
from barsight.core.types import RectifiedCamera
from barsight.inertial.model import BodyState, ImuBias
from barsight.inertial.preintegration import Preintegrated
from barsight.motion import band
from barsight.motion.batch import FARTHEST_OUTLIER_SIGMAS, LEAST_AGREEING, LEAST_FACTOR
from barsight.motion.drift_search import drifted
from barsight.motion.encoders import agreeing
from barsight.motion.graph import factors
from barsight.motion.marginals import Newest, newest
from barsight.motion.problem import Prior, Problem, StereoSightings
from barsight.motion.sightings import Sighting
from barsight.motion.solver import State, linearise, moved, sighting_residuals
from barsight.motion.stereo_factors import nearness, often, persistence, start_points, taken_up
from barsight.motion.system import System

NOISE_SHARE = 0.2
"""By how much one window's noise moves the running one."""


@dataclass(frozen=True, eq=False)
class Window:
    """problem: of the nodes held, numbered from 0, its sightings left out. sightings: of the frames held,
    each with its node. state: the unknowns, points named by `names` (T,). frames: how many there were yet;
    frame_nodes: those held. noise: sightings' sigma as they show it over the stated one. newest: the last
    node's covariance; drift_covariance (2, 2) of the rig's drift.
    """

    problem: Problem
    sightings: tuple[tuple[int, Sighting], ...]
    state: State
    names: Int64
    frames: int = 0
    noise: float | None = None
    drift_covariance: Float64 | None = None
    frame_nodes: tuple[int, ...] = ()
    newest: Newest | None = None

    def pose(self, node: int) -> Pose:
        """reference_from_body."""
        pose = self.state.values.atPose3(X(node))
        target = self.problem.start[0].target
        return Pose(target, "body", pose.rotation().matrix(), np.asarray(pose.translation()))

    def leaving(self, held: int) -> int:
        """How many nodes are before the frames to hold."""
        return self.frame_nodes[-held] if len(self.frame_nodes) > held else 0

    @property
    def body(self) -> BodyState:
        """The last node's, with an IMU."""
        last = len(self.problem.start) - 1
        pose = self.pose(last)
        return BodyState(pose.rotation, pose.translation, np.asarray(self.state.values.atVector(V(last))))

    @property
    def bias(self) -> ImuBias:
        """The last node's."""
        if not self.problem.has_imu:
            return ImuBias.none()
        found = self.state.values.atConstantBias(B(len(self.problem.start) - 1))
        return ImuBias(np.array(found.gyroscope()), np.array(found.accelerometer()))

    @property
    def covariance(self) -> Float64:
        """(6, 6) of the last node's pose, rotation then translation in the reference's axes."""
        assert self.newest is not None
        turned = np.kron(np.eye(2), self.pose(len(self.problem.start) - 1).rotation)
        shared = np.zeros((2, 2)) if self.drift_covariance is None else self.drift_covariance
        swing = self.newest.swing[:6]
        result: Float64 = turned @ (self.newest.covariance[:6, :6] + swing @ shared @ swing.T) @ turned.T
        return result


def grown(
    window: Window, stamp_ns: list[int], poses: list[Pose], velocity_mps: list[Float64],
    parts: tuple[Preintegrated | None, ...],
) -> Window:  # fmt: skip
    """With nodes at later stamps (IMU's clock), started at the given poses and velocities; parts: the motion
    to each from the node before.
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


def with_frame(window: Window, sighting: Sighting | None, held: int) -> Window:
    """The last node is a frame that shows `sighting`; points begin anew every `held` frames."""
    node, count = len(window.problem.start) - 1, window.frames
    seen = window.sightings
    if sighting is not None:
        piece = sighting.track * 1_000_000 + (count + sighting.track) // held
        seen = (*seen, (node, replace(sighting, track=piece)))
    return replace(window, sightings=seen, frames=count + 1, frame_nodes=(*window.frame_nodes, node))


def solved(window: Window, camera: RectifiedCamera, mount: Pose) -> tuple[Window, Problem, Bool]:
    """With the unknowns as they fit best; the problem solved and which of its sightings were used. Raises
    LinAlgError where the measurements leave an unknown undetermined.
    """
    problem, names, points = window.problem, window.names, window.state.points
    seen: StereoSightings | None = None
    used = np.zeros(0, np.bool_)
    if window.sightings:
        seen = StereoSightings.of(
            [s for _, s in window.sightings], [node for node, _ in window.sightings], camera, mount
        )
        stated = seen.sigma_px
        names = np.sort(np.concatenate([s.track for _, s in window.sightings]))
        names = names[np.diff(names, prepend=-1) > 0]
        problem = replace(problem, sightings=replace(seen, sigma_px=(window.noise or 1.0) * stated))
        points = _points(window, problem, names)
        used = often(seen, np.ones(len(seen.node), np.bool_))
    state = replace(window.state, points=points)
    graph = factors(problem)
    # The frame before was solved, so little is left to do: one step before outliers leave, one after.
    system = linearise(problem, graph, state, used)
    state = moved(problem, state, used, *system.step(problem.free))
    noise = window.noise
    if seen is not None and used.any():
        residual = sighting_residuals(problem, state, used)
        share = np.abs(residual) / stated[:, None]
        factor = max(LEAST_FACTOR, 1.4826 * float(np.median(share[used])) * taken_up(seen, used))
        used = often(seen, used & (share.max(axis=1) < FARTHEST_OUTLIER_SIGMAS * factor))
        shown = replace(seen, sigma_px=factor * stated)
        now = factor * persistence(residual, shown, used) * nearness(residual, shown, used)
        noise = now if noise is None else (1 - NOISE_SHARE) * noise + NOISE_SHARE * now
        problem = replace(problem, sightings=replace(seen, sigma_px=noise * stated))
        system = linearise(problem, graph, state, used)
    covariance = None
    if problem.offset_prior_px > 0 and used.any():
        state, drift = drifted(problem, state, system, used)
        covariance = drift.covariance
    elif used.any():
        state = moved(problem, state, used, *system.step(problem.free))
    kept = tuple(
        place for place, fits in zip(problem.placed, agreeing(state.values, problem), strict=True) if fits
    )
    if len(kept) > LEAST_AGREEING * len(problem.placed):
        problem = replace(problem, placed=kept)
    result = replace(
        window, problem=replace(problem, sightings=None), state=state, names=names, noise=noise,
        drift_covariance=covariance, newest=newest(system),
    )  # fmt: skip
    return result, problem, used


def _points(window: Window, problem: Problem, names: Int64) -> Float64:
    """Of each point its place as known, else as its first sighting has it from the pose as known."""
    points = start_points(problem, window.state.poses)
    at = np.searchsorted(window.names, names).clip(0, max(0, len(window.names) - 1))
    if len(window.names):
        known = window.names[at] == names
        points[known] = window.state.points[at[known]]
    return points


def without_first(window: Window, problem: Problem, used: Bool, count: int) -> Window:
    """Without the first `count` nodes. problem, used: as `solved` gave them, sightings included."""
    seen, state = problem.sightings, window.state
    leaving = np.zeros_like(used)
    if seen is not None:
        ended = np.zeros(len(seen.first) - 1, np.bool_)
        ended[seen.track[seen.node < count]] = True
        leaving = used & ended[seen.track]
    part = replace(
        problem, placed=tuple(p for p in problem.placed if p.node < count),
        attitudes=tuple(a for a in problem.attitudes if a.node < count),
    )  # fmt: skip
    system = linearise(part, factors(part, count), state, leaving)
    matrix, gradient = _without(system, count * system.layout.size)
    values = _renumbered(state, problem, count)
    prior = Prior(values, state.drift, matrix, gradient)
    stays = ~ended if seen is not None else np.ones(0, np.bool_)
    sightings = [
        (node - count, _chosen(s, stays[np.searchsorted(window.names, s.track)]))
        for node, s in window.sightings
        if node >= count
    ]
    left = replace(
        window.problem, start=problem.start[count:], stamp_ns=problem.stamp_ns[count:],
        preintegrated=problem.preintegrated[count:], prior=prior,
        placed=tuple(replace(p, node=p.node - count) for p in window.problem.placed if p.node >= count),
        attitudes=tuple(
            replace(a, node=a.node - count) for a in window.problem.attitudes if a.node >= count
        ),
        still=tuple(k - count for k in problem.still if k >= count),
    )  # fmt: skip
    return replace(
        window, problem=left, sightings=tuple((k, s) for k, s in sightings if len(s.track)),
        state=replace(state, values=values),
        frame_nodes=tuple(k - count for k in window.frame_nodes if k >= count),
    )  # fmt: skip


def _without(system: System, count: int) -> tuple[Float64, Float64]:
    """Matrix and gradient of all unknowns but the first `count`, which are taken out."""
    n = len(system.gradient)
    border = len(system.corner)
    whole = np.empty((n + border, n + border))
    band.whole(system.rows, whole[:n, :n])
    whole[n:, :n], whole[:n, n:] = system.side, system.side.T
    whole[n:, n:] = system.corner
    slope = np.concatenate([system.gradient, system.corner_gradient])
    share = np.linalg.solve(whole[:count, :count], whole[:count, count:]).T
    matrix = whole[count:, count:] - share @ whole[:count, count:]
    return (matrix + matrix.T) / 2, slope[count:] - share @ slope[:count]


def _renumbered(state: State, problem: Problem, count: int) -> gtsam.Values:
    nodes = range(count, len(problem.start))
    values = gtsam.Values()
    if problem.has_imu:
        biases = gtsam.VectorValues()
        for k in nodes:
            biases.insert(B(k - count), state.values.atConstantBias(B(k)).vector())
        values = _no_biases(len(nodes)).retract(biases)
    for k in nodes:
        values.insert(X(k - count), state.values.atPose3(X(k)))
        if problem.has_imu:
            values.insert(V(k - count), state.values.atVector(V(k)))
    if problem.has_latency:
        values.insert(E(0), state.values.atVector(E(0)))
    return values


@cache
def _no_biases(count: int) -> gtsam.Values:
    """To add vectors to: to insert a bias itself takes thirty times as long."""
    values = gtsam.Values()
    for k in range(count):
        values.insert(B(k), gtsam.imuBias.ConstantBias())
    return values


def _chosen(sighting: Sighting, kept: Bool) -> Sighting:
    return replace(
        sighting, track=sighting.track[kept], stereo=sighting.stereo[kept], sigma_px=sighting.sigma_px[kept]
    )
