"""The map process: what it leaves is what measuring the same pairs makes, however late readings come."""

import gc
import json
import weakref
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

import barsight as bs
from barsight.core.pose import Pose
from barsight.core.records.sensor_samples import CraneSamples
from barsight.core.records.trajectory import PosedFrame
from barsight.live.link import GrowingRecording, KeptRecording, Link, LiveInput
from barsight.live.mapper import LIVE_MAP, Mapping
from barsight.live.settings import LiveSettings
from barsight.live.shared.counters import Counters
from barsight.mapping.fusion import fuse_view
from barsight.measure_folder import write_measured
from barsight.pipeline.lift_choice import LiftRequest
from barsight.reconstruction import live_map, map_building
from barsight.reconstruction.checkpoint import checkpoint_folder, checkpoint_key
from barsight.reconstruction.pair_chain import MatchedAhead
from barsight.recording.base import Recording
from barsight.stereo.image_pair import pair_from_images

FIELDS = {"map": {"cell_m": 0.05}, "motion": {"estimator": "live"}}
SETTINGS = bs.MeasureSettings(
    map=replace(bs.MeasureSettings().map, cell_m=0.05),
    motion=replace(bs.MeasureSettings().motion, estimator="live"),
)
SAME = ("height.tif", "trajectory.tum", "cloud.ply", "contour.csv", "free.tif", "tops.tif")


@pytest.fixture
def board() -> Iterator[Counters]:
    one = Counters()
    yield one
    one.remove()


class Come:
    """Feeds a map process: keyframes and the encoders' readings, each when it is told."""

    def __init__(self, recording: Recording, link: Link) -> None:
        self.stamps, self._link, self._given = list(recording.index.stamps_ns), link, 0
        imu, crane = recording.imu(), recording.crane()
        assert imu is not None and crane is not None
        self._crane: CraneSamples = crane
        link.readings("imu").append(imu.stamp_ns, np.hstack([imu.gyro_radps, imu.accel_mps2]))
        self.beats: list[int] = []
        self.mapping = Mapping(link, GrowingRecording(recording, [], link), lambda: self.beats.append(1))

    def keep(self, stamp: int) -> None:
        self._link.frames().append((stamp, 0, 0, True, True))

    def read(self, until_ns: float) -> None:
        """Give the encoders' readings up to a stamp."""
        crane = self._crane
        end = int(np.searchsorted(crane.stamp_ns, until_ns, side="right"))
        given = slice(self._given, end)
        self._link.readings("crane").append(crane.stamp_ns[given], crane.position_m[given])
        self._given = end


def late_for_what_is_matched_ahead(come: Come) -> None:
    """The first keyframe has its readings; those after it are matched while theirs are on the way."""
    for stamp in come.stamps:
        come.keep(stamp)
    come.read(come.stamps[0] + 300_000_000)
    come.mapping.read_queue()
    come.mapping.add_next()
    for begun in come.mapping._match._begun.values():
        begun.result()
    come.read(np.inf)
    come.mapping.read_queue()
    while come.mapping.queue:
        come.mapping.add_next()


def late_for_the_map(come: Come) -> None:
    """The encoders are silent while the second keyframe is placed: its readings come after it is fused."""
    come.read(come.stamps[0] + 300_000_000)
    for stamp in come.stamps:
        come.keep(stamp)
    come.mapping.read_queue()
    for _ in come.stamps[:3]:
        come.mapping.add_next()
    come.read(np.inf)
    come.mapping.read_queue()
    come.mapping.add_next()


def in_time(come: Come) -> None:
    come.read(np.inf)
    for stamp in come.stamps:
        come.keep(stamp)
    come.mapping.read_queue()
    while come.mapping.queue:
        come.mapping.add_next()


@pytest.mark.parametrize(
    ("coming", "fused_again"), [(in_time, 0), (late_for_what_is_matched_ahead, 0), (late_for_the_map, 4)]
)
def test_what_comes_late_changes_nothing(
    coming: Callable[[Come], None], fused_again: int, whole: Path, tmp_path: Path, board: Counters,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    recording = bs.open_recording(whole)
    kept = KeptRecording(recording, list(recording.index.stamps_ns))
    settings = SETTINGS.chosen()
    folder = tmp_path / ".live"
    key = checkpoint_key(kept, kept, settings, kept.digests())
    checkpoints = checkpoint_folder(folder / "checkpoints", key)
    link = Link(LiveInput(whole), settings, LiveSettings(), folder, checkpoints, "", board.name, None)
    come = Come(recording, link)
    coming(come)
    assert come.mapping.show()
    come.beats.clear()
    come.mapping.end()
    # Each tile is elected and finished, after the last pair: a slow machine isn't taken for one that hangs.
    tiles = len(list(checkpoints.glob("files_*/surface_*.npy")))
    assert coming is late_for_the_map or len(come.beats) > tiles > 1
    fused: list[int] = []
    monkeypatch.setattr(map_building, "fuse_view", lambda *one: fused.append(1) or fuse_view(*one))
    write_measured([kept], tmp_path / "out", SETTINGS, LiftRequest(), keep=checkpoints.parent, report=False)
    assert len(fused) == fused_again
    placed = json.loads((tmp_path / "out" / "result.json").read_text())["yard_frame_id"]
    assert f"yard:{placed}".encode() in (tmp_path / LIVE_MAP).read_bytes()
    batch = bs.measure(whole, **FIELDS)
    for name in SAME:
        assert (tmp_path / "out" / name).read_bytes() == (batch.folder / name).read_bytes(), name


def test_what_was_matched_ahead_and_passed_over_is_let_go() -> None:
    """A crane that creeps passes most pairs over: 13 MB each."""

    class Match:
        stamp_ns = 0

    class Chain:
        def chain(self, stamp_ns: int) -> int:
            return stamp_ns

        def holds(self, stamp_ns: int) -> bool:
            return True

        def __call__(self, pair: Any) -> Any:
            match = Match()
            match.stamp_ns = pair.stamp_ns
            found.append(weakref.ref(match))
            return match

    found: list[weakref.ref[Any]] = []
    ahead = MatchedAhead(
        cast(Any, Chain()), cast(Any, lambda stamps: [SimpleNamespace(stamp_ns=one) for one in stamps])
    )
    ahead.begin(range(6))
    assert ahead(cast(Any, SimpleNamespace(stamp_ns=5))).stamp_ns == 5
    ahead.close()
    gc.collect()
    assert [one for one in found if one() is not None] == []


def test_a_crane_in_the_dark_holds_no_pictures_and_looks_at_each_pair_once(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Pairs that can't be matched waited whole, 5 MB each, and each new one had all of them looked at."""
    looked, held = list[int](), list[weakref.ref[Any]]()
    monkeypatch.setattr(live_map, "look_at", lambda *_: looked.append(1))
    pairs = SimpleNamespace(recording=SimpleNamespace(crane=lambda: None))
    placer = SimpleNamespace(
        push=lambda pair: PosedFrame(pair.stamp_ns, Pose.identity("yard", "body"), np.eye(6))
    )
    one = live_map.LiveMap(cast(Any, pairs), SETTINGS, tmp_path, None, cast(Any, placer), cast(Any, None))
    for number in range(5):
        pair = replace(pair_from_images(*np.zeros((2, 48, 64), np.uint8)), stamp_ns=number)
        held.append(weakref.ref(pair))
        one.add(pair)
    del pair
    gc.collect()
    assert not looked and [each for each in held if each() is not None] == []
