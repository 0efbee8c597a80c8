"""Read a serial line: a stream of readings that may start, tear and end anywhere. Needs termios (Linux)."""

from __future__ import annotations

import os
import select
import termios
import time
import zlib

from barsight.sensors.forms import CRC_BYTES

WAIT_S = 0.1
AGAIN_S = 1.0
"""Interval in seconds between attempts to open a missing device."""
READ_BYTES = 4096


class SerialLine:
    """Receives readings that begin with `mark`, have `size` bytes and are each followed by their CRC-32.

    A device that disappears is reopened when it is back.
    """

    keeps_order = True

    def __init__(self, mark: bytes, size: int, device: str, baud: int) -> None:
        self._mark, self._size, self._device, self._baud = mark, size, device, baud
        self._file: int | None = None
        self._due, self.trouble = 0.0, ""
        self._buffer, self._skipped = bytearray(), 0

    def receive(self) -> tuple[bytes, int]:
        """Return the data received; see `Way`."""
        if self._file is None and not self._opened():
            time.sleep(WAIT_S)
            return b"", 0
        assert self._file is not None
        if not select.select([self._file], [], [], WAIT_S)[0]:
            return b"", 0
        try:
            data = os.read(self._file, READ_BYTES)
        except BlockingIOError:  # another process reads it too
            return b"", 0
        except OSError:
            data = b""
        if not data:
            self.close()
            self.trouble, self._due = "it ended", time.monotonic() + AGAIN_S
        self._buffer += data
        return self._cut()

    def close(self) -> None:
        """Close the device."""
        if self._file is not None:
            os.close(self._file)
            self._file = None

    def _opened(self) -> bool:
        """Open the device raw, 8N1 without flow control; False if this fails or isn't due yet."""
        if time.monotonic() < self._due:
            return False
        self._due, file = time.monotonic() + AGAIN_S, None
        try:
            file = os.open(self._device, os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK)
            *_, control = termios.tcgetattr(file)
            control[termios.VMIN], control[termios.VTIME] = 1, 0  # else no data looks like the end
            speed, frame = getattr(termios, f"B{self._baud}"), termios.CS8 | termios.CREAD | termios.CLOCAL
            termios.tcsetattr(file, termios.TCSAFLUSH, [0, 0, frame, 0, speed, speed, control])
        except (OSError, termios.error) as error:
            if file is not None:
                os.close(file)
            self.trouble = os.strerror(error.args[0])
            return False
        self._file, self.trouble = file, ""
        # The reading in transit now began before the line was opened, so it isn't torn.
        self._buffer, self._skipped = bytearray(), 1 - self._size - CRC_BYTES
        return True

    def _cut(self) -> tuple[bytes, int]:
        """Cut complete readings out of the buffer. Skipped bytes count as damaged readings, rounded up."""
        held, length = self._buffer, self._size + CRC_BYTES
        found, torn, at = bytearray(), 0, 0
        while at + length <= len(held):
            reading, check = held[at : at + self._size], held[at + self._size : at + length]
            if reading.startswith(self._mark) and zlib.crc32(reading) == int.from_bytes(check, "little"):
                found += reading
                self._skipped, at = 0, at + length
                continue
            begin = held.find(self._mark, at + 1)
            step = (begin if begin >= 0 else len(held) - len(self._mark) + 1) - at
            before = -(-self._skipped // length)
            self._skipped, at = self._skipped + step, at + step
            torn += -(-self._skipped // length) - before
        del held[:at]
        return bytes(found), torn
