"""Place the nodes of the estimate in time: at the frames and, with an IMU, in between."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from barsight.calibration.geometry.imu_noise import ImuNoise
from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.arrays import Bool, Float64, Int64
from barsight.core.errors import Failed
from barsight.core.pose import Pose
from barsight.core.records.sensor_samples import CraneSamples, ImuSamples
from barsight.core.stamps import NS_PER_S, seconds_to_ns
from barsight.inertial.model import ImuBias
from barsight.inertial.standstill import estimate_at_rest, stands_still
from barsight.motion.crane.encoder_trajectory import fit_position
from barsight.motion.frontend.chains import chained_poses, imu_bridges
from barsight.motion.frontend.sightings import Sighting
from barsight.motion.gravity import GravityAlignment

if TYPE_CHECKING:
    from barsight.inertial.preintegration import Preintegrated

MAX_SPACING_S = 0.4
LEAD_S = 3.0
"""Duration of the IMU's samples before the first frame that are used too: a crane starts from rest."""
MAX_STILL_M = 0.005


@dataclass(frozen=True, eq=False)
class Nodes:
    """stamp_ns: (M,) on the IMU's clock, increasing. frame: (F,) the node of each frame."""

    stamp_ns: Int64
    frame: Int64


@dataclass(frozen=True, eq=False)
class ImuConstraints:
    """preintegrated: between nodes k and k + 1, or None. still: nodes at rest. bias: as observed at rest."""

    preintegrated: tuple[Preintegrated | None, ...]
    still: tuple[int, ...]
    bias: ImuBias


def make_nodes(frames_ns: Int64, imu: ImuSamples | None) -> Nodes:
    """Place nodes at the frames' stamps (IMU clock); with an IMU also between them and before the first.

    Only the IMU ties those additional nodes, so there are none where it is silent.
    """
    if imu is None or imu.stamp_ns.size < 2:
        return Nodes(frames_ns, np.arange(len(frames_ns)))
    edges, tied = frames_ns.tolist(), imu_bridges(imu, 0)
    lead = max(int(imu.stamp_ns[0]), edges[0] - seconds_to_ns(LEAD_S))
    if edges[0] - lead > seconds_to_ns(0.1) and tied(lead, edges[0]):
        edges.insert(0, lead)
    stamps = [edges[0]]
    for first, last in pairwise(edges):
        stamps += subdivide(first, last) if tied(first, last) else [last]
    stamp_ns = np.array(stamps, np.int64)
    return Nodes(stamp_ns, np.searchsorted(stamp_ns, frames_ns))


