"""Define the protocol of sources of pictures and readings, and the packets that they deliver."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Protocol

from barsight.core.arrays import Float64, Int64, UInt8


@dataclass(frozen=True, eq=False)
class LivePicture:
    """A picture of one camera. image: (H, W) uint8. exposed_ns: the exposure on the monotonic clock.

    trigger: number of the exposure as counted by the camera, from any start; None if it does not count.
    """

    camera: int
    stamp_ns: int
    exposed_ns: int
    image: UInt8
    trigger: int | None = None


@dataclass(frozen=True)
class LostPicture:
    """Pictures that were lost before use. cause: one of `capture`'s counters; count: how many."""

    camera: int
    stamp_ns: int
    cause: str
    count: int = 1


@dataclass(frozen=True, eq=False)
class Readings:
    """Readings of `imu` (gyro rad/s, then accelerometer m/s2) or `crane` (position, m): (N,), (N, width)."""

    sensor: str
    stamp_ns: Int64
    values: Float64


@dataclass(frozen=True)
class SensorSigns:
    """Health data of the sensors. values: by the counter names of the row `sensors`. troubles: why `cam0` or
    `cam1` isn't connected and why a sensor's clock (`imu_clock`) can't be followed, "" if neither is so.
    """

    values: Mapping[str, int]
    troubles: Mapping[str, str]


Packet = LivePicture | LostPicture | Readings | SensorSigns


class Source(Protocol):
    """Protocol of cameras, IMU and encoders. All stamps are of exposure or measurement, never of arrival:
    pictures' on the cameras' clock, readings' on the IMU's.
    """

    @property
    def interval_ns(self) -> int:
        """Return the longest time between two pictures of a camera in normal operation."""
        ...

    def packets(self, after: dict[str, int]) -> Iterator[Packet]:
        """Yield packets as they arrive. after: last stamp already processed of `cam0`, `cam1`, `imu` and
        `crane`, 0 for none.
        """
        ...
