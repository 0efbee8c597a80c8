"""What every reader offers: calibration, paired frames one at a time, and the slow sensors as arrays."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from barsight.calibration.rig import StereoRig
from barsight.core.types import (
    CraneSamples,
    ImuSamples,
    LaserProfile,
    RefusedFrame,
    StereoFrame,
)


@dataclass(frozen=True)
class FrameIndex:
    """stamps_ns: the paired frames' stamps (cam0's clock), increasing. unpaired: frames on one side only."""

    stamps_ns: tuple[int, ...]
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
    def index(self) -> FrameIndex:
        """The frames that `frames` will yield, without reading any image."""
        ...

    def frames(self) -> Iterator[StereoFrame | RefusedFrame]:
        """The paired frames in time's order, decoded one at a time; a torn image yields a `RefusedFrame`."""
        ...

    def imu(self) -> ImuSamples | None:
        """The IMU in `body`, or None where the recording has none."""
        ...

    def crane(self) -> CraneSamples | None:
        """The crane's encoders, or None."""
        ...

    def laser(self) -> tuple[LaserProfile, ...]:
        """Reference profiles; empty where there are none."""
        ...

    def digests(self) -> dict[str, str]:
        """SHA-256 of each input file that isn't an image (calibration, CSVs, bag), by relative name."""
        ...
