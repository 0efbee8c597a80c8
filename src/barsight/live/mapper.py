"""Run the map process: keyframes from the queue on disk, matched and fused while more come."""

from __future__ import annotations

import os
import time

from barsight.calibration.geometry.rectification import Rectifier
from barsight.checkpoint import read_checkpoint
from barsight.core.compiling.ahead import load_kernels
from barsight.core.errors import BarsightError, MeasurementError
from barsight.core.memory import trim_heap
from barsight.core.timing import Stopwatch
from barsight.core.types import RectifiedPair
from barsight.live.link import GrowingRecording, Link
from barsight.live_map import LiveMap
from barsight.map_building import matching
from barsight.recording.rectified_pairs import RectifiedPairs
from barsight.recording.sensor_selection import SelectedSensors
from barsight.report.result_files import write_height
from barsight.yard_frame import in_yard, placing_id

POLL_S = 0.02
NICENESS = 10
"""Poses go before maps, where cores are few."""
LIVE_MAP = "live_height.tif"


def build_live_map(link: Link) -> None:
    """Map keyframes until the supervisor says so."""
    os.nice(NICENESS)
    board = link.open_counters()
    load_kernels("measure")
    mapping = Mapping(link, GrowingRecording(link.open_recording(), [], link))
    board["map", "mapped"] = board["map", "refused"] = 0
    board.beat("map")
    board["map", "ready"] = 1
    shown = 0
    while not board["supervisor", "stop"]:
        board.beat("map")
        board["map", "backlog"] = mapping.read_queue()
        if mapping.queue:
            board.add("map", "mapped" if mapping.add_next() else "refused")
            continue
        if board["map", "mapped"] > max(shown, 1):
            shown = board["map", "mapped"]
            if mapping.show():
                board.add("map", "snapshots")
            continue
        time.sleep(POLL_S)


class Mapping:
    """A `LiveMap` of the keyframes so far. queue: those that wait, each as stamp and exposure.

    A process begun anew fuses all again: their disparities are there.
    """

    def __init__(self, link: Link, recording: GrowingRecording) -> None:
        self._link, self._recording = link, recording
        source = in_yard(SelectedSensors(recording, link.settings.use), link.settings.yard)
        self._pairs = RectifiedPairs(source, Rectifier(recording.rig), link.checkpoints)
        placed = placing_id(source)
        self._frame_id = "world" if placed is None else f"yard:{placed}"
        checkpoints = link.checkpoints if link.settings.self_calibrate == "none" else None
        self._match = matching(self._pairs, link.settings, checkpoints, Stopwatch())
        self._frames, self._tiles = link.frames(), link.tiles()
        self._done = {stamp for stamp, _, _ in self._tiles.read()}
        self.queue: list[tuple[int, int]] = []
        self._map: LiveMap | None = None

    def read_queue(self) -> int:
        """Read what was kept since; return how many keyframes with a pose wait."""
        self._recording.grow()
        for stamp, exposed_ns, _, is_kept, has_pose in self._frames.read():
            if is_kept:
                self._recording.stamps_ns.append(stamp)
            if is_kept and has_pose:
                self.queue.append((stamp, exposed_ns))
        return len(self.queue)

    def add_next(self) -> bool:
        """Match and fuse the keyframe that waits longest; return whether it is in the map."""
        stamp, exposed_ns = self.queue.pop(0)
        (pair,) = self._pairs(frozenset((stamp,)))
        if not isinstance(pair, RectifiedPair):
            return False
        try:
            if self._map is None:
                self._map = LiveMap(self._pairs, self._link.settings, self._link.folder, self._match)
            self._map.add(pair, read_checkpoint(self._link.posed_file(stamp)))
        except MeasurementError:
            return False
        if stamp not in self._done:
            self._tiles.append((stamp, exposed_ns, time.monotonic_ns()))
        trim_heap()
        return True

    def show(self) -> bool:
        """Write the heights so far for readers; return whether there are any."""
        assert self._map is not None
        try:
            surface = self._map.snapshot(self).surface
        except BarsightError:
            return False
        if surface is None:
            return False
        write_height(surface, self._link.folder.parent / LIVE_MAP, self._frame_id)
        return True
