"""Run the map process: match and fuse keyframes from the queue on disk while more arrive."""

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
"""Number of keyframes matched in the background, including the next one to be fused: two chains."""
SHOW_EVERY_S = 5.0
"""Shortest interval in seconds between writings of the heights so far: keyframes have priority."""
TIDIED_EVERY = 8
"""Number of keyframes after which freed memory is returned to the system."""
GRACE_NS = NS_PER_S
"""Margin in ns: a keyframe waits for readings until one that is this much later has arrived."""
DELAY_NS = seconds_to_ns(SENSOR_DELAY_S)
NICENESS = 10
"""Nice value of the process: poses have priority over maps if cores are scarce."""
LIVE_MAP = "live_height.tif"


def build_live_map(link: Link) -> None:
    """Map keyframes until the supervisor stops this, then the remaining ones if the map is final."""
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
    """A `LiveMap` of the keyframes so far. queue: stamps of those waiting. beat: called as work progresses.

    A restarted process fuses all keyframes again; their disparities are stored.
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
        """Read the keyframes kept since the last call; return how many are waiting."""
        frames = self._frames.read()
        self._recording.grow()  # after the frames, so that all readings they had are here too
        for stamp, exposed_ns, _, is_kept, _ in frames:
            if is_kept:
                self._recording.stamps_ns.append(stamp)
                self._exposed[stamp] = exposed_ns
                self.queue.append(stamp)
        return len(self.queue)

    def is_due(self, *, ended: bool) -> bool:
        """Return True if the oldest waiting keyframe has all readings needed to place it, or won't get more.

        It gets no more once later frames have arrived or capture has ended.
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
        """Place and fuse the oldest waiting keyframe, while those after it are matched.

        Returns how many keyframes are in the map.
        """
        # If not all pairs are matched, each pair must be placed first to know which are.
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
        """Save trajectory and map for the final measurement; if that isn't possible, log why."""
        if self._map is not None and self.is_final:
            with contextlib.suppress(BarsightError):
                self._map.end()
            self._tell_fused()
        self._match.close()

    def _begun(self) -> LiveMap:
        """Begin with the poses that tracking has found, as far as it had the same pairs and readings."""
        link = self._link
        estimator = make_estimator(replace(link.settings.motion, estimator="live"))
        placer = PairPlacer(self._pairs, estimator, link.checkpoints, beat=self._beat)
        return LiveMap(
            self._pairs, link.settings, link.folder, link.checkpoints, placer, self._match, self._beat
        )  # fmt: skip

    def _tell_fused(self) -> None:
        """Log when each keyframe was fused into the map."""
        assert self._map is not None
        for stamp in self._map.stamps_ns[::-1]:
            if stamp in self._told:
                break
            self._told.add(stamp)
            self._tiles.append((stamp, self._exposed[stamp], time.monotonic_ns()))
