"""Define the front end's settings."""

from __future__ import annotations

from dataclasses import dataclass, field

from barsight.features.tracks import TrackSettings
from barsight.motion.frontend.stereo_features import OdometrySettings


@dataclass(frozen=True)
class FrontEndSettings:
    """Settings of the front end."""

    tracks: TrackSettings = field(default_factory=TrackSettings)
    rough: OdometrySettings = field(default_factory=lambda: OdometrySettings(features=900))
    """Rough odometry: estimates the motion from corner descriptors where no other sensor predicts it."""
