"""Run the record process: keyframes, IMU and encoders in segments, the ring around alarms, retention."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from barsight.core.records.sensor_samples import ImuSamples
from barsight.live.link import Link
from barsight.live.shared.counters import DRAIN, Counters
from barsight.recording.writers.retention import Retention
from barsight.recording.writers.segments import SegmentWriter

POLL_S = 0.05
SYNC_EVERY_S = 1.0
LOOK_EVERY_S = 0.5


def record(link: Link) -> None:
    """Record until the supervisor reports that everything else has ended, and then what is left."""
    assert link.source.crane is not None
    board = link.open_counters()
    recorder = Recorder(link, board)
    board["record", "ready"] = 1
    while True:
        board.beat("record")
        is_last = board["supervisor", "stop"] == DRAIN
        recorder.take()
        if is_last:
            break
        time.sleep(POLL_S)
    recorder.close()


class Recorder:
    """Moves new data into the recording; a restarted recorder continues after what is written."""

    def __init__(self, link: Link, board: Counters) -> None:
        assert link.source.crane is not None
        settings = link.source.crane.recorder
        self._link, self._board, self._after_s = link, board, settings.alarm_after_s
        size = settings.segment_mib << 20
        self._writer = SegmentWriter(link.source.recording, size)
        self._alarms = SegmentWriter(link.source.recording / "alarms", size)
        self._retention = Retention(link.source.recording, settings.max_used_ratio, settings.stop_used_ratio)
        self._frames, self._logs = link.frames(), {name: link.readings(name) for name in ("imu", "crane")}
        self._mounted = link.source.crane.awaited(link.source.recording).crane()
        self._ring = link.open_ring()
        self._sync_at = self._look_at = time.monotonic()
        self._alarm_count, self._alarm_until, self._saved = board["record", "alarms"], 0.0, 0
        self._waiting: list[int] = []
        self._bytes_before = board["record", "bytes"]

    def take(self) -> None:
        """Record the data received since the last call, unless the disk is too full."""
        now = time.monotonic()
        if now >= self._look_at:
            self._look_at = now + LOOK_EVERY_S
            self._board.add("record", "deleted", self._retention.tidy())
            self._board["record", "paused"] = int(self._retention.is_full)
        self._waiting += [stamp for stamp, _, _, is_kept, _ in self._frames.read() if is_kept]
        readings = {name: log.read() for name, log in self._logs.items()}
        if self._board["record", "paused"]:
            for stamp in self._waiting:
                self._link.raw_file(stamp).unlink(missing_ok=True)
            self._waiting.clear()
            return
        stamps, values = readings["imu"]
        if len(stamps):
            self._writer.samples(ImuSamples(stamps, values[:, :3], values[:, 3:]))
        if self._mounted is not None:
            stamps, values = readings["crane"]
            self._writer.samples(replace(self._mounted, stamp_ns=stamps, position_m=values))
        self._board.add("record", "readings", sum(len(stamps) for stamps, _ in readings.values()))
        self._take_pairs()
        self._take_alarm(now)
        self._board["record", "bytes"] = self._bytes_before + self._writer.bytes + self._alarms.bytes
        self._board["record", "backlog"] = len(self._waiting)
        if now >= self._sync_at:
            self._sync_at = now + SYNC_EVERY_S
            self._writer.sync()

    def close(self) -> None:
        """Close the segments."""
        self._writer.close()
        self._alarms.close()

    def _take_pairs(self) -> None:
        while self._waiting:
            stamp = self._waiting.pop(0)
            file = self._link.raw_file(stamp)
            if file.is_file():  # otherwise an earlier recorder has written it
                left, right = np.load(file)
                if stamp > self._writer.last_pair_ns:
                    self._writer.pair(stamp, left, right)
                    self._board.add("record", "pairs")
                file.unlink()

    def _take_alarm(self, now: float) -> None:
        """Save the ring's pairs after an alarm, and those that follow for a while."""
        if (count := self._board["supervisor", "alarms"]) > self._alarm_count:
            self._alarm_count = self._board["record", "alarms"] = count
            self._alarm_until = now + self._after_s
        if now > self._alarm_until:
            return
        newest = self._ring.newest
        for number in range(max(self._saved + 1, newest - self._link.live.ring_pairs + 1), newest + 1):
            pair = self._ring.read(number)
            if pair is not None and pair.frame.stamp_ns > self._alarms.last_pair_ns:
                self._alarms.pair(pair.frame.stamp_ns, pair.frame.left, pair.frame.right)
        self._saved = newest
