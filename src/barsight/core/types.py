"""Define the records that travel between the stages: frozen, with shape, unit and frame per field.

The frames are `yard` (or `world`), `body` (the IMU), `cam0`, `cam1` (raw cameras), `rect0` (the left camera
after rectification) and `crane`; docs/reference/conventions.md defines them. No match and no depth are NaN.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from barsight.core.arrays import Bool, Float32, Float64, Int64, UInt8, expect_shape
from barsight.core.motion_detail import MotionDetail
from barsight.core.pose import Pose


@dataclass(frozen=True, eq=False)
class StereoFrame:
    """One raw pair. left, right: (H, W) uint8, cam0 and cam1. stamp_ns: cam0's clock."""

    stamp_ns: int
    left: UInt8
    right: UInt8

    def __post_init__(self) -> None:
        expect_shape("left", self.left, (None, None))
        expect_shape("right", self.right, (None, None))


@dataclass(frozen=True, eq=False)
class NamedPoints:
    """Points of a pair that are known one from another. stamp_ns: cam0's clock.

    names: (N,) int64, each once. left, right: (N, 2) raw px in cam0 and cam1.
    """

    stamp_ns: int
    names: Int64
    left: Float64
    right: Float64

    def __post_init__(self) -> None:
        expect_shape("left", self.left, (self.names.size, 2))
        expect_shape("right", self.right, (self.names.size, 2))


@dataclass(frozen=True)
class RefusedFrame:
    """A frame that can't be used, and why. The run goes on without it."""

    stamp_ns: int
    reason: str


@dataclass(frozen=True, eq=False)
class ImuSamples:
    """stamp_ns: (N,) int64 increasing. gyro_radps, accel_mps2: (N, 3) in `body`."""

    stamp_ns: Int64
    gyro_radps: Float64
    accel_mps2: Float64


@dataclass(frozen=True)
class EncoderJump:
    """A jump of one encoder's readings, from `stamp_ns` on: bridge, trolley or hoist (axis 0, 1, 2).

    size_m: by how much the readings are taken to have jumped; sigma_m: of that. kind: whether it is sure, may
    be one, or might be since the readings stood still before.
    """

    stamp_ns: int
    axis: int
    size_m: float
    sigma_m: float
    kind: Literal["sure", "maybe", "freeze"] = "sure"

    def share(self, stamp_ns: Int64) -> Float64:
        """Return (N,) by how many times its size readings of these stamps are off: 0 or, from it on, 1."""
        return np.where(stamp_ns >= self.stamp_ns, 1.0, 0.0)


@dataclass(frozen=True, eq=False)
class CraneSamples:
    """The encoders' place of the crane's reference point.

    stamp_ns: (N,) int64 increasing. position_m: (N, 3) in `yard`: bridge x, trolley y, hoist z.
    crane_to_body_m: (3,) the body's origin minus the crane point, yard axes.
    yard_from_body_nominal: (3, 3) attitude of the body as mounted. position_std_m: one reading's sigma.
    jumps: found in the readings and taken off them, in time's order; no fit may reach across one.
    """

    stamp_ns: Int64
    position_m: Float64
    crane_to_body_m: Float64
    yard_from_body_nominal: Float64
    position_std_m: float
    jumps: tuple[EncoderJump, ...] = ()


@dataclass(frozen=True, eq=False)
class LaserProfile:
    """A reference contour along X. x_m, y_m, z_m: (N,) in `yard`, x increasing. range_std_m: its sigma."""

    profile: int
    x_m: Float64
    y_m: Float64
    z_m: Float64
    range_std_m: float


@dataclass(frozen=True)
class RectifiedCamera:
    """The geometry of a rectified pair: depth = focal_px * baseline_m / (disparity + doffs_px).

    focal_px is common to both; (cx_px, cy_px) is the left principal point; doffs_px = cx_right - cx_left
    [Middlebury 2014]. width, height in pixels.
    """

    focal_px: float
    cx_px: float
    cy_px: float
    baseline_m: float
    doffs_px: float
    width: int
    height: int


