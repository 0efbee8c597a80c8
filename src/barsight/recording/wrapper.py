"""Forward a recording to a wrapper that changes part of it."""

from __future__ import annotations

from collections.abc import Container, Iterator
from dataclasses import dataclass
from pathlib import Path

from barsight.calibration.geometry.imu_noise import ImuNoise
from barsight.calibration.geometry.rig import StereoRig
from barsight.core.records.pairs import RefusedFrame, StereoFrame
from barsight.core.records.sensor_samples import CraneSamples, ImuSamples, LaserProfile
from barsight.recording.base import FrameIndex, Recording


@dataclass(frozen=True, eq=False)
class RecordingProxy:
    """Forwards everything to `whole`; a subclass overrides what it changes."""

    whole: Recording

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

    def frames(self, wanted: Container[int] | None = None) -> Iterator[StereoFrame | RefusedFrame]:
        return self.whole.frames(wanted)

    def imu(self) -> ImuSamples | None:
        return self.whole.imu()

    def imu_noise(self) -> ImuNoise | None:
        return self.whole.imu_noise()

    def crane(self) -> CraneSamples | None:
        return self.whole.crane()

    def laser(self) -> tuple[LaserProfile, ...]:
        return self.whole.laser()

    def digests(self) -> dict[str, str]:
        return self.whole.digests()
