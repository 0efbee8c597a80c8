"""Run the map process: keyframes from the queue on disk, matched and fused while more come."""

from __future__ import annotations

import contextlib
import math
import os
import time
from collections.abc import Callable
from dataclasses import replace

from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.compiling.ahead import load_kernels
from barsight.core.errors import BarsightError, MeasurementError
from barsight.core.memory import trim_heap
from barsight.core.stamps import NS_PER_S, seconds_to_ns
from barsight.core.timing import Stopwatch
from barsight.live.link import GrowingRecording, Link
from barsight.live.shared.counters import DRAIN
from barsight.motion.fixed_lag.sensor_buffer import SENSOR_DELAY_S
from barsight.motion.settings import make_estimator
from barsight.reconstruction.live_map import LiveMap, PairPlacer, is_final
from barsight.reconstruction.pair_chain import MatchedAhead
from barsight.reconstruction.tracked_recording import matching
from barsight.recording.rectified_pairs import RectifiedPairs
from barsight.report.files.height_rasters import write_height
from barsight.yard_frame import placing_id

POLL_S = 0.02
AHEAD = 12
"""Keyframes that are matched beside what else is done, the one whose turn it is among them: two chains."""
SHOW_EVERY_S = 5.0
"""The heights so far are written at most this often: keyframes go first."""
TIDIED_EVERY = 8
"""Keyframes between which freed memory may pile up."""
GRACE_NS = NS_PER_S
"""A keyframe waits for readings until one so much later is there."""
DELAY_NS = seconds_to_ns(SENSOR_DELAY_S)
NICENESS = 10
"""Poses go before maps, where cores are few."""
LIVE_MAP = "live_height.tif"


def build_live_map(link: Link) -> None:
    """Map keyframes until the supervisor says so, then those that are left where the map is final."""
    os.nice(NICENESS)
    board = link.open_counters()
    load_kernels("measure")
    recording = GrowingRecording(link.open_recording(), [], link)
    mapping = Mapping(link, recording, lambda: board.beat("map"))
    board["map", "mapped"] = board["map", "refused"] = 0
    board.beat("map")
    board["map", "ready"] = 1
    shown, shown_s = 0, -math.inf
    while True:
        board.beat("map")
        is_last = board["supervisor", "stop"] == DRAIN
        ended = is_last or bool(board["capture", "ended"])
        board["map", "backlog"] = mapping.read_queue()
        if is_last and not (mapping.is_final and mapping.queue):
            break
        if mapping.is_due(ended=ended):
            board["map", "mapped"] = mapping.add_next()
        elif (
            board["map", "mapped"] > max(shown, 1) and not mapping.queue
            and time.monotonic() - shown_s >= SHOW_EVERY_S
        ):  # fmt: skip
            shown, shown_s = board["map", "mapped"], time.monotonic()
            if mapping.show():
                board.add("map", "snapshots")
        else:
            time.sleep(POLL_S)
    mapping.end()


class Mapping:
    """A `LiveMap` of the keyframes so far. queue: stamps of those that wait. beat: called as work goes on.

    A process begun anew fuses all again: their disparities are there.
    """

    def __init__(self, link: Link, recording: GrowingRecording, beat: Callable[[], None]) -> None:
        self._beat = beat
        self._link, self._recording, settings = link, recording, link.settings
        self._pairs = RectifiedPairs(recording.in_use(), Rectifier(recording.rig), link.checkpoints)
        self.is_final = is_final(settings)
        checkpoints = link.checkpoints if settings.self_calibrate == "none" else None
        self._match = MatchedAhead(matching(self._pairs, settings, checkpoints, Stopwatch()), self._pairs)
        self._frames, self._tiles = link.frames(), link.tiles()
        self._told = {stamp for stamp, _, _ in self._tiles.read()}
        self._exposed: dict[int, int] = {}
        self.queue: list[int] = []
        self._map: LiveMap | None = None

    def read_queue(self) -> int:
        """Read what was kept since; return how many keyframes wait."""
        frames = self._frames.read()
        self._recording.grow()  # after the frames: what was there for them is here too
        for stamp, exposed_ns, _, is_kept, _ in frames:
            if is_kept:
                self._recording.stamps_ns.append(stamp)
                self._exposed[stamp] = exposed_ns
                self.queue.append(stamp)
        return len(self.queue)

    def is_due(self, *, ended: bool) -> bool:
        """Tell whether the keyframe that waits longest has all the readings that place it, or won't get more:
        later frames are there, or capture has ended.
        """
        if not self.queue:
            return False
        if ended or self._recording.stamps_ns[-1] >= self.queue[0] + GRACE_NS:
            return True
        delay_ns = DELAY_NS if self._map is None else self._map.delay_ns
        due_ns = self.queue[0] + self._recording.rig.timeshift_cam_imu_ns + delay_ns
        last, sensors = self._recording.last_readings_ns(), self._link.sensors(self._recording.whole)
        return all(last.get(sensor, 0) >= due_ns for sensor in sensors)

    def add_next(self) -> int:
        """Place and fuse the keyframe that waits longest, while those after it are matched; return how many
        are in the map.
        """
        # Where not all pairs are matched, only the place of each tells which are.
        if self._link.settings.map.min_shift == 0:
            self._match.begin(self.queue[:AHEAD])
        stamp = self.queue.pop(0)
        (pair,) = self._pairs(frozenset((stamp,)))
        try:
            if self._map is None:
                self._map = self._begun()
            self._map.add(pair)
        except MeasurementError:
            return 0
        self._tell_fused()
        if len(self._told) % TIDIED_EVERY == 0:
            trim_heap()
        return len(self._map.stamps_ns)

    def show(self) -> bool:
        """Write the heights so far for readers; return whether there are any."""
        assert self._map is not None
        try:
            surface = self._map.snapshot(self).surface
        except BarsightError:
            return False
        if surface is None:
            return False
        placed = placing_id(self._pairs.recording)
        frame_id = "world" if placed is None else f"yard:{placed}"
        write_height(surface, self._link.folder.parent / LIVE_MAP, frame_id)
        return True

    def end(self) -> None:
        """Leave trajectory and map for what measures what was kept; where that can't be, it says why."""
        if self._map is not None and self.is_final:
            with contextlib.suppress(BarsightError):
                self._map.end()
            self._tell_fused()
        self._match.close()

    def _begun(self) -> LiveMap:
        """Begin with the poses that track has found, as far as it had the same pairs and readings."""
        link = self._link
        estimator = make_estimator(replace(link.settings.motion, estimator="live"))
        placer = PairPlacer(self._pairs, estimator, link.checkpoints, beat=self._beat)
        return LiveMap(
            self._pairs, link.settings, link.folder, link.checkpoints, placer, self._match, self._beat
        )  # fmt: skip

    def _tell_fused(self) -> None:
        """Note when each keyframe came into the map."""
        assert self._map is not None
        for stamp in self._map.stamps_ns[::-1]:
            if stamp in self._told:
                break
            self._told.add(stamp)
            self._tiles.append((stamp, self._exposed[stamp], time.monotonic_ns()))
