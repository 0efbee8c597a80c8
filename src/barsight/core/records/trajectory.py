"""Define the records of the body's trajectory, and of the rig's drift that it reveals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from barsight.core.arrays import Float64, Int64, expect_shape
from barsight.core.motion_detail import MotionDetail
from barsight.core.pose import Pose
from barsight.core.records.pairs import RefusedFrame

MIN_TOLD = 1e-3
"""Minimum information of the travel on a direction, relative to the prior, for it to be used."""


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
    """Drift of the rig from its calibration, as the motion shows it.

    yaw_rad: rotation of cam1 about `rect0`'s y axis. scale: relative lengthening of the baseline, if the
    encoders' metre is right. covariance: (2, 2) of both. prior_sigma: (2,) of both before. range_m: the
    points' median depth. by_encoders: whether a known travel was used.
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

    def by_travel(self) -> tuple[Float64, Float64, Float64]:
        """Remove the prior: return rows (K, 2) of yaw and scale that the travel itself observes, their values
        (K,) and variances (K,); K is 2 or less.
        """
        unit, known = self.prior_sigma, np.linalg.inv(self.covariance)
        weight, axes = np.linalg.eigh(known * np.outer(unit, unit) - np.eye(2))
        told = weight > MIN_TOLD
        weight, axes = weight[told], axes[:, told]
        seen = (unit[:, None] * axes).T @ known @ np.array([self.yaw_rad, self.scale]) / weight
        return axes.T / unit, seen, 1 / weight

    def depth_error_m(self, range_m: float) -> float:
        """Return the depth error that the uncorrected yaw causes at `range_m` straight ahead."""
        return -self.yaw_rad * range_m**2 / self.baseline_m


@dataclass(frozen=True)
class Trajectory:
    """Poses of the frames that could be located, in order of time, and the refused frames.

    reference: `yard` or `world`. sensors: the ones used. warnings: sentences for the result. drift: of the
    rig, if the estimate observes it. detail: further figures of an estimate from all sensors. doubts:
    sentences on what makes the whole trajectory doubtful, so that no lift may be chosen by it. rig_moved: the
    same on cameras that moved against each other, or don't expose at the same time.
    """

    reference: str
    frames: tuple[PosedFrame, ...]
    refused: tuple[RefusedFrame, ...]
    sensors: tuple[str, ...]
    warnings: tuple[str, ...] = ()
    drift: RigDrift | None = None
    detail: MotionDetail | None = None
    doubts: tuple[str, ...] = ()
    rig_moved: tuple[str, ...] = ()

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
