"""Receive readings of IMU and encoders, by UDP or a serial line; `forms` lays them out."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from barsight.core.errors import ConfigError
from barsight.core.stamps import NS_PER_S
from barsight.sensors.forms import FORMS
from barsight.sensors.settings import ReadingsSettings

MAX_BYTES = 65536
NUMBERS = 1 << 32
ANEW_AFTER_NS, ANEW_COUNT = NS_PER_S // 2, 3
"""No network holds a reading back for so long, nor so many, one after another, with none newer between."""


@dataclass(frozen=True)
class RawReading:
    """A reading as it came. device_ns: its stamp. arrival_ns: monotonic. lost: readings missing before it."""

    device_ns: int
    arrival_ns: int
    values: tuple[float, ...]
    lost: int


class Way(Protocol):
    """A way that readings come. keeps_order: none is overtaken. trouble: why nothing can come now, or ""."""

    keeps_order: bool
    trouble: str

    def receive(self) -> tuple[bytes, int]:
        """Wait 0.1 s at most; return whole readings, one after another, and how many were torn."""
        ...

    def close(self) -> None:
        """Give it free."""
        ...


class UdpPort:
    """Receives datagrams of readings of `size` bytes."""

    keeps_order, trouble = False, ""

    def __init__(self, sensor: str, size: int, port: int, host: str = "0.0.0.0") -> None:
        """Raises ConfigError where the port is taken."""
        self._size = size
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.settimeout(0.1)
        try:
            self._socket.bind((host, port))
        except OSError as error:
            self._socket.close()
            raise ConfigError(
                f"{sensor}: UDP port {port} can't be opened ({error.strerror}); name a free one"
            ) from error

    def receive(self) -> tuple[bytes, int]:
        """Return a datagram, see `Way`."""
        try:
            data = self._socket.recv(MAX_BYTES)
        except TimeoutError:
            return b"", 0
        return (b"", 1) if not data or len(data) % self._size else (data, 0)

    def close(self) -> None:
        """Free the port."""
        self._socket.close()


class Sequence:
    """Judges the numbers that a sender counts its readings by.

    A number that isn't ahead is doubled or was overtaken on its way, or its sender began anew: then its stamp
    is later than the last one's, or, where the sender's clock began anew too, nothing newer comes any more.
    So did one that is further ahead than the sensor could have counted meanwhile. overtaken: readings left
    out; restarts: how often a sender began anew.
    """

    def __init__(self, rate_hz: float, *, keeps_order: bool) -> None:
        self._rate_hz, self._keeps_order = rate_hz, keeps_order
        self._last: tuple[int, int, int] | None = None
        self._behind = self.overtaken = self.restarts = 0

    def lost_before(self, number: int, stamp_ns: int, arrival_ns: int) -> int | None:
        """Take a reading; return how many are missing before it, None where it is to be left out."""
        before, self._last = self._last, (number, stamp_ns, arrival_ns)
        if before is None:
            return 0
        last, last_stamp_ns, last_arrival_ns = before
        step = (number - last) % NUMBERS
        since_ns = max(arrival_ns - last_arrival_ns, 0) + NS_PER_S
        if 0 < step <= 1 + 2 * self._rate_hz * since_ns / NS_PER_S:
            self._behind = 0
            return step - 1
        is_doubled = step == 0 and stamp_ns == last_stamp_ns
        self._behind += 1
        is_last = arrival_ns - last_arrival_ns > ANEW_AFTER_NS and self._behind >= ANEW_COUNT
        if not is_doubled and (self._keeps_order or stamp_ns > last_stamp_ns or is_last):
            self._behind, self.restarts = 0, self.restarts + 1
            return 0
        self._last, self.overtaken = before, self.overtaken + 1
        return None


class ReadingReceiver:
    """Receives readings of `imu` or `crane`. torn: datagrams or pieces of a stream that aren't ours."""

    def __init__(self, sensor: str, settings: ReadingsSettings) -> None:
        """Raises ConfigError where a UDP port is taken; a serial device may come later."""
        self._mark, self._form = FORMS[sensor]
        self.torn = 0
        self._way: Way
        if settings.port is not None:
            self._way = UdpPort(sensor, self._form.size, settings.port)
        else:
            from barsight.sensors.serial_line import SerialLine  # termios isn't everywhere

            assert settings.device is not None and settings.baud is not None
            self._way = SerialLine(self._mark, self._form.size, settings.device, settings.baud)
        self.sequence = Sequence(settings.rate_hz, keeps_order=self._way.keeps_order)

    @property
    def trouble(self) -> str:
        """Tell why nothing can come now; "" where something may."""
        return self._way.trouble

    def readings(self, may_go_on: Callable[[], bool], now_ns: Callable[[], int]) -> Iterator[RawReading]:
        """Yield readings as long as `may_go_on` says so. now_ns: tells the monotonic clock."""
        while may_go_on():
            data, torn = self._way.receive()
            self.torn += torn
            yield from self._parsed(data, now_ns())

    def close(self) -> None:
        """Free the port or device."""
        self._way.close()

    def _parsed(self, data: bytes, arrival_ns: int) -> Iterator[RawReading]:
        for mark, number, stamp, *values in self._form.iter_unpack(data):
            if mark != self._mark or not np.isfinite(values).all():
                self.torn += 1
                continue
            lost = self.sequence.lost_before(number, stamp, arrival_ns)
            if lost is not None:
                yield RawReading(stamp, arrival_ns, tuple(values), lost)
