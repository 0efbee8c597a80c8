"""Send a recording's IMU and encoders, to and fro, and spoil them as standard input says.

Usage: crane_player.py READINGS.npz BEGIN_NS [FOLDER]: by UDP, or by serial lines, pseudo terminals that
FOLDER/imu and FOLDER/crane lead to. READINGS holds, of each sensor, `SENSOR_s` (N,) seconds from the
way's begin, rising from 0, and `SENSOR_values` (N, K): the way there and back. Lines on standard input:
SENSOR silent|freeze SECONDS, SENSOR jump SECONDS METRES, SENSOR stamps SECONDS (its clock goes on later),
SENSOR unplug SECONDS (its serial line).
"""

import fcntl
import os
import socket
import sys
import termios
import threading
import time
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np

from crane_network import PORTS
from reading_forms import pack

MAX_WAITING = 3000
"""Bytes that wait to be read: a line that nobody reads holds nothing, a terminal would for long."""


class Line:
    """A serial device that can be unplugged: its link and its terminal go, and come back."""

    def __init__(self, link: Path) -> None:
        self.link, self.device, self.end = link, -1, -1

    def send(self, reading: bytes, is_plugged: bool) -> None:
        if is_plugged != (self.device >= 0):
            self.plug() if is_plugged else self.unplug()
        if is_plugged:
            waiting = fcntl.ioctl(self.end, termios.FIONREAD, bytes(4))
            if int.from_bytes(waiting, "little") < MAX_WAITING:
                os.write(self.device, reading + zlib.crc32(reading).to_bytes(4, "little"))

    def plug(self) -> None:
        self.device, self.end = os.openpty()
        self.link.symlink_to(os.ttyname(self.end))

    def unplug(self) -> None:
        self.link.unlink()
        os.close(self.device)
        os.close(self.end)
        self.device = -1


class Sensor:
    """One sensor: its readings, and what spoils them now."""

    def __init__(self, name: str, seconds: np.ndarray, values: np.ndarray, period_s: float) -> None:
        self.name, self.seconds, self.values, self.period_s = name, seconds, values, period_s
        self.silent = self.frozen = self.jumped = self.unplugged = 0.0
        self.jump_m, self.off_ns, self.number = 0.0, 0, 0
        self.held: list[float] | None = None

    def at(self, number: int) -> float:
        """Tell when a reading is due, seconds from the begin."""
        turns, k = divmod(number, len(self.seconds))
        return float(turns * self.period_s + self.seconds[k])

    def send(self, out: Callable[[str, bytes, bool], None], begin_ns: int) -> None:
        at_s, now = self.at(self.number), time.monotonic()
        value = self.values[self.number % len(self.seconds)].tolist()
        if now < self.jumped:
            value[0] += self.jump_m
        self.held = (self.held or value) if now < self.frozen else None
        stamp_ns = begin_ns + round(1e9 * at_s) + self.off_ns
        if now >= self.silent:
            reading = pack(self.name, self.number, stamp_ns, tuple(self.held or value))
            out(self.name, reading, now >= self.unplugged)
        self.number += 1

    def obey(self, what: str, seconds: float, metres: float = 0.0) -> None:
        until = time.monotonic() + seconds
        if what == "silent":
            self.silent = until
        elif what == "unplug":
            self.unplugged = until
        elif what == "freeze":
            self.frozen = until
        elif what == "jump":
            self.jump_m, self.jumped = metres, until
        else:
            self.off_ns += round(1e9 * seconds)


def listen(sensors: dict[str, Sensor]) -> None:
    for line in sys.stdin:
        name, what, *numbers = line.split()
        sensors[name].obey(what, *map(float, numbers))


def main() -> None:
    held, begin_ns = np.load(sys.argv[1]), int(sys.argv[2])
    period_s = float(held["period_s"])
    sensors = {n: Sensor(n, held[f"{n}_s"], held[f"{n}_values"], period_s) for n in PORTS}
    threading.Thread(target=listen, args=(sensors,), daemon=True).start()
    udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    lines = {name: Line(Path(folder) / name) for folder in sys.argv[3:] for name in PORTS}

    def out(name: str, reading: bytes, is_plugged: bool) -> None:
        if lines:
            lines[name].send(reading, is_plugged)
        else:
            udp.sendto(reading, ("127.0.0.1", PORTS[name]))

    while True:
        one = min(sensors.values(), key=lambda s: s.at(s.number))
        time.sleep(max(begin_ns + 1e9 * one.at(one.number) - time.time_ns(), 0) / 1e9)
        one.send(out, begin_ns)


if __name__ == "__main__":
    main()
