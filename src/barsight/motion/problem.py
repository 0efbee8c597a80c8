"""What the batch estimate is told: sightings, encoders' places, priors and preintegrated motions."""

from __future__ import annotations

from dataclasses import dataclass

from barsight.core.arrays import Float64, Int64
from barsight.core.pose import Pose
from barsight.core.types import RectifiedCamera
from barsight.inertial.model import ImuBias
from barsight.inertial.preintegration import Preintegrated


@dataclass(frozen=True, eq=False)
class StereoSightings:
    """Points seen: node, track (N,), stereo (N, 3) u, v, right u, px, sigma_px (N,) of each, and how the
    camera is mounted.
    """

    node: Int64
    track: Int64
    stereo: Float64
    sigma_px: Float64
    camera: RectifiedCamera
    body_from_rect0: Pose


@dataclass(frozen=True, eq=False)
class Placed:
    """A node's place by the encoders: (3,) of the body in `yard`, how it moves, and the place's sigma, m."""

    node: int
    position_m: Float64
    velocity_mps: Float64
    acceleration_mps2: Float64
    sigma_m: float


@dataclass(frozen=True, eq=False)
class Attitude:
    """A prior on a node's attitude, reference_from_body (3, 3); sigma_rad (3,) in body axes."""

    node: int
    rotation: Float64
    sigma_rad: Float64


@dataclass(frozen=True, eq=False)
class Problem:
    """Everything the estimate knows. start: (M,) poses to begin from, one per node.

    first_fixed: whether the first node defines the reference (no crane). preintegrated: between nodes k and
    k + 1, None where there is no IMU or it has a gap. still: nodes at which the body doesn't move.
    """

    start: tuple[Pose, ...]
    stamp_ns: Int64
    first_fixed: bool
    sightings: StereoSightings | None
    preintegrated: tuple[Preintegrated | None, ...]
    placed: tuple[Placed, ...]
    attitudes: tuple[Attitude, ...]
    still: tuple[int, ...]
    bias: ImuBias
    gyro_bias_sigma_radps: float = 0.02
    accel_bias_sigma_mps2: float = 0.1
    encoder_latency_sigma_s: float = 0.02
    offset_prior_px: float = 0.1
    """How far a yaw between the cameras may move the disparity (1 sigma); 0 takes it as exact."""
    scale_prior: float = 5e-4
    """By which share baseline and encoders may disagree (1 sigma)."""

    @property
    def sees_scale(self) -> bool:
        """Whether encoders say how long the way is."""
        return bool(self.placed)

    @property
    def has_imu(self) -> bool:
        """Whether any neighbours are tied by the IMU."""
        return any(part is not None for part in self.preintegrated)
