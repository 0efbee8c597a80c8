"""Send a recording's IMU and encoders by UDP, to and fro, and spoil them as standard input says.

Usage: crane_player.py READINGS.npz BEGIN_NS. READINGS holds, of each sensor, `SENSOR_s` (N,) seconds from the
way's begin, rising from 0, and `SENSOR_values` (N, K): the way there and back. Lines on standard input:
SENSOR silent|freeze SECONDS, SENSOR jump SECONDS METRES, SENSOR stamps SECONDS (its clock goes on later).
"""

import socket
import sys
import threading
import time

import numpy as np

from barsight.sensors.forms import pack
from crane_network import PORTS


class Sensor:
    """One sensor: its readings, and what spoils them now."""

    def __init__(self, name: str, seconds: np.ndarray, values: np.ndarray, period_s: float) -> None:
        self.name, self.seconds, self.values, self.period_s = name, seconds, values, period_s
        self.silent = self.frozen = self.jumped = 0.0
        self.jump_m, self.off_ns, self.number = 0.0, 0, 0
        self.held: list[float] | None = None

    def at(self, number: int) -> float:
        """Tell when a reading is due, seconds from the begin."""
        turns, k = divmod(number, len(self.seconds))
        return float(turns * self.period_s + self.seconds[k])

    def send(self, out: socket.socket, begin_ns: int) -> None:
        at_s, now = self.at(self.number), time.monotonic()
        value = self.values[self.number % len(self.seconds)].tolist()
        if now < self.jumped:
            value[0] += self.jump_m
        self.held = (self.held or value) if now < self.frozen else None
        stamp_ns = begin_ns + round(1e9 * at_s) + self.off_ns
        if now >= self.silent:
            out.sendto(
                pack(self.name, self.number, stamp_ns, tuple(self.held or value)),
                ("127.0.0.1", PORTS[self.name]),
            )
        self.number += 1

    def obey(self, what: str, seconds: float, metres: float = 0.0) -> None:
        until = time.monotonic() + seconds
        if what == "silent":
            self.silent = until
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
    out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    while True:
        one = min(sensors.values(), key=lambda s: s.at(s.number))
        time.sleep(max(begin_ns + 1e9 * one.at(one.number) - time.time_ns(), 0) / 1e9)
        one.send(out, begin_ns)


if __name__ == "__main__":
    main()
