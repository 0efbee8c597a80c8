"""Define the settings of a measurement."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

from barsight.core.errors import ConfigError
from barsight.core.settings.values import expect_values
from barsight.mapping.settings import MapSettings
from barsight.motion.settings import MotionSettings
from barsight.recording.base import RecordingSettings
from barsight.stereo.settings import StereoSettings
from barsight.yard.bundles.fitting.settings import BundleSettings
from barsight.yard.label_settings import LabelSettings
from barsight.yard.lift_settings import LiftSettings

_FAST_SHIFT = 0.15


@dataclass(frozen=True)
class MeasureSettings:
    """Settings of `barsight measure`; each stage receives only its own part."""

    preset: Literal["best", "fast"] = "best"
    """Choice between accuracy and speed. `fast`: the stereo preset `fast`, and only pictures are matched that
    are at least 0.15 of their shorter side apart.
    """
    use: tuple[Literal["stereo", "imu", "crane"], ...] = ("stereo", "imu", "crane")
    """Sensors that may be used if the recording has them."""
    self_calibrate: Literal["none", "yaw"] = "none"
    """Correction of the rig by the travel. `yaw`: turn the right camera to agree with the crane's known
    travel (see `barsight calibrate check`).
    """
    yard: Path | None = None
    """File written by `barsight calibrate yard`: the map, its poses and lifts are then in the surveyed yard,
    and their sigma includes that of the file.
    """
    recording: RecordingSettings = field(default_factory=RecordingSettings)
    stereo: StereoSettings = field(default_factory=StereoSettings)
    motion: MotionSettings = field(default_factory=MotionSettings)
    map: MapSettings = field(default_factory=MapSettings)
    bundles: BundleSettings = field(default_factory=BundleSettings)
    labels: LabelSettings = field(default_factory=LabelSettings)
    lift: LiftSettings = field(default_factory=LiftSettings)

    def __post_init__(self) -> None:
        expect_values(self)
        if "stereo" not in self.use:
            raise ConfigError("use must contain stereo: the map is made from the pictures")

    def chosen(self) -> MeasureSettings:
        """Apply the preset to the settings."""
        if self.preset == "best":
            return self
        stereo = replace(self.stereo, barsight=replace(self.stereo.barsight, preset="fast"))
        shift = max(self.map.min_shift, _FAST_SHIFT)
        return replace(self, stereo=stereo, map=replace(self.map, min_shift=shift))
