"""Run the capture process: pictures and readings in, pairs into the ring; it never waits for a reader."""

from __future__ import annotations

import time

from barsight.core.stamps import seconds_to_ns
from barsight.live.counters import Counters
from barsight.live.link import Link
from barsight.live.pairing import PairFormer
from barsight.live.ring import PairRing
from barsight.live.source import LivePicture, LostPicture, Readings, ReplayClock, ReplaySource, Source

POLL_S = 0.002


def capture(link: Link) -> None:
    """Capture until the source ends or the supervisor says so."""
    board, recording = link.open_counters(), link.open_recording()
    stamps = recording.camera_stamps
    first_ns = int(min(stamps.left_ns[0], stamps.right_ns[0]))
    board["capture", "first_ns"] = first_ns

    def may_go_on() -> bool:
        board.beat("capture")
        return not board["supervisor", "stop"]

    board.beat("capture")
    board["capture", "ready"] = 1
    while not (began_ns := board["supervisor", "began_ns"]):
        if not may_go_on():
            return
        time.sleep(POLL_S)
    clock = ReplayClock(began_ns, first_ns, link.speed)
    source = ReplaySource(recording, clock, may_go_on)
    board["capture", "interval_ns"] = source.interval_ns
    Capture(link, board, link.open_ring(recording)).run(source)
    board["capture", "ended"] = 1


class Capture:
    """Takes what a source gives, and counts it."""

    def __init__(self, link: Link, board: Counters, ring: PairRing) -> None:
        self._board, self._ring, self._speed = board, ring, link.speed
        self._readings = {sensor: link.readings(sensor) for sensor in ("imu", "crane")}
        self._pairs = PairFormer(seconds_to_ns(link.settings.recording.pair_tolerance_s))
        self._lost = [board["capture", f"unpaired_cam{camera}"] for camera in (0, 1)]

    def run(self, source: Source) -> None:
        """Take packets until there are no more."""
        after = {f"cam{camera}": self._board["capture", f"last_cam{camera}_ns"] for camera in (0, 1)}
        for sensor, log in self._readings.items():
            stamps, _ = log.last(1)
            after[sensor] = int(stamps[-1]) if len(stamps) else 0
        for packet in source.packets(after):
            if isinstance(packet, Readings):
                self._readings[packet.sensor].append(packet.stamp_ns, packet.values)
            elif isinstance(packet, LostPicture):
                self._board.add("capture", packet.cause)
            else:
                self._take(packet)
        self._pairs.end()
        self._count_lost()

    def _take(self, picture: LivePicture) -> None:
        """Note the camera's last picture, and write the pair that a picture completes."""
        board, camera = self._board, f"cam{picture.camera}"
        board["capture", f"last_{camera}_ns"] = picture.stamp_ns
        board.add("capture", f"pictures_{camera}")
        for frame, exposed_ns in self._pairs.push(picture):
            if self._speed == 0:
                self._wait_for_reader()
            self._ring.write(frame, exposed_ns if self._speed else time.monotonic_ns())
            board.add("capture", "paired")
        self._count_lost()

    def _wait_for_reader(self) -> None:
        """Wait until the last pair was taken: as fast as possible, none may be lost."""
        board, newest = self._board, self._ring.newest
        while board["track", "taken"] < newest and not board["supervisor", "stop"]:
            board.beat("capture")
            time.sleep(POLL_S)

    def _count_lost(self) -> None:
        for camera, before in enumerate(self._lost):
            self._board["capture", f"unpaired_cam{camera}"] = before + self._pairs.lost[camera]