@dataclass(frozen=True, eq=False)
class RectifiedPair:
    """left, right: (H, W) uint8 with matches on the same row, x_right = x_left - disparity.

    left_valid, right_valid: (H, W) bool, False where the raw image has no such pixel.
    left_colour, right_colour: (H, W, 3) uint8, the same in colour (BGR), or None; most methods look at gray.
    """

    stamp_ns: int
    left: UInt8
    right: UInt8
    left_valid: Bool
    right_valid: Bool
    camera: RectifiedCamera
    left_colour: UInt8 | None = None
    right_colour: UInt8 | None = None

    def __post_init__(self) -> None:
        shape = (self.camera.height, self.camera.width)
        for name in ("left", "right", "left_valid", "right_valid"):
            expect_shape(name, getattr(self, name), shape)
        for name in ("left_colour", "right_colour"):
            if getattr(self, name) is not None:
                expect_shape(name, getattr(self, name), (*shape, 3))


@dataclass(frozen=True)
class DisparityRange:
    """Candidates lowest_px <= d < highest_px, whole pixels."""

    lowest_px: int
    highest_px: int

    def __post_init__(self) -> None:
        if self.highest_px <= self.lowest_px:
            raise ValueError(f"the disparity range {self.lowest_px}:{self.highest_px} is empty")

    @property
    def count(self) -> int:
        """Return the number of whole candidates."""
        return self.highest_px - self.lowest_px


@dataclass(frozen=True, eq=False)
class Disparity:
    """disparity_px, sigma_px (one standard deviation): (H, W) float32, NaN where there is no match.

    bias_sigma_px: the part of sigma_px that other views of the same surface repeat, such as pixel locking.
    """

    disparity_px: Float32
    sigma_px: Float32
    bias_sigma_px: float = 0.0

    def __post_init__(self) -> None:
        expect_shape("disparity_px", self.disparity_px, (None, None))
        expect_shape("sigma_px", self.sigma_px, self.disparity_px.shape)

    @property
    def coverage(self) -> float:
        """Return the fraction of pixels that have a disparity."""
        return float(np.isfinite(self.disparity_px).mean()) if self.disparity_px.size else 0.0


@dataclass(frozen=True, eq=False)
class StereoPoints:
    """The points of one view, in `rect0`.

    xyz_m: (N, 3) float32. range_sigma_m: (N,) float32, noise along the viewing ray (averages out over views).
    shared_sigma_m: (N,) float32, the part that is the same in every view (calibration, the method's bias).
    intensity: (N,) uint8.
    """

    stamp_ns: int
    xyz_m: Float32
    range_sigma_m: Float32
    shared_sigma_m: Float32
    intensity: UInt8


@dataclass(frozen=True, eq=False)
class PosedFrame:
    """Pose of one frame. reference_from_body: target is `yard` or `world`.

    covariance: (6, 6), rotation (rad) then translation (m), both in the reference frame's axes.
    """

    stamp_ns: int
    reference_from_body: Pose
    covariance: Float64

    def __post_init__(self) -> None:
        expect_shape("covariance", self.covariance, (6, 6))


@dataclass(frozen=True, eq=False)
class RigDrift:
    """Rig drift against its calibration as the motion shows it.

    yaw_rad: how far cam1 has turned about `rect0`'s y axis. scale: by which share the baseline is longer than
    calibrated, if the encoders' metre is right. covariance: (2, 2) of both. prior_sigma: (2,) what was held
    possible before. range_m: the points' median depth. by_encoders: whether a known way was there.
    """

    yaw_rad: float
    scale: float
    covariance: Float64
    prior_sigma: Float64
    baseline_m: float
    range_m: float
    by_encoders: bool

    @property
    def yaw_sigma_rad(self) -> float:
        """One standard deviation of the yaw."""
        return float(self.covariance[0, 0] ** 0.5)

    @property
    def scale_sigma(self) -> float:
        """One standard deviation of the scale."""
        return float(self.covariance[1, 1] ** 0.5)

    def depth_error_m(self, range_m: float) -> float:
        """Return the depth error by the uncorrected yaw at `range_m` straight ahead."""
        return -self.yaw_rad * range_m**2 / self.baseline_m


