"""Define the protocol of every reader: calibration, paired frames one at a time, slow sensors as arrays."""

from __future__ import annotations

from collections.abc import Container, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from barsight.calibration.geometry.imu_noise import ImuNoise
from barsight.calibration.geometry.rig import StereoRig
from barsight.core.records.pairs import RefusedFrame, StereoFrame
from barsight.core.records.sensor_samples import CraneSamples, ImuSamples, LaserProfile
from barsight.core.settings.values import UNDER_1, expect_ranges


@dataclass(frozen=True)
class RecordingSettings:
    """Settings of reading a recording."""

    pair_tolerance_s: float = 0.002
    """How far apart the stamps of a left and a right picture may lie. Triggered cameras' stamps agree
    exactly; 2 ms leave room for drivers that stamp on arrival, in which a crane moves 1 mm."""
    rig: Path | None = None
    """A rig file to use instead of the recording's own calibration: ours, Kalibr's, OpenCV's or an EuRoC
    folder. Where it doesn't say how the cameras sit on the body, the recording's mounting of cam0 stays."""
    camchain: Path | None = None
    """Kalibr's camchain-imucam.yaml for a bag; found in or beside the bag when not given."""
    imu_yaml: Path | None = None
    """Kalibr's imu.yaml for a bag; found in or beside the bag when not given."""
    cam0_topic: str | None = None
    """A bag's topic of left pictures; the camchain's rostopic, else recognised by type, when not given."""
    cam1_topic: str | None = None
    """A bag's topic of right pictures, likewise."""
    imu_topic: str | None = None
    """A bag's topic of the IMU, likewise."""

    def __post_init__(self) -> None:
        expect_ranges(self, "recording.", pair_tolerance_s=(0, UNDER_1))


@dataclass(frozen=True)
class FrameIndex:
    """stamps_ns: the paired frames' stamps (cam0's clock), increasing; a session's grow. unpaired: frames on
    one side only.
    """

    stamps_ns: Sequence[int]
    unpaired: tuple[RefusedFrame, ...]


class Recording(Protocol):
    """A stereo recording on disk. Every stage reads recordings through this and nothing else.

    path, format: where it lies and which reader took it. is_simulated: said by the recording itself.
    rig: the calibration. Readers check as they go and raise `InputError` naming the file and the remedy.
    """

    @property
    def path(self) -> Path: ...

    @property
    def format(self) -> str: ...

    @property
    def is_simulated(self) -> bool: ...

    @property
    def rig(self) -> StereoRig: ...

    @property
    def notes(self) -> tuple[str, ...]:
        """Return sentences on what the reader had to assume (a frame rate, a missing file), for the
        result.
        """
        ...

    @property
    def index(self) -> FrameIndex:
        """Index the frames that `frames` will yield, without reading any image."""
        ...

    def frames(self, wanted: Container[int] | None = None) -> Iterator[StereoFrame | RefusedFrame]:
        """Yield the paired frames in time's order, decoded one at a time; a torn image yields a
        `RefusedFrame`.

        wanted: the stamps of those to decode; all, if None.
        """
        ...

    def imu(self) -> ImuSamples | None:
        """Read the IMU in `body`, or None where the recording has none."""
        ...

    def imu_noise(self) -> ImuNoise | None:
        """Read the IMU's noise densities and walks as the recording states them, or None."""
        ...

    def crane(self) -> CraneSamples | None:
        """Read the crane's encoders, or None."""
        ...

    def laser(self) -> tuple[LaserProfile, ...]:
        """Read reference profiles; empty where there are none."""
        ...

    def digests(self) -> dict[str, str]:
        """Compute SHA-256 of each input file that isn't an image (calibration, CSVs, bag), by
        relative name.
        """
        ...
