"""The trajectory from the crane's encoders and the body's nominal attitude."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from barsight.calibration.rectification import Rectifier
from barsight.core.arrays import Float64, Int64
from barsight.core.errors import ConfigError, Failed, MeasurementError
from barsight.core.pose import Pose
from barsight.core.stamps import NS_PER_S, seconds_to_ns
from barsight.core.types import CraneSamples, PosedFrame, RefusedFrame, Trajectory
from barsight.recording.base import Recording


@dataclass(frozen=True)
class CraneSettings:
    """Encoders and nominal attitude."""

    window_s: float = 0.35
    """Readings up to this far before and after a frame are fitted with a parabola."""
    attitude_std_deg: float = 0.15
    """How far the body may sway from its nominal attitude (1 sigma, each axis)."""

    def __post_init__(self) -> None:
        if self.window_s <= 0 or self.attitude_std_deg < 0:
            raise ConfigError("window_s must be positive, attitude_std_deg can't be negative")


@dataclass(frozen=True)
class CraneTrajectory:
    """`TrajectoryEstimator` for recordings with encoders; the reference is `yard`."""

    settings: CraneSettings

    def __call__(self, recording: Recording, rectifier: Rectifier, advance: Callable[[], None]) -> Trajectory:
        """Raises MeasurementError where the recording has no encoders. No image is read."""
        crane = recording.crane()
        if crane is None:
            raise MeasurementError(
                f"{recording.path}: no crane encoders; measure without them (--use stereo)"
            )
        shift = recording.rig.timeshift_cam_imu_ns
        placed: list[PosedFrame] = []
        refused: list[RefusedFrame] = []
        for stamp in recording.index.stamps_ns:
            fit = fit_position(crane, stamp + shift, seconds_to_ns(self.settings.window_s))
            if isinstance(fit, Failed):
                refused.append(RefusedFrame(stamp, fit.reason))
            else:
                position, position_covariance = fit
                covariance = np.zeros((6, 6))
                covariance[:3, :3] = np.eye(3) * np.deg2rad(self.settings.attitude_std_deg) ** 2
                covariance[3:, 3:] = position_covariance
                pose = Pose("yard", "body", crane.yard_from_body_nominal, position + crane.crane_to_body_m)
                placed.append(PosedFrame(stamp, pose, covariance))
            advance()
        return Trajectory("yard", tuple(placed), tuple(refused), ("crane",))


def fit_position(crane: CraneSamples, stamp_ns: int, window_ns: int) -> tuple[Float64, Float64] | Failed:
    """The crane point at `stamp_ns` (3,) in `yard`, and its covariance (3, 3).

    A parabola through the readings within the window, by least squares with Huber's weights so that single
    wild readings don't pull. Failed `no-encoder` where the readings don't enclose the stamp.
    """
    first, last = np.searchsorted(crane.stamp_ns, (stamp_ns - window_ns, stamp_ns + window_ns))
    stamps: Int64 = crane.stamp_ns[first:last]
    if stamps.size < 4 or stamps[0] > stamp_ns or stamps[-1] < stamp_ns:
        away = np.abs(crane.stamp_ns - stamp_ns).min() / NS_PER_S
        return Failed(
            "no-encoder", f"{stamps.size} encoder readings around the frame (the nearest {away:.2f} s away)"
        )
    time = (stamps - stamp_ns) / window_ns
    degree = 2 if stamps.size >= 6 else 1
    design = np.vander(time, degree + 1, increasing=True)
    values = crane.position_m[first:last]
    weights = np.ones(stamps.size)
    for _ in range(4):
        coefficients, *_ = np.linalg.lstsq(design * weights[:, None], values * weights[:, None], rcond=None)
        residual = np.linalg.norm(values - design @ coefficients, axis=1) / (3**0.5 * crane.position_std_m)
        weights = np.sqrt(np.minimum(1.0, 1.5 / np.maximum(residual, 1e-9)))
    information = (design * weights[:, None] ** 2).T @ design
    variance = np.linalg.inv(information)[0, 0] * crane.position_std_m**2
    return coefficients[0], np.eye(3) * variance