@dataclass(frozen=True)
class Trajectory:
    """Poses of the frames that could be placed, in time's order, and the refused ones.

    reference: `yard` or `world`. sensors: which were used. warnings: sentences for the result.
    drift: of the rig, where the estimate sees it. detail: what else it knows, where it is one of all sensors.
    doubts: sentences on what makes all of it doubtful, so that no lift may be chosen by it.
    """

    reference: str
    frames: tuple[PosedFrame, ...]
    refused: tuple[RefusedFrame, ...]
    sensors: tuple[str, ...]
    warnings: tuple[str, ...] = ()
    drift: RigDrift | None = None
    detail: MotionDetail | None = None
    doubts: tuple[str, ...] = ()

    @property
    def stamp_ns(self) -> Int64:
        """Return the frames' stamps (N,)."""
        return np.array([frame.stamp_ns for frame in self.frames], dtype=np.int64)

    @property
    def positions_m(self) -> Float64:
        """Return the body's positions (N, 3) in the reference frame."""
        places = [frame.reference_from_body.translation for frame in self.frames]
        return np.array(places, dtype=np.float64).reshape(-1, 3)

    @property
    def length_m(self) -> float:
        """Return the path length along the frames."""
        return float(np.linalg.norm(np.diff(self.positions_m, axis=0), axis=1).sum())


class HeightSource:
    """Codes of the origin of a cell's height (`height.tif` band `source`, `contour.csv`)."""

    UNKNOWN = 0
    VISION = 1
    LASER = 2
    FILLED = 3

    @classmethod
    def measured(cls, source: UInt8) -> Bool:
        """Mark the cells (...) that a sensor measured, by their codes (...)."""
        found: Bool = (source == cls.VISION) | (source == cls.LASER)
        return found


@dataclass(frozen=True, eq=False)
class Contour:
    """Heights along X at one y. x_m, y_m, z_m, sigma_m: (N,), NaN where unknown. source: (N,)
    `HeightSource`.
    """

    profile: int
    x_m: Float64
    y_m: Float64
    z_m: Float64
    sigma_m: Float64
    source: UInt8

    def __repr__(self) -> str:
        return f"<Contour {self.profile}: {self.x_m.size} points>"


@dataclass(frozen=True)
class Agreement:
    """Agreement of a contour with a reference profile; all in mm but for the coverage.

    samples: compared points. coverage_pct: share of the reference's points that vision measured.
    bias is vision minus reference; loa_low, loa_high are Bland-Altman's 95 % limits of agreement. median and
    mae are of the absolute differences; smooth_mae is taken where the reference has no step over 30 mm within
    20 mm (NaN where it has steps everywhere): at a step the two methods may look past each other.
    x_shift_mm, z_shift_mm: how far the laser's profile lies along x and above where it fits best (NaN where
    too little is in common); time_shift_s: the delay of its clock that explains x_shift at the travel's
    speed. They are reported only: no other figure is corrected by them.
    The last ones are of smooth places, with intervals of 95 % that know how neighbours repeat each other:
    effective_samples, as many as there are independent ones; smooth_bias and its low and high; the limits of
    agreement there, each known to ± smooth_loa_half; slope, the bias that grows with height, mm per m;
    equivalence, the least margin for which two one-sided tests of 5 % call both means equivalent; vision_sd,
    the spread that the laser's own sigma doesn't explain; within_95_pct, the share of differences inside what
    both sigmas state. NaN under eight samples.
    """

    profile: int
    y_m: float
    samples: int
    coverage_pct: float
    bias_mm: float
    median_mm: float
    mae_mm: float
    smooth_mae_mm: float
    rmse_mm: float
    p95_mm: float
    max_mm: float
    loa_low_mm: float
    loa_high_mm: float
    x_shift_mm: float
    z_shift_mm: float
    time_shift_s: float
    smooth_samples: int
    effective_samples: float
    smooth_bias_mm: float
    smooth_bias_low_mm: float
    smooth_bias_high_mm: float
    smooth_loa_low_mm: float
    smooth_loa_high_mm: float
    smooth_loa_half_mm: float
    slope_mm_per_m: float
    slope_low_mm_per_m: float
    slope_high_mm_per_m: float
    equivalence_mm: float
    vision_sd_mm: float
    within_95_pct: float
