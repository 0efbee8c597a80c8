"""View a recording without the sensors excluded by the setting `use`."""

from __future__ import annotations

from dataclasses import dataclass

from barsight.calibration.geometry.imu_noise import ImuNoise
from barsight.core.records.sensor_samples import CraneSamples, ImuSamples
from barsight.recording.wrapper import RecordingProxy


@dataclass(frozen=True, eq=False)
class SelectedSensors(RecordingProxy):
    """View of `whole` through `use` (`stereo`, `imu`, `crane`); a sensor that isn't used isn't even read."""

    use: tuple[str, ...]

    def imu(self) -> ImuSamples | None:
        return self.whole.imu() if "imu" in self.use else None

    def imu_noise(self) -> ImuNoise | None:
        return self.whole.imu_noise() if "imu" in self.use else None

    def crane(self) -> CraneSamples | None:
        return self.whole.crane() if "crane" in self.use else None
