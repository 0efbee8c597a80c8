"""Send readings by UDP as a crane's IMU or encoders do: crane_sender.py SENSOR PORT READINGS.npz.

READINGS holds stamps (N,), the host's times in ns at which each is sent, and values (N, K). Before the first,
its values are sent at the same rate; the sender's clock is three seconds off.
"""

import socket
import sys
import time

import numpy as np

from reading_forms import pack

OFF_NS = 3_000_000_000


def main() -> None:
    sensor, port, path = sys.argv[1:]
    held = np.load(path)
    stamps, values = held["stamps"], held["values"]
    step_ns = round(float(np.median(np.diff(stamps))))
    early = max((int(stamps[0]) - time.time_ns()) // step_ns, 0)
    before = stamps[0] - step_ns * np.arange(early, 0, -1)
    # What stood before repeats the first half second, noise and all.
    calm = min(round(0.5e9 / step_ns), len(values))
    values = np.vstack([values[np.arange(early) % calm], values])
    out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    for number, stamp in enumerate([*before.tolist(), *stamps.tolist()]):
        time.sleep(max(stamp - time.time_ns(), 0) / 1e9)
        reading = tuple(values[number].tolist())
        out.sendto(pack(sensor, number, stamp + OFF_NS, reading), ("127.0.0.1", int(port)))


if __name__ == "__main__":
    main()
