"""Connect a camera by its serial number, count its blocks, and reconnect it: shared by all drivers."""

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
"""Last block number of GigE Vision 1 cameras, which count from 1 to this, then from 1 again."""


@dataclass(frozen=True, eq=False)
class RawPicture:
    """A picture as received. device_ns: the camera's stamp of its exposure. arrival_ns: monotonic.

    trigger: number of blocks that the camera has counted since it was connected.
    """

    device_ns: int
    arrival_ns: int
    trigger: int
    image: UInt8


@dataclass(frozen=True)
class RawLoss:
    """Pictures that the camera counted but that did not arrive complete."""

    cause: str
    count: int


PTP_ROLES = {"Master": 1, "Slave": 2}
"""PTP states by number, for health: a clock that others follow, and one that follows; all others are 0."""


def are_one_clock(ptp: Iterable[str]) -> bool:
    """Check from the cameras' PTP states whether they share one clock.

    They do if both follow a master, or if one follows the other.
    """
    return sorted(ptp) in (["Master", "Slave"], ["Slave", "Slave"])


class Blocks:
    """Counts the blocks of one stream. trigger: number of the last block, missing ones included."""

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
        """Yield the causes of a gap from the driver's counters; what they don't explain is `missed`."""
        for cause, counted in counters.items():
            count = min(counted - self._told.get(cause, 0), gap)
            self._told[cause] = counted
            if count > 0:
                gap -= count
                yield RawLoss(cause, count)
        if gap > 0:
            yield RawLoss("missed", gap)


class CameraDriver(ABC):
    """A camera with a given serial number, connected when pictures are requested and reconnected when lost.

    size: width and height of the calibration. connects: how often it was connected. trouble: why it isn't
    connected, "" if it is. ptp: the PTP state that it reports of its clock, "" if it is not connected or
    reports none.
    """

    errors: ClassVar[type[Exception]]
    """Exceptions that the driver's library raises."""

    def __init__(self, number: int, settings: CamerasSettings, size: tuple[int, int]) -> None:
        self.name, self.serial = f"cam{number}", settings.serials[number]
        self._settings, self._size = settings, size
        self._camera: Any = None
        self.connects, self.trouble, self.ptp = 0, "", ""

    @staticmethod
    @abstractmethod
    def find(settings: CamerasSettings) -> dict[str, Any]:
        """Find all cameras by serial number, without taking control of any."""

    @abstractmethod
    def _control(self, device: Any) -> None:
        """Take control of the camera and configure it."""

    @abstractmethod
    def _release(self) -> None:
        """Release the camera."""

    @abstractmethod
    def _stream(self, may_go_on: Callable[[], bool]) -> Iterator[RawPicture | RawLoss]:
        """Yield from one stream until the camera is lost."""

    def open(self, device: Any) -> None:
        """Take control and configure the camera. Raises InputError if this fails or it does not fit."""
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
        """Release the camera, if it is held."""
        self.ptp = ""
        if self._camera is not None:
            self._release()
            self._camera = None

    def pictures(self, may_go_on: Callable[[], bool]) -> Iterator[RawPicture | RawLoss]:
        """Yield pictures and losses while `may_go_on` returns True; a lost camera is reconnected."""
        while may_go_on():
            try:
                if self._camera is None:
                    self._connect()
                yield from self._stream(may_go_on)
            except (self.errors, InputError) as error:
                self.trouble = " ".join(str(error).split()).removeprefix(f"{self.name}: ")[:300]
            if may_go_on():
                self._drop()
                time.sleep(AGAIN_S)
        self.close()

    def _expect(self, width: int, height: int, pixels: str) -> None:
        """Raise InputError if the camera doesn't provide what was calibrated."""
        if (width, height) != self._size:
            raise InputError(
                self.name,
                f"the camera {self.serial} gives {width}x{height}, the calibration is for "
                f"{self._size[0]}x{self._size[1]}",
                "name the calibration of this rig, or set the camera as it was calibrated",
            )
        if pixels != "Mono8":
            raise InputError(self.name, f"the camera {self.serial} gives {pixels}", "set it to Mono8")

    def _no_clock(self) -> InputError:
        """Return the error about a camera without a clock."""
        return InputError(
            self.name, f"the camera {self.serial} gives no stamps of exposure",
            "use one with a clock: when a picture arrives doesn't tell when it was exposed",
        )  # fmt: skip

    def _connect(self) -> None:
        found = self.find(self._settings)
        if self.serial not in found:
            raise InputError(self.name, "does not answer")
        self.open(found[self.serial])
        self.connects, self.trouble = self.connects + 1, ""

    def _drop(self) -> None:
        try:
            self.close()
        except self.errors:
            self._camera = None


def _step(last: int, block: int) -> int:
    """Count the blocks from one number to another."""
    if last <= WRAP and block <= WRAP:
        return (block - last) % WRAP or 1
    return max(block - last, 1)
