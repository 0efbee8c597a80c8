"""Represent a recording that is still to come: its calibration and sensors are known, its data is not."""

from __future__ import annotations

from collections.abc import Container, Iterator
from dataclasses import dataclass
from pathlib import Path

from barsight.calibration.geometry.imu_noise import ImuNoise
from barsight.calibration.geometry.rig import StereoRig
from barsight.core.records.pairs import RefusedFrame, StereoFrame
from barsight.core.records.sensor_samples import CraneSamples, ImuSamples, LaserProfile
from barsight.recording.base import FrameIndex


@dataclass(frozen=True, eq=False)
class AwaitedRecording:
    """A `Recording` without frames. imu_samples, crane_samples: empty or the first few; None without the
    sensor.
    """

    path: Path
    rig: StereoRig
    imu_samples: ImuSamples | None
    crane_samples: CraneSamples | None
    noise: ImuNoise | None = None
    format: str = "awaited"
    is_simulated: bool = False
    notes: tuple[str, ...] = ()

    @property
    def index(self) -> FrameIndex:
        return FrameIndex((), ())

    def frames(self, wanted: Container[int] | None = None) -> Iterator[StereoFrame | RefusedFrame]:
        yield from ()

    def imu(self) -> ImuSamples | None:
        return self.imu_samples

    def imu_noise(self) -> ImuNoise | None:
        return self.noise

    def crane(self) -> CraneSamples | None:
        return self.crane_samples

    def laser(self) -> tuple[LaserProfile, ...]:
        return ()

    def digests(self) -> dict[str, str]:
        return {}
