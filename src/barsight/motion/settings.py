"""The choice of a trajectory estimator and its settings."""

from __future__ import annotations

from dataclasses import dataclass, field

from barsight.motion.crane import CraneSettings
from barsight.motion.estimator import TrajectoryEstimator
from barsight.motion.fusion import FusedTrajectory, FusionSettings


@dataclass(frozen=True)
class MotionSettings:
    """The trajectory."""

    fusion: FusionSettings = field(default_factory=FusionSettings)
    crane: CraneSettings = field(default_factory=CraneSettings)


def make_estimator(settings: MotionSettings) -> TrajectoryEstimator:
    """One estimate from the sensors that the recording has and `fusion.use` names."""
    return FusedTrajectory(settings.fusion, settings.crane)
