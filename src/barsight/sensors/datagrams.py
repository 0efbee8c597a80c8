"""Receive readings of IMU and encoders by UDP.

A datagram holds one or more readings one after another, each little-endian: four bytes of kind (`BSI1` for
the IMU, `BSC1` for the crane), a sequence number (uint32), the stamp of the measurement on the sender's clock
(int64, ns), and float64 values: gyro x, y, z (rad/s) and accelerometer x, y, z (m/s2), or bridge x, trolley y
and hoist z (m).
"""

from __future__ import annotations

import socket
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from barsight.core.errors import ConfigError

FORMS = {"imu": (b"BSI1", struct.Struct("<4sIq6d")), "crane": (b"BSC1", struct.Struct("<4sIq3d"))}
MAX_BYTES = 65536
GAP_LIMIT = 1 << 31


@dataclass(frozen=True)
class RawReading:
    """A reading as it came. device_ns: its stamp. arrival_ns: monotonic. lost: readings missing before it."""

    device_ns: int
    arrival_ns: int
    values: tuple[float, ...]
    lost: int


class ReadingReceiver:
    """Receives readings of `imu` or `crane` at a port. torn: datagrams that are none of ours."""

    def __init__(self, sensor: str, port: int, host: str = "0.0.0.0") -> None:
        """Raises ConfigError where the port is taken."""
        self._mark, self._form = FORMS[sensor]
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.settimeout(0.1)
        self._last: int | None = None
        self.torn = 0
        try:
            self._socket.bind((host, port))
        except OSError as error:
            self._socket.close()
            raise ConfigError(
                f"{sensor}: UDP port {port} can't be opened ({error.strerror}); name a free one"
            ) from error

    def readings(self, may_go_on: Callable[[], bool], now_ns: Callable[[], int]) -> Iterator[RawReading]:
        """Yield readings as long as `may_go_on` says so. now_ns: tells the monotonic clock."""
        while may_go_on():
            try:
                data = self._socket.recv(MAX_BYTES)
            except TimeoutError:
                continue
            yield from self._parsed(data, now_ns())

    def close(self) -> None:
        """Free the port."""
        self._socket.close()

    def _parsed(self, data: bytes, arrival_ns: int) -> Iterator[RawReading]:
        if not data or len(data) % self._form.size:
            self.torn += 1
            return
        for mark, number, stamp, *values in self._form.iter_unpack(data):
            if mark != self._mark or not np.isfinite(values).all():
                self.torn += 1
                continue
            step = 1 if self._last is None else (number - self._last) % (1 << 32)
            if step == 0 or step >= GAP_LIMIT:
                # Doubled, overtaken, or a sender that began anew.
                if self._last is not None and number < self._last and number < 16:
                    self._last = number
                continue
            self._last = number
            yield RawReading(stamp, arrival_ns, tuple(values), step - 1)


def pack(sensor: str, number: int, stamp_ns: int, values: tuple[float, ...]) -> bytes:
    """Pack a reading as a sender does."""
    mark, form = FORMS[sensor]
    return form.pack(mark, number % (1 << 32), stamp_ns, *values)
