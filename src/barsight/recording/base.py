"""Define the protocol of all readers: calibration, paired frames one at a time, slow sensors as arrays."""

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
    """Largest difference in seconds between the stamps of a left and a right picture that form a pair. Stamps
    of triggered cameras agree exactly; 2 ms, in which a crane moves 1 mm, allow for drivers that stamp on
    arrival.
    """
    rig: Path | None = None
    """Rig file to use instead of the recording's own calibration: Barsight's, Kalibr's, OpenCV's or an EuRoC
    folder. If it doesn't state the mounting of the cameras on the body, the recording's mounting of cam0 is
    kept.
    """
    camchain: Path | None = None
    """Kalibr's camchain-imucam.yaml for a bag; without it, it is searched for in or beside the bag."""
    imu_yaml: Path | None = None
    """Kalibr's imu.yaml for a bag; without it, it is searched for in or beside the bag."""
    cam0_topic: str | None = None
    """Topic of the left pictures in a bag; without it, the camchain's rostopic or one recognised by type."""
    cam1_topic: str | None = None
    """Topic of the right pictures in a bag, likewise."""
    imu_topic: str | None = None
    """Topic of the IMU in a bag, likewise."""

    def __post_init__(self) -> None:
        expect_ranges(self, "recording.", pair_tolerance_s=(0, UNDER_1))


@dataclass(frozen=True)
class FrameIndex:
    """stamps_ns: the paired frames' stamps (cam0's clock), increasing; a session's grow. unpaired: number of
    frames of one side only.
    """

    stamps_ns: Sequence[int]
    unpaired: tuple[RefusedFrame, ...]


class Recording(Protocol):
    """A stereo recording on disk. All stages read recordings only through this protocol.

    path, format: its location and the reader used. is_simulated: stated by the recording itself. rig: the
    calibration. Readers check as they go and raise `InputError` naming the file and the remedy.
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
        """Return sentences on the reader's assumptions (a frame rate, a missing file), for the result."""
        ...

    @property
    def index(self) -> FrameIndex:
        """Index the frames that `frames` will yield, without reading any image."""
        ...

    def frames(self, wanted: Container[int] | None = None) -> Iterator[StereoFrame | RefusedFrame]:
        """Yield the paired frames in time order, decoded one at a time; a damaged image yields a
        `RefusedFrame`.

        wanted: the stamps of those to decode; all, if None.
        """
        ...

    def imu(self) -> ImuSamples | None:
        """Read the IMU in `body`, or None if the recording has none."""
        ...

    def imu_noise(self) -> ImuNoise | None:
        """Read the IMU's noise densities and walks as the recording states them, or None."""
        ...

    def crane(self) -> CraneSamples | None:
        """Read the crane's encoders, or None."""
        ...

    def laser(self) -> tuple[LaserProfile, ...]:
        """Read reference profiles; empty if there are none."""
        ...

    def digests(self) -> dict[str, str]:
        """Compute SHA-256 of each input file that isn't an image (calibration, CSVs, bag), by relative
        name.
        """
        ...
