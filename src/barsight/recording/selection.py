"""A recording with some of its sensors left out, as `--use` asks."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from barsight.calibration.documents import ImuNoise
from barsight.calibration.rig import StereoRig
from barsight.core.types import (
    CraneSamples,
    ImuSamples,
    LaserProfile,
    RefusedFrame,
    StereoFrame,
)
from barsight.recording.base import FrameIndex, Recording


@dataclass(frozen=True)
class SelectedSensors:
    """`whole` seen through `use` (`stereo`, `imu`, `crane`); what isn't used isn't even read."""

    whole: Recording
    use: tuple[str, ...]

    @property
    def path(self) -> Path:
        return self.whole.path

    @property
    def format(self) -> str:
        return self.whole.format

    @property
    def is_simulated(self) -> bool:
        return self.whole.is_simulated

    @property
    def rig(self) -> StereoRig:
        return self.whole.rig

    @property
    def notes(self) -> tuple[str, ...]:
        return self.whole.notes

    @property
    def index(self) -> FrameIndex:
        return self.whole.index

    def frames(self) -> Iterator[StereoFrame | RefusedFrame]:
        return self.whole.frames()

    def imu(self) -> ImuSamples | None:
        return self.whole.imu() if "imu" in self.use else None

    def imu_noise(self) -> ImuNoise | None:
        return self.whole.imu_noise() if "imu" in self.use else None

    def crane(self) -> CraneSamples | None:
        return self.whole.crane() if "crane" in self.use else None

    def laser(self) -> tuple[LaserProfile, ...]:
        return self.whole.laser()

    def digests(self) -> dict[str, str]:
        return self.whole.digests()
