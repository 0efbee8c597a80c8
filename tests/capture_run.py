"""Capture from two free-running cameras of `gige_camera` for a while, and print what came as JSON.

Usage: capture_run.py SECONDS WIDTH HEIGHT RATE_HZ SERIAL0 SERIAL1. A pair is mispaired where the two
pictures' ticks, which the cameras wrote into them, differ. The first `SETTLE_S` do not count.
"""

import json
import sys
import time

from barsight.live.shared.ring import PairRing
from barsight.sensors.crane import CraneSource
from barsight.sensors.drivers import both_cameras
from barsight.sensors.pairing import PairFormer
from barsight.sensors.settings import CamerasSettings
from barsight.sensors.source import LivePicture, LostPicture, SensorSigns

SETTLE_S = 5.0
TOLERANCE_NS = 5_000_000


def main() -> None:
    seconds, width, height, rate_hz, *serials = sys.argv[1:]
    settings = CamerasSettings((serials[0], serials[1]), float(rate_hz))
    size = int(width), int(height)
    cameras = both_cameras(settings, size)
    end_s = [float("inf")]
    source = CraneSource(cameras, {}, float(rate_hz), 0, lambda: time.monotonic() < end_s[0])
    former, ring = PairFormer(TOLERANCE_NS), PairRing(8, size[1], size[0])
    lost: dict[str, int] = {}
    pairs = mispaired = 0
    ticks: list[int] = []
    begun_s = cpu_s = 0.0
    signs: dict[str, int] = {}
    try:
        for packet in source.packets({"cam0": 0, "cam1": 0}):
            if isinstance(packet, SensorSigns):
                signs = dict(packet.values)
            elif isinstance(packet, LostPicture):
                if begun_s:
                    lost[packet.cause] = lost.get(packet.cause, 0) + packet.count
            elif isinstance(packet, LivePicture):
                for frame, exposed_ns in former.push(packet):
                    ring.write(frame, exposed_ns)
                    now_s = time.monotonic()
                    first = end_s[0] == float("inf")
                    if first:
                        end_s[0] = now_s + SETTLE_S + float(seconds)
                    if not begun_s and now_s > end_s[0] - float(seconds):
                        begun_s, cpu_s = now_s, time.process_time()
                        former.lost, former.contradicted, former.max_skew_ns = [0, 0], 0, 0
                    if begun_s:
                        left, right = (
                            int.from_bytes(i.tobytes()[:8], "little") for i in (frame.left, frame.right)
                        )
                        pairs, mispaired = pairs + 1, mispaired + (left != right)
                        ticks.append(left)
        took_s = time.monotonic() - begun_s
        found = {
            "seconds": round(took_s, 1), "pairs": pairs, "mispaired": mispaired,
            "ticks": [ticks[0], ticks[-1]], "due": ticks[-1] - ticks[0] + 1,
            "lost": lost, "unpaired": former.lost, "contradicted": former.contradicted,
            "skew_ms": former.skew_ns / 1e6, "max_skew_ms": former.max_skew_ns / 1e6,
            "cores": round((time.process_time() - cpu_s) / took_s, 4), "signs": signs,
        }  # fmt: skip
        sys.stdout.write(json.dumps(found) + "\n")
    finally:
        ring.remove()


if __name__ == "__main__":
    main()
