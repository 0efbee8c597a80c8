"""Define the batch problem: sightings, encoder positions, priors and preintegrated motions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, E, V, X
from scipy.spatial import KDTree

from barsight.core.arrays import Bool, Float64, Int64
from barsight.core.pose import Pose
from barsight.core.records.pairs import RectifiedCamera
from barsight.core.records.sensor_samples import CraneSamples, EncoderJump, ImuSamples
from barsight.inertial.model import ImuBias
from barsight.inertial.preintegration import Preintegrated
from barsight.motion.frontend.sightings import Sighting
from barsight.motion.linear.ordering import Ordering, order_unknowns
from barsight.motion.problem.travel import EncoderTravel, Scales

FIRST_UNEVEN_M = 0.0005
ALIKE_M = 0.5
"""Distance within which rails shift positions by the same amount: a quarter of their waves, which are a few
metres long.
"""
MAX_SIGHTINGS = 40
MIN_SIGMA_PX = 0.03
"""Noise that is added to each sighting's sigma, however well its patch fits: rectification, splines and
aliasing.
"""


@dataclass(frozen=True, eq=False)
class StereoObservations:
    """N sightings of T points: track (N,) 0...T-1 ascending and, within each, node (N,) ascending; stereo
    (N, 3) u, v, right u, px; sigma_px (N,) of each; and how the camera is mounted.
    """

    node: Int64
    track: Int64
    stereo: Float64
    sigma_px: Float64
    camera: RectifiedCamera
    body_from_rect0: Pose

    @classmethod
    def of(
        cls, sightings: Sequence[Sighting], node: Sequence[int], camera: RectifiedCamera,
        body_from_rect0: Pose,
    ) -> StereoObservations:  # fmt: skip
        """Build from the front end's sightings, each with its node. A point that is seen in more than
        `MAX_SIGHTINGS` frames begins anew, which bounds the number of nodes that it couples.
        """
        nodes = np.concatenate([np.full(len(s.track), k) for s, k in zip(sightings, node, strict=True)])
        track = np.concatenate([s.track for s in sightings])
        order = np.lexsort((nodes, track))
        begin = np.flatnonzero(np.diff(track[order], prepend=-1))
        place = np.arange(len(order)) - np.repeat(begin, np.diff(begin, append=len(order)))
        named = np.cumsum(place % MAX_SIGHTINGS == 0) - 1
        stereo = np.vstack([s.stereo for s in sightings])[order]
        sigma = np.hypot(np.concatenate([s.sigma_px for s in sightings])[order], MIN_SIGMA_PX)
        return cls(nodes[order], named, stereo, sigma, camera, body_from_rect0)

    @cached_property
    def first(self) -> Int64:
        """Return the start of each point's sightings, and the end of the last (T + 1,)."""
        return np.searchsorted(self.track, np.arange(self.track.max(initial=-1) + 2)).astype(np.int64)

    @cached_property
    def reach(self) -> Int64:
        """Return the difference (T,) between the nodes of a point's first and last sighting."""
        reach: Int64 = self.node[self.first[1:] - 1] - self.node[self.first[:-1]]
        return reach


@dataclass(frozen=True, eq=False)
class EncoderPosition:
    """Position of a node by the encoders: (3,) of the body in `yard`, its motion, and the position's
    sigma, m.
    """

    node: int
    position_m: Float64
    velocity_mps: Float64
    acceleration_mps2: Float64
    sigma_m: float


@dataclass(frozen=True, eq=False)
class AttitudePrior:
    """Prior on a node's attitude, reference_from_body (3, 3); sigma_rad (3,) in body axes. sways: whether it
    is about the mounting, whose error is an unknown (`attitude_factors`).
    """

    node: int
    rotation: Float64
    sigma_rad: Float64
    sways: bool = False


