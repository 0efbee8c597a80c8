"""Define the choice of a trajectory estimator and its settings."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from barsight.motion.batch.fusion import BatchFusion, FusionSettings
from barsight.motion.crane.encoder_trajectory import CraneSettings, EncoderOdometry
from barsight.motion.estimator import TrajectoryEstimator
from barsight.motion.fixed_lag.estimator import FixedLagFusion, FixedLagSettings
from barsight.motion.frame_to_frame.stitching import PaperStitching, StitchingSettings
from barsight.motion.frame_to_frame.visual_odometry import StereoOdometry
from barsight.motion.frontend.stereo_features import OdometrySettings


@dataclass(frozen=True)
class MotionSettings:
    """The trajectory."""

    estimator: Literal["fused", "live", "crane", "odometry", "paper"] = "fused"
    """fused: all sensors in one estimate. live: the same frame by frame, without looking ahead. crane:
    encoders, nominal attitude and the gyro's sway, no pictures. odometry: frame to frame from the pictures
    alone, for comparison. paper: the paper's stitching by SVD of matches that follow the IMU's trend.
    """
    fusion: FusionSettings = field(default_factory=FusionSettings)
    live: FixedLagSettings = field(default_factory=FixedLagSettings)
    crane: CraneSettings = field(default_factory=CraneSettings)
    odometry: OdometrySettings = field(default_factory=OdometrySettings)
    stitching: StitchingSettings = field(default_factory=StitchingSettings)


def make_estimator(settings: MotionSettings) -> TrajectoryEstimator:
    """Make the estimator that the settings name."""
    match settings.estimator:
        case "fused":
            return BatchFusion(settings.fusion, settings.crane)
        case "live":
            return FixedLagFusion(settings.fusion, settings.live, settings.crane)
        case "crane":
            return EncoderOdometry(settings.crane)
        case "odometry":
            return StereoOdometry(settings.odometry)
        case "paper":
            return PaperStitching(settings.stitching, settings.odometry, settings.crane)


def make_early_estimator(settings: MotionSettings, *, has_crane: bool) -> TrajectoryEstimator:
    """Make the estimator for poses before the recording's end: the one that the settings name if it can give
    them, else one that uses the same sensors.
    """
    named = make_estimator(settings)
    if named.begins_early:
        return named
    if has_crane:
        return EncoderOdometry(settings.crane)
    return FixedLagFusion(settings.fusion, settings.live, settings.crane)
