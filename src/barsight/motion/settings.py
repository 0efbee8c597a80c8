"""The choice of a trajectory estimator and its settings."""

from __future__ import annotations

from dataclasses import dataclass, field

from barsight.motion.crane import CraneSettings, CraneTrajectory
from barsight.motion.estimator import TrajectoryEstimator
from barsight.motion.odometry import OdometrySettings, StereoOdometry


@dataclass(frozen=True)
class MotionSettings:
    """The trajectory."""

    crane: CraneSettings = field(default_factory=CraneSettings)
    odometry: OdometrySettings = field(default_factory=OdometrySettings)


def make_estimator(settings: MotionSettings, *, has_crane: bool) -> TrajectoryEstimator:
    """The crane's encoders where there are any, else stereo odometry."""
    return CraneTrajectory(settings.crane) if has_crane else StereoOdometry(settings.odometry)