@dataclass(frozen=True, eq=False)
class Pieces:
    """Pieces of the yard, and what their points have in common (`apparent_motion`). piece: (T,) 0...S-1, the
    piece of each point. own_sigma_rad: (S,) scatter of the slides of a piece's points; share: ratio to this
    of the sigma of the piece's own slide, half of whose variance is common to all pieces. disparity_sigma_px:
    sigma of a piece's disparity bias.

    The common slide is an unknown itself (in units of each piece's sigma), so that pieces are coupled to it
    and not to each other.
    """

    piece: Int64
    own_sigma_rad: Float64
    share: float
    disparity_sigma_px: float

    @property
    def count(self) -> int:
        """Return the number of pieces."""
        return len(self.own_sigma_rad)

    @property
    def slide_sigma_rad(self) -> Float64:
        """Return the sigma (S,) of each piece's slide as a whole."""
        return self.share * self.own_sigma_rad

    def common(self, unknowns: Float64) -> float:
        """Estimate the common slide, in sigma, from `unknowns` (2 S,): slides, then disparity biases."""
        return float((unknowns[: self.count] / self.slide_sigma_rad).sum()) / (self.count + 1)

    def cost(self, unknowns: Float64) -> float:
        """Compute the prior's cost of these: half their squared sum in sigma."""
        slides, disparities = np.split(unknowns, 2)
        common = self.common(unknowns)
        own = slides / self.slide_sigma_rad - common
        return float(own @ own + common**2 + (disparities @ disparities) / self.disparity_sigma_px**2 / 2)


@dataclass(frozen=True, eq=False)
class MarginalPrior:
    """Information of marginalised nodes on those that stay, to second order about `at`.

    nodes: (P,) those that it constrains; at: GTSAM's values of these; border (b,) of the unknowns that all
    nodes share. matrix (n, n) and gradient (n,) of their unknowns, node by node, then the border.
    """

    nodes: Int64
    at: Any
    border: Float64
    matrix: Float64
    gradient: Float64

    @cached_property
    def _poses(self) -> tuple[Any, ...]:
        return tuple(self.at.atPose3(X(k)) for k in self.nodes.tolist())

    @cached_property
    def _inertial(self) -> Float64:
        return inertial_of(self.at, self.nodes)

    def since(self, values: Any) -> Float64:
        """Compute the change of the nodes' unknowns since `at`, node by node in one row."""
        moved = [
            at.localCoordinates(values.atPose3(X(k)))
            for k, at in zip(self.nodes.tolist(), self._poses, strict=True)
        ]
        return np.column_stack([moved, inertial_of(values, self.nodes) - self._inertial]).ravel()


def poses_of(values: Any) -> Float64:
    """Extract reference_from_body (M, 4, 4) from GTSAM's values, which hold nodes 0...M - 1."""
    flat = gtsam.utilities.extractPose3(values)
    poses = np.zeros((len(flat), 4, 4))
    poses[:, :3, :3], poses[:, :3, 3], poses[:, 3, 3] = flat[:, :9].reshape(-1, 3, 3), flat[:, 9:], 1.0
    return poses


def inertial_of(values: Any, nodes: Int64) -> Float64:
    """Extract the nodes' velocities and biases (P, 9) from GTSAM's values; (P, 0) without an IMU."""
    if not values.exists(V(0)):
        return np.empty((len(nodes), 0))
    velocity = [values.atVector(V(k)) for k in nodes.tolist()]
    return np.column_stack([velocity, [values.atConstantBias(B(k)).vector() for k in nodes.tolist()]])


def encoder_unknowns_of(values: Any) -> Float64:
    """Extract the encoders' unknowns (S,) from GTSAM's values: their latency, s, the excess of each jump
    over its stated size, m, relative scales, and the mounting's error, rad; (0,) without encoders.
    """
    return np.asarray(values.atVector(E(0))) if values.exists(E(0)) else np.empty(0)


