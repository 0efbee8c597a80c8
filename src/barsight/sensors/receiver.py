"""Receive readings of IMU and encoders, by UDP or a serial line, in the format of `forms`."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Protocol

from barsight.core.errors import ConfigError
from barsight.core.stamps import NS_PER_S
from barsight.sensors.forms import FORMS, LIMITS
from barsight.sensors.settings import ReadingsSettings

MAX_BYTES = 65536
NUMBERS = 1 << 32
ANEW_AFTER_NS, ANEW_COUNT = NS_PER_S // 2, 3
"""Time (ns) since the last newer reading, and number of older readings in succession, that prove a sender's
restart: no network delays so many for so long.
"""


@dataclass(frozen=True)
class RawReading:
    """A reading as received. device_ns: its stamp. arrival_ns: monotonic. lost: readings missing before."""

    device_ns: int
    arrival_ns: int
    values: tuple[float, ...]
    lost: int


class Way(Protocol):
    """Channel by which readings arrive.

    keeps_order: no reading overtakes another. trouble: why nothing can arrive now, or "".
    """

    keeps_order: bool
    trouble: str

    def receive(self) -> tuple[bytes, int]:
        """Wait at most 0.1 s; return complete readings, concatenated, and the number of damaged ones."""
        ...

    def close(self) -> None:
        """Release the port or device."""
        ...


class UdpPort:
    """Receives datagrams with readings of `size` bytes."""

    keeps_order, trouble = False, ""

    def __init__(self, sensor: str, size: int, port: int, host: str = "0.0.0.0") -> None:
        """Open the port. Raises ConfigError if it is taken."""
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
        """Return a datagram; see `Way`."""
        try:
            data = self._socket.recv(MAX_BYTES)
        except TimeoutError:
            return b"", 0
        return (b"", 1) if not data or len(data) % self._size else (data, 0)

    def close(self) -> None:
        """Release the port."""
        self._socket.close()


class Sequence:
    """Judges the sequence numbers of a sender's readings.

    A number that isn't ahead is a duplicate or was overtaken, or its sender has restarted: then its stamp is
    later than the last one or, if the sender's clock has restarted too, nothing newer arrives any more. A
    number further ahead than the sensor could have counted meanwhile is also a restart. overtaken: readings
    left out; restarts: how often a sender has restarted.
    """

    def __init__(self, rate_hz: float, *, keeps_order: bool) -> None:
        self._rate_hz, self._keeps_order = rate_hz, keeps_order
        self._last: tuple[int, int, int] | None = None
        self._behind = self.overtaken = self.restarts = 0

    def lost_before(self, number: int, stamp_ns: int, arrival_ns: int) -> int | None:
        """Add a reading; return how many are missing before it, or None if it must be left out."""
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
    """Receives readings of `imu` or `crane`. torn: datagrams or pieces of a stream in an unknown format."""

    def __init__(self, sensor: str, settings: ReadingsSettings) -> None:
        """Open the channel. Raises ConfigError if a UDP port is taken; a serial device may appear later."""
        (self._mark, self._form), self._limits = FORMS[sensor], LIMITS[sensor]
        self.torn = 0
        self._way: Way
        if settings.port is not None:
            self._way = UdpPort(sensor, self._form.size, settings.port)
        else:
            from barsight.sensors.serial_line import SerialLine  # termios isn't available everywhere

            assert settings.device is not None and settings.baud is not None
            self._way = SerialLine(self._mark, self._form.size, settings.device, settings.baud)
        self.sequence = Sequence(settings.rate_hz, keeps_order=self._way.keeps_order)

    @property
    def trouble(self) -> str:
        """Return why nothing can arrive now, "" if something can."""
        return self._way.trouble

    def readings(self, may_go_on: Callable[[], bool], now_ns: Callable[[], int]) -> Iterator[RawReading]:
        """Yield readings while `may_go_on` returns True. now_ns: returns the monotonic time."""
        while may_go_on():
            data, torn = self._way.receive()
            self.torn += torn
            yield from self._parsed(data, now_ns())

    def close(self) -> None:
        """Release the port or device."""
        self._way.close()

    def _parsed(self, data: bytes, arrival_ns: int) -> Iterator[RawReading]:
        for mark, number, stamp, *values in self._form.iter_unpack(data):
            if mark != self._mark or not self._are_sane(values):
                self.torn += 1
                continue
            lost = self.sequence.lost_before(number, stamp, arrival_ns)
            if lost is not None:
                yield RawReading(stamp, arrival_ns, tuple(values), lost)

    def _are_sane(self, values: Iterable[float]) -> bool:
        """Check that no value is NaN or beyond its limit."""
        return all(abs(value) <= limit for value, limit in zip(values, self._limits, strict=True))
