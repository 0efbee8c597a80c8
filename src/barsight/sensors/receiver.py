"""Receive readings of IMU and encoders, by UDP or a serial line; `forms` lays them out."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from barsight.core.errors import ConfigError
from barsight.sensors.forms import FORMS
from barsight.sensors.settings import ReadingsSettings

MAX_BYTES = 65536
GAP_LIMIT = 1 << 31


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


class ReadingReceiver:
    """Receives readings of `imu` or `crane`. torn: datagrams or pieces of a stream that aren't ours."""

    def __init__(self, sensor: str, settings: ReadingsSettings) -> None:
        """Raises ConfigError where a UDP port is taken; a serial device may come later."""
        self._mark, self._form = FORMS[sensor]
        self._last: int | None = None
        self.torn = 0
        self._way: Way
        if settings.port is not None:
            self._way = UdpPort(sensor, self._form.size, settings.port)
        else:
            from barsight.sensors.serial_line import SerialLine  # termios isn't everywhere

            assert settings.device is not None and settings.baud is not None
            self._way = SerialLine(self._mark, self._form.size, settings.device, settings.baud)

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
            step = 1 if self._last is None else (number - self._last) % (1 << 32)
            if step >= GAP_LIMIT and self._way.keeps_order:
                step = 1  # a sender that began anew
            if step == 0 or step >= GAP_LIMIT:
                # Doubled, overtaken, or a sender that began anew.
                if self._last is not None and number < self._last and number < 16:
                    self._last = number
                continue
            self._last = number
            yield RawReading(stamp, arrival_ns, tuple(values), step - 1)