@dataclass(frozen=True, eq=False)
class Problem:
    """Inputs of the estimate. start: (M,) initial poses, one per node.

    first_fixed: whether the first node defines the reference (no crane). preintegrated: between nodes k and
    k + 1, None where there is no IMU or it has a gap. still: nodes at which the body doesn't move.
    """

    start: tuple[Pose, ...]
    stamp_ns: Int64
    first_fixed: bool
    sightings: StereoObservations | None
    preintegrated: tuple[Preintegrated | None, ...]
    placed: tuple[EncoderPosition, ...]
    attitudes: tuple[AttitudePrior, ...]
    still: tuple[int, ...]
    bias: ImuBias
    gyro_bias_sigma_radps: float = 0.02
    accel_bias_sigma_mps2: float = 0.1
    encoder_latency_sigma_s: float = 0.02
    offset_prior_px: float = 0.1
    """Standard deviation, in px of disparity, of a yaw between the cameras; 0 takes the calibration as
    exact.
    """
    scale_prior: float = 5e-4
    """Standard deviation of the relative scale between baseline and encoders."""
    prior: MarginalPrior | None = None
    """Replaces the priors of the first node, the biases and the encoders' unknowns."""
    crane: CraneSamples | None = None
    """Readings from which `placed` is computed."""
    imu: ImuSamples | None = None
    """Samples that give the crane's motion between those readings."""
    pieces: Pieces | None = None
    """Pieces whose points slide together; None where nothing may slide."""
    asked: Int64 | None = None
    """Nodes whose covariances are wanted, which include all that pictures see; None: all. The others are
    eliminated from the system beforehand (`chain_elimination`).
    """
    has_latency: bool = False
    """Whether the encoders' latency is an unknown."""
    jumps: tuple[EncoderJump, ...] = ()
    """Jumps of the encoders, each of which is an unknown."""
    scaled: tuple[int, ...] = ()
    """Axes whose encoder's scale is an unknown (`encoder_scale`)."""
    held: tuple[int, ...] = ()
    """Those of them whose scale is taken as right, though what shows it is kept."""
    known_scales: Scales | None = None
    """Prior of the scales; None: they may be anything."""
    travelled: EncoderTravel | None = None
    """Encoders' travel before and within `placed`; None: that of `placed`."""
    mounting_sigma_rad: float = float(np.deg2rad(0.1))
    """Prior standard deviation of the mounting's error about each axis."""
    has_imu: bool = False
    """Whether velocities and biases are unknowns."""
    uneven_m: Float64 = field(default_factory=lambda: np.full(3, FIRST_UNEVEN_M))
    """Standard deviation (3,) of the body's motion by rails and springs, which the encoders don't see."""

    @cached_property
    def alike(self) -> Int64:
        """Count, for each encoder position (P,), those that rails and springs shift together with it, itself
        included.
        """
        place = np.array([p.position_m for p in self.placed]).reshape(-1, 3)
        if not len(place):
            return np.empty(0, np.int64)
        return np.asarray(KDTree(place).query_ball_point(place, ALIKE_M, return_length=True), np.int64)

    @cached_property
    def travel(self) -> EncoderTravel | None:
        """Return the encoders' travel; None without any position."""
        return self.travelled or EncoderTravel.of([place.position_m for place in self.placed])

    @property
    def scale_places(self) -> slice:
        """Return the places of the scales among the encoders' unknowns."""
        begin = 1 + len(self.jumps)
        return slice(begin, begin + len(self.scaled))

    @cached_property
    def retained(self) -> Int64:
        """Return the nodes (K,) of the system."""
        return np.arange(len(self.start)) if self.asked is None else self.asked

    @property
    def width(self) -> int:
        """Return the number of unknowns per node: a pose, with an IMU also velocity and biases."""
        return 15 if self.has_imu else 6

    @cached_property
    def places(self) -> Int64:
        """Return the index (M,) of each node in the system; -1 for those eliminated beforehand."""
        places = np.full(len(self.start), -1)
        places[self.retained] = np.arange(len(self.retained))
        return places

    @cached_property
    def layout(self) -> Ordering:
        """Order the unknowns of the system."""
        begin = end = np.empty(0, np.int64)
        if self.sightings is not None and len(self.sightings.node):
            node, first = self.places[self.sightings.node], self.sightings.first
            begin, end = node[first[:-1]], node[first[1:] - 1]
        piece = None if self.pieces is None else self.pieces.piece
        return order_unknowns(self.width, len(self.retained), begin, end, piece)

    @property
    def encoder_unknowns(self) -> int:
        """Count the encoders' unknowns: latency, jumps, scales and the mounting's error."""
        return 1 + len(self.jumps) + len(self.scaled) + 3 if self.has_latency else 0

    @property
    def border(self) -> int:
        """Count the unknowns that all nodes share: the encoders', the pieces' common slide, the rig's
        drift.
        """
        return self.encoder_unknowns + int(self.pieces is not None) + 2

    @property
    def free(self) -> Bool:
        """Select all unknowns of the border (border,) but the drift, which is estimated separately."""
        free = np.ones(self.border, np.bool_)
        free[-2:] = False
        return free

    @property
    def sees_scale(self) -> bool:
        """Check whether encoders give the length of the travel."""
        return self.has_latency
