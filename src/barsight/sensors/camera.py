"""Connect a camera by its serial number, count its blocks, and seek it again: what all drivers share."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from barsight.core.arrays import UInt8
from barsight.core.errors import InputError
from barsight.sensors.settings import CamerasSettings

WAIT_MS = 200
AGAIN_S = 1.0
WRAP = 65535
"""Cameras of GigE Vision 1 count blocks from 1 to this, then from 1 again."""


@dataclass(frozen=True, eq=False)
class RawPicture:
    """A picture as it came. device_ns: the camera's stamp of its exposure. arrival_ns: monotonic.

    trigger: blocks that the camera has counted since it was connected.
    """

    device_ns: int
    arrival_ns: int
    trigger: int
    image: UInt8


@dataclass(frozen=True)
class RawLoss:
    """Pictures that the camera counted and that did not come whole."""

    cause: str
    count: int


PTP_ROLES = {"Master": 1, "Slave": 2}
"""PTP states by number, for health: a clock that others follow, and one that follows; all others are 0."""


def are_one_clock(ptp: Iterable[str]) -> bool:
    """Check by the cameras' PTP states whether their clocks are one: both follow a master, or one follows the
    other.
    """
    return sorted(ptp) in (["Master", "Slave"], ["Slave", "Slave"])


class Blocks:
    """Counts the blocks of one stream. trigger: the last one's number, those that didn't come counted too."""

    def __init__(self) -> None:
        self.trigger = 0
        self._last_id: int | None = None
        self._told: dict[str, int] = {}

    def gap(self, block_id: int) -> int:
        """Count a block; return how many are missing before it."""
        gap = 0 if self._last_id is None else _step(self._last_id, block_id) - 1
        self._last_id, self.trigger = block_id, self.trigger + gap + 1
        return gap

    def losses(self, gap: int, counters: Mapping[str, int]) -> Iterator[RawLoss]:
        """Tell the causes of a gap from the driver's counters; what they don't explain is `missed`."""
        for cause, counted in counters.items():
            count = min(counted - self._told.get(cause, 0), gap)
            self._told[cause] = counted
            if count > 0:
                gap -= count
                yield RawLoss(cause, count)
        if gap > 0:
            yield RawLoss("missed", gap)


class CameraDriver(ABC):
    """A camera of one serial number, connected when pictures are asked for and anew after it was lost.

    size: width and height that the calibration has. connects: how often it was connected. ptp: the state that
    it tells of its clock's PTP, "" where it is not connected or tells none.
    """

    errors: ClassVar[type[Exception]]
    """All that the driver's library raises."""

    def __init__(self, number: int, settings: CamerasSettings, size: tuple[int, int]) -> None:
        self.name, self.serial = f"cam{number}", settings.serials[number]
        self._settings, self._size = settings, size
        self._camera: Any = None
        self.connects, self.ptp = 0, ""

    @staticmethod
    @abstractmethod
    def find(settings: CamerasSettings) -> dict[str, Any]:
        """Find all cameras by serial number, without taking control of one."""

    @abstractmethod
    def _control(self, device: Any) -> None:
        """Take control, and set the camera."""

    @abstractmethod
    def _release(self) -> None:
        """Give the camera back."""

    @abstractmethod
    def _stream(self, may_go_on: Callable[[], bool]) -> Iterator[RawPicture | RawLoss]:
        """Yield from one stream until the camera is lost."""

    def open(self, device: Any) -> None:
        """Take control and set the camera. Raises InputError where it can't be or does not fit."""
        try:
            self._control(device)
        except InputError:
            self._drop()
            raise
        except self.errors as error:
            self._drop()
            raise InputError(
                self.name, f"the camera {self.serial} refuses: {' '.join(str(error).split())[:200]}",
                "see that no other program controls it and that it has the setting",
            ) from error  # fmt: skip

    def close(self) -> None:
        """Give the camera back, if it is held."""
        self.ptp = ""
        if self._camera is not None:
            self._release()
            self._camera = None

    def pictures(self, may_go_on: Callable[[], bool]) -> Iterator[RawPicture | RawLoss]:
        """Yield pictures and losses as long as `may_go_on` says so; a camera that is lost is sought again."""
        while may_go_on():
            try:
                if self._camera is None:
                    self._connect()
                yield from self._stream(may_go_on)
            except (self.errors, InputError):
                pass
            if may_go_on():
                self._drop()
                time.sleep(AGAIN_S)
        self.close()

    def _expect(self, width: int, height: int, pixels: str) -> None:
        """Raise InputError where the camera doesn't give what was calibrated."""
        if (width, height) != self._size:
            raise InputError(
                self.name,
                f"the camera {self.serial} gives {width}x{height}, the calibration is for "
                f"{self._size[0]}x{self._size[1]}",
                "name the calibration of this rig, or set the camera as it was calibrated",
            )
        if pixels != "Mono8":
            raise InputError(self.name, f"the camera {self.serial} gives {pixels}", "set it to Mono8")

    def _connect(self) -> None:
        found = self.find(self._settings)
        if self.serial not in found:
            raise InputError(self.name, "does not answer")
        self.open(found[self.serial])
        self.connects += 1

    def _drop(self) -> None:
        try:
            self.close()
        except self.errors:
            self._camera = None


def _step(last: int, block: int) -> int:
    """Count blocks from one number to the next."""
    if last <= WRAP and block <= WRAP:
        return (block - last) % WRAP or 1
    return max(block - last, 1)
