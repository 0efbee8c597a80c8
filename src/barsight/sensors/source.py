"""Define the protocol of what gives pictures and readings, and what it gives."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Protocol

from barsight.core.arrays import Float64, Int64, UInt8


@dataclass(frozen=True, eq=False)
class LivePicture:
    """A picture of one camera. image: (H, W) uint8. exposed_ns: the exposure on the monotonic clock.

    trigger: number of the exposure as the camera counts, from any start; None where it does not count.
    """

    camera: int
    stamp_ns: int
    exposed_ns: int
    image: UInt8
    trigger: int | None = None


@dataclass(frozen=True)
class LostPicture:
    """Pictures that were lost before they could be used. cause: of `capture`'s counters; count: how many."""

    camera: int
    stamp_ns: int
    cause: str
    count: int = 1


@dataclass(frozen=True, eq=False)
class Readings:
    """Readings of `imu` (gyro rad/s, then accelerometer m/s2) or `crane` (place, m): (N,), (N, width)."""

    sensor: str
    stamp_ns: Int64
    values: Float64


@dataclass(frozen=True)
class SensorSigns:
    """Signs of the sensors' health. values: by the names of the counters' row `sensors`."""

    values: Mapping[str, int]


Packet = LivePicture | LostPicture | Readings | SensorSigns


class Source(Protocol):
    """Protocol of cameras, IMU and encoders. All stamps are of exposure or measurement, never of arrival:
    pictures' on the cameras' clock, readings' on the IMU's.
    """

    @property
    def interval_ns(self) -> int:
        """Return the time between two pictures of a camera, at most, as long as all is well."""
        ...

    def packets(self, after: dict[str, int]) -> Iterator[Packet]:
        """Yield what comes, when it comes. after: last stamp already taken, of `cam0`, `cam1`, `imu` and
        `crane`; 0 where none was.
        """
        ...