def subdivide(first_ns: int, last_ns: int) -> list[int]:
    """Divide an interval: stamps after the first up to the last, at most about `MAX_SPACING_S` apart."""
    parts = max(1, int(np.ceil((last_ns - first_ns) / seconds_to_ns(MAX_SPACING_S) - 0.05)))
    return [first_ns + (last_ns - first_ns) * part // parts for part in range(1, parts + 1)]


def initial_poses(
    nodes: Nodes, crane: CraneSamples | None, sightings: tuple[Sighting, ...], shift_ns: int,
    rectifier: Rectifier, level: GravityAlignment | None,
) -> tuple[Pose, ...]:  # fmt: skip
    """Initialise the poses: by the encoders' positions and the nominal attitude, else by chaining the
    frames.
    """
    if crane is not None:
        stamps, places = [], []
        for stamp in nodes.stamp_ns.tolist():
            fit = fit_position(crane, stamp, seconds_to_ns(0.35))
            if not isinstance(fit, Failed):
                stamps.append(stamp)
                places.append(fit.position_m + crane.crane_to_body_m)
        turns = Rotation.from_matrix(np.repeat(crane.yard_from_body_nominal[None], len(stamps), axis=0))
        return _between("yard", nodes.stamp_ns, np.array(stamps), np.array(places), turns)
    assert level is not None
    poses = chained_poses(sightings, level.world_from_body, rectifier.body_from_rect0)
    known = np.array([sighting.stamp_ns + shift_ns for sighting in sightings])
    turns = Rotation.from_matrix([pose.rotation for pose in poses])
    return _between("world", nodes.stamp_ns, known, np.array([p.translation for p in poses]), turns)


def _between(
    target: str, stamp_ns: Int64, known_ns: Int64, places: Float64, turns: Rotation
) -> tuple[Pose, ...]:
    """Interpolate poses at the nodes; beyond the ends the nearest known one is used."""
    time = (np.clip(stamp_ns, known_ns[0], known_ns[-1]) - known_ns[0]) / NS_PER_S
    known = (known_ns - known_ns[0]) / NS_PER_S
    place = np.column_stack([np.interp(time, known, places[:, axis]) for axis in range(3)])
    if len(known) > 1:
        turns = Slerp(known, turns)(time)
    rotation = np.broadcast_to(turns.as_matrix(), (len(time), 3, 3))
    return tuple(Pose(target, "body", r, p) for r, p in zip(rotation, place, strict=True))


def constrain_by_imu(
    nodes: Nodes, start: tuple[Pose, ...], placed_ns: tuple[int, int], imu: ImuSamples | None, noise: ImuNoise
) -> ImuConstraints:
    """Preintegrate between neighbouring nodes and detect those at rest. placed_ns: first and last stamp
    (IMU's clock) at which the initial poses are known.
    """
    count = len(nodes.stamp_ns)
    if imu is None:
        return ImuConstraints((None,) * (count - 1), (), ImuBias.none())
    known = (nodes.stamp_ns >= placed_ns[0]) & (nodes.stamp_ns <= placed_ns[1])
    still = _resting(nodes.stamp_ns, start, known, imu, noise)
    bias = _bias_at_rest(nodes, still, imu, noise)
    return ImuConstraints(preintegrate_between(nodes.stamp_ns, imu, noise, bias), tuple(still), bias)


def preintegrate_between(
    stamp_ns: Int64, imu: ImuSamples, noise: ImuNoise, bias: ImuBias
) -> tuple[Preintegrated | None, ...]:
    """Preintegrate between neighbouring stamps (M,); None where the IMU has a gap."""
    from barsight.inertial.preintegration import Preintegrator

    integrator = Preintegrator(imu, noise)
    parts = [integrator.between(int(a), int(b), bias) for a, b in pairwise(stamp_ns.tolist())]
    return tuple(None if isinstance(part, Failed) else part for part in parts)


def _resting(
    stamp_ns: Int64, start: tuple[Pose, ...], known: Bool, imu: ImuSamples, noise: ImuNoise
) -> list[int]:
    """Detect the nodes (M,) at rest. Both must hold: the IMU shows nothing but noise, as it also does at
    constant speed, and the position doesn't change between the neighbours. Where no position is `known` (M,),
    an adjacent rest continues as long as the IMU shows nothing but noise.
    """
    quiet = is_imu_quiet(stamp_ns, imu, noise)
    place = np.array([pose.translation for pose in start])
    index = np.flatnonzero(known)
    rests = np.zeros(len(stamp_ns), np.bool_)
    for k, node in enumerate(index):
        first, last = index[max(0, k - 1)], index[min(len(index) - 1, k + 1)]
        near = np.linalg.norm(place[last] - place[first]) < MAX_STILL_M
        rests[node] = quiet[node] and near and last > first
    if len(index):
        for k in range(index[0] - 1, -1, -1):
            rests[k] = quiet[k] and rests[k + 1]
        for k in range(index[-1] + 1, len(rests)):
            rests[k] = quiet[k] and rests[k - 1]
    return [int(k) for k in np.flatnonzero(rests)]


def is_imu_quiet(stamp_ns: Int64, imu: ImuSamples, noise: ImuNoise) -> Bool:
    """Check (M,) whether the IMU shows only noise around each of the stamps; False without readings."""
    if not imu.stamp_ns.size:
        return np.zeros(len(stamp_ns), np.bool_)
    nearest = np.clip(np.searchsorted(imu.stamp_ns, stamp_ns), 0, imu.stamp_ns.size - 1)
    quiet: Bool = stands_still(imu, noise)[nearest]
    return quiet


def _bias_at_rest(nodes: Nodes, still: list[int], imu: ImuSamples, noise: ImuNoise) -> ImuBias:
    """Estimate the biases from the first rest; zero where there is none."""
    if not still:
        return ImuBias.none()
    last = still[0]
    while last + 1 in still:
        last += 1
    start = estimate_at_rest(imu, int(nodes.stamp_ns[still[0]]), int(nodes.stamp_ns[last]), noise)
    return ImuBias.none() if isinstance(start, Failed) else start.bias
