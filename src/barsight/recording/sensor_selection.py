"""View a recording with some of its sensors left out, as `use` asks."""

from __future__ import annotations

from dataclasses import dataclass

from barsight.calibration.geometry.imu_noise import ImuNoise
from barsight.core.records.sensor_samples import CraneSamples, ImuSamples
from barsight.recording.wrapper import RecordingProxy


@dataclass(frozen=True, eq=False)
class SelectedSensors(RecordingProxy):
    """`whole` seen through `use` (`stereo`, `imu`, `crane`); what isn't used isn't even read."""

    use: tuple[str, ...]

    def imu(self) -> ImuSamples | None:
        return self.whole.imu() if "imu" in self.use else None

    def imu_noise(self) -> ImuNoise | None:
        return self.whole.imu_noise() if "imu" in self.use else None

    def crane(self) -> CraneSamples | None:
        return self.whole.crane() if "crane" in self.use else None
