"""The live run: what it keeps gives measure's bytes, faults show by name, and lifts don't outlive them."""

import contextlib
import json
import shutil
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal, cast

import numpy as np
import pytest

import barsight as bs
from barsight.cli.main import run
from barsight.core.errors import OutputError
from barsight.core.reading.sealed_json import write_sealed
from barsight.core.records.pairs import RefusedFrame, StereoFrame
from barsight.core.records.sensor_samples import CraneSamples
from barsight.live import run as live_run
from barsight.live.capture import Capture
from barsight.live.latency import counts, spread
from barsight.live.link import GrowingRecording, Link, LiveInput
from barsight.live.modes import FreezeWatch, JumpWatch, Mode, SensorActivity, judge_mode
from barsight.live.run import Keyframes, read_keyframes, replay, write_keyframes
from barsight.live.settings import LiveSettings
from barsight.live.shared.counters import OFF, Counters
from barsight.live.shared.logs import NumberLog, ReadingLog
from barsight.live.shared.ring import CapturedPair, PairRing
from barsight.live.source import ReplayClock, ReplaySource
from barsight.live.state import prometheus
from barsight.live.supervisor import Supervisor
from barsight.live.track import Tracking
from barsight.mapping.fusion import fuse_view
from barsight.mapping.surface.surface import read_tile
from barsight.pipeline.lift_choice import LiftRequest
from barsight.reconstruction import map_building
from barsight.recording.awaited import AwaitedRecording
from barsight.recording.formats.ground_truth import read_ground_truth
from barsight.sensors.pairing import PairFormer
from barsight.sensors.source import LivePicture, LostPicture, Readings, SensorSigns
from barsight.yard.magnet.description import example_magnet
from cli_runs import FAST
from test_cli_resume import counting_matches
from test_yard_frame import calibrated

SETTINGS = bs.MeasureSettings(
    stereo=replace(bs.MeasureSettings().stereo, method="sgbm"),
    map=replace(bs.MeasureSettings().map, cell_m=0.05),
)
FILES = ("height.tif", "trajectory.tum", "cloud.ply", "contour.csv", "bundles.json", "lifts.json")
BEGIN_NS = 1_700_000_000_000_000_000
DARK = np.zeros((4, 6), np.uint8)


def files(out: Path) -> dict[str, bytes]:
    return {name: (out / name).read_bytes() for name in FILES}


def content(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


@pytest.fixture
def board() -> Iterator[Counters]:
    one = Counters()
    yield one
    one.remove()


@pytest.fixture
def ring() -> Iterator[PairRing]:
    one = PairRing(3, 4, 6)
    yield one
    one.remove()


def frame(number: int) -> StereoFrame:
    return StereoFrame(number, np.full((4, 6), number, np.uint8), np.full((4, 6), 100 + number, np.uint8))


@pytest.mark.parametrize(
    ("estimator", "in_yard", "fused_again"), [("fused", False, 4), ("live", False, 0), ("live", True, 4)]
)
def test_a_run_as_fast_as_possible_is_measure(
    estimator: Literal["fused", "live"], in_yard: bool, fused_again: int, whole: Path, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """Poses that are final at once leave nothing to be matched at the end, and nothing to be fused but where
    what shows of an encoder's scale has widened them since.
    """
    fused: list[int] = []
    monkeypatch.setattr(map_building, "fuse_view", lambda *one: fused.append(1) or fuse_view(*one))
    matched = counting_matches(monkeypatch)
    yard = calibrated(tmp_path, 3, "encoders")[0].path if in_yard else None
    settings = replace(SETTINGS, motion=replace(SETTINGS.motion, estimator=estimator), yard=yard)
    magnet = tmp_path / "magnet.toml"
    magnet.write_text(example_magnet(), encoding="utf-8")
    told: list[str] = []
    out = tmp_path / "out"
    replay(
        whole, out, settings, LiveSettings(), speed=0, magnet=magnet, judged_at="end", tell=told.append
    )  # fmt: skip
    assert len(fused) == fused_again
    assert estimator == "fused" or not matched, "fused: what the map process came not to is left for the end"
    assert read_tile.cache_info().currsize == 0, "of a survey that is over nothing stays in memory"
    fields: dict[str, Any] = {
        "stereo": {"method": "sgbm"}, "map": {"cell_m": 0.05}, "motion": {"estimator": estimator},
        "yard": yard,
    }  # fmt: skip
    batch = bs.measure(whole, magnet=magnet, at="end", **fields)
    assert files(out) == files(batch.folder)
    # Between the two cameras' first pictures a look may fall, which tells so.
    assert ["mode full" in line for line in told if "no picture yet" not in line] == [True]
    latency, state = content(out / "latency.json"), content(out / "state.json")
    frames = latency["frames"]
    assert [frames[name] for name in ("captured", "paired", "tracked", "kept")] == [4] * 4
    assert set(frames["dropped"].values()) == {0}
    assert latency["pose_s"]["n"] == 0 and latency["pair_s"]["n"] == 4 and latency["lifts_s"]["n"] == 1
    assert (state["phase"], state["mode"], state["lifts"]["may_stand"]) == ("done", "full", True)
    assert content(out / "keyframes.json")["keyframes_ns"] == list(bs.open_recording(whole).index.stamps_ns)
    assert not {".live", "pose.json", "live_height.tif"} & {path.name for path in out.iterdir()}


def test_poses_come_between_pictures(whole: Path, tmp_path: Path) -> None:
    """At the recording's pace: more poses than pairs, each of its own time, carried on from the last pair."""
    seen: dict[int, dict[str, Any]] = {}

    def look() -> None:
        while not ended.is_set():
            with contextlib.suppress(OSError, ValueError):
                told = content(tmp_path / "out/pose.json")
                seen[told["stamp_ns"]] = told
            time.sleep(0.005)

    ended = threading.Event()
    reader = threading.Thread(target=look)
    reader.start()
    try:
        replay(whole, tmp_path / "out", SETTINGS, LiveSettings(max_predicted_s=5.0), tell=lambda _: None)
    finally:
        ended.set()
        reader.join()
    latency, stamps = content(tmp_path / "out/latency.json"), bs.open_recording(whole).index.stamps_ns
    assert latency["pose_s"]["n"] > 2 * len(stamps)
    assert 0 <= latency["pose_s"]["p50"] < 0.2
    poses = [seen[stamp] for stamp in sorted(seen)]
    assert {pose["frame"] for pose in poses} == {"yard"}
    assert all(0 <= pose["predicted_s"] <= 5.0 and max(pose["sigma_m"]) < 0.1 for pose in poses)
    truth = read_ground_truth(whole)
    for pose in poses:
        true = np.array([
            np.interp(pose["stamp_ns"], truth.stamp_ns, [one.translation[axis] for one in truth.poses])
            for axis in range(3)
        ])  # fmt: skip
        assert np.abs(true - pose["position_m"]).max() < 0.02


@pytest.mark.slow
def test_what_was_kept_replays_to_the_byte(whole: Path, tmp_path: Path) -> None:
    """At another pace, with pairs passed over and a mode that forbids lifts."""
    stamps = list(bs.open_recording(whole).index.stamps_ns)
    mode = Mode("no-encoders", ("the encoders: silent for 1.00 s (bound 0.30 s)",), False)
    write_keyframes(Keyframes((*stamps[:2], stamps[3]), mode), tmp_path / "keyframes.json")
    outs = []
    for speed in (20.0, 0.0):
        outs.append(tmp_path / f"out{speed:.0f}")
        given = tmp_path / "keyframes.json" if speed else outs[0] / "keyframes.json"
        replay(
            whole, outs[-1], SETTINGS, LiveSettings(), speed=speed, keyframes=given, judged_at="end",
            tell=lambda _: None,
        )  # fmt: skip
    assert content(outs[0] / "keyframes.json")["keyframes_ns"] == [*stamps[:2], stamps[3]]
    assert files(outs[0]) == files(outs[1])
    lifts = content(outs[1] / "lifts.json")
    assert lifts["lifts"] == [] and "live-state" in [veto["code"] for veto in lifts["vetoes"]]
    assert content(outs[1] / "state.json")["lifts"] == {"may_stand": False, "offered": 0}


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (("--replay", "{tmp}/nowhere"), ("nowhere",)),
        (("--replay", "{whole}", "--speed", "-1"), ("speed must lie in 0...1000",)),
        (("--replay", "{whole}", "--speed", "nan"), ("speed must lie in 0...1000",)),
        (("--replay", "{whole}", "--magnet", "{tmp}/no.toml"), ("no.toml: no such file",)),
        (("--replay", "{whole}", "--keyframes", "{tmp}/no.json"), ("no.json: no such file",)),
        (("--replay", "{whole}", "--live.ring-pairs", "1"), ("live.ring_pairs must lie in 2...1000",)),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(
    flags: tuple[str, ...], words: tuple[str, ...], whole: Path, tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    filled = [flag.format(whole=whole, tmp=tmp_path) for flag in flags]
    assert run(["live", *filled, "-o", str(tmp_path / "out"), *FAST]) in (2, 3)
    line = capsys.readouterr().err
    assert line.count("\n") == 1 and all(word in line for word in words)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_is_not_empty_is_refused(
    whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    assert run(["live", "--replay", str(whole), "-o", str(tmp_path)]) == 4
    assert "not empty" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def test_an_ended_run_does_not_say_that_lifts_stand(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A second Ctrl-C, for one; state.json is all that programs of others know."""

    def interrupted(self: Supervisor) -> None:
        self.state.phase, self.state.mode = "measuring", Mode("full", (), True)
        self._write(health=False)
        raise KeyboardInterrupt

    monkeypatch.setattr(Supervisor, "run", interrupted)
    with pytest.raises(KeyboardInterrupt):
        replay(whole, tmp_path / "out", SETTINGS, LiveSettings(), tell=lambda _: None)
    state = json.loads((tmp_path / "out" / "state.json").read_text())
    assert state["phase"] == "failed" and not state["lifts"]["may_stand"]


@pytest.mark.parametrize("removed", [".live", "."])
def test_a_folder_that_is_removed_during_the_run_is_named(
    removed: str, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It was said that the recording had no pair, for no reason, or that there was no live.log."""

    def cleared(self: Supervisor) -> None:
        self.state.mode = Mode("full", (), True)
        self._board.add("track", "kept", 3)
        shutil.rmtree(tmp_path / "out" / removed)
        self._log("track ended")

    monkeypatch.setattr(Supervisor, "run", cleared)
    with pytest.raises(OutputError, match=r"\.live: was removed during the run"):
        replay(whole, tmp_path / "out", SETTINGS, LiveSettings(), tell=lambda _: None)
    if removed == ".live":
        assert content(tmp_path / "out" / "state.json")["phase"] == "failed"


@pytest.mark.parametrize(
    ("after", "name", "told"),
    [
        ("", None, "the magnet's file was changed meanwhile: "),
        (example_magnet().replace("example", "another"), "another", "was changed; it counts as it is now"),
        (example_magnet(), "example", ""),
    ],
)
def test_lifts_are_chosen_for_the_magnet_as_it_is_described_at_the_end(
    after: str, name: str | None, told: str, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Lifts were chosen for the magnet that hung there as the service began, weeks ago."""
    magnet = tmp_path / "magnet.toml"
    magnet.write_text(example_magnet(), encoding="utf-8")

    def exchanged(self: Supervisor) -> None:
        self.state.mode = Mode("full", (), True)
        magnet.write_text(after, encoding="utf-8")

    given: list[LiftRequest] = []
    monkeypatch.setattr(Supervisor, "run", exchanged)
    monkeypatch.setattr(live_run, "_finish", lambda *all_: given.append(all_[5]) or {})
    lines: list[str] = []
    replay(whole, tmp_path / "out", SETTINGS, LiveSettings(), magnet=magnet, tell=lines.append)
    (request,) = given
    assert (request.magnet.name.split(":")[0] if request.magnet else None) == name
    assert [notice.code for notice in request.notices] == ["live-state"] * (name is None)
    assert len(lines) == bool(told) and all(told in line for line in lines)


@pytest.mark.parametrize("is_changed", [False, True])
def test_what_a_run_computed_does_not_count_for_another_yard_file(
    is_changed: bool, whole: Path, tmp_path: Path
) -> None:
    """Poses in the frame before were named as those of the frame after."""
    yard = calibrated(tmp_path, 3, "encoders")[0].path
    opened = bs.open_recording(whole)
    crane: Any = SimpleNamespace(
        awaited=lambda at: AwaitedRecording(at, opened.rig, opened.imu(), opened.crane())
    )
    settings = replace(SETTINGS, yard=yard).chosen()
    made = tmp_path / live_run._key(crane.awaited(whole), settings)[:32]
    made.mkdir()
    if is_changed:
        shutil.copy(calibrated(tmp_path, 4, "encoders")[0].path, yard)
    link = Link(LiveInput(whole, crane=crane), settings, LiveSettings(), tmp_path, made, "", "", None)
    recording, after = live_run._recorded(link, [], settings)
    assert (after.checkpoints == made) == is_changed
    assert (after.checkpoints.name == live_run._key(recording, settings)[:32]) != is_changed


def test_keyframes_come_back_and_torn_ones_are_refused(tmp_path: Path) -> None:
    kept = Keyframes((1, 2), Mode("blind", ("why",), False))
    write_keyframes(kept, tmp_path / "keyframes.json")
    assert read_keyframes(tmp_path / "keyframes.json") == kept
    path = tmp_path / "keyframes.json"
    path.write_text(path.read_text().replace('"lifts": false', '"lifts": true'))
    with pytest.raises(bs.BarsightError, match="was changed"):
        read_keyframes(path)
    path.write_text('{"keyframes_ns": [1]}')
    with pytest.raises(bs.BarsightError, match="no schema_version"):
        read_keyframes(path)
    write_sealed({"schema_version": 2, "keyframes_ns": [1]}, path)
    with pytest.raises(bs.BarsightError, match="is not a list of keyframes"):
        read_keyframes(path)


def test_the_ring_gives_whole_pairs_only(ring: PairRing) -> None:
    assert ring.newest == 0 and ring.read(1) is None
    reader = PairRing(3, 4, 6, ring.name)
    for number in range(1, 6):
        assert ring.write(frame(number), 7 * number) == number
        found = reader.read(reader.newest)
        assert found is not None and (found.number, found.exposed_ns) == (number, 7 * number)
        assert found.frame.stamp_ns == number and found.frame.right[3, 5] == 100 + number
    assert reader.read(2) is None, "written over"
    ring._heads[6 % 3, 0] = 2 * 6 - 1  # a writer is killed while it writes the sixth
    assert reader.newest == 5 and reader.read(6) is None and reader.read(3) is None
    assert ring.write(frame(7), 0) == 7 and reader.newest == 7
    reader.close()


def test_logs_skip_what_a_killed_writer_left(tmp_path: Path) -> None:
    log, lines = ReadingLog(tmp_path / "imu.log", 2), NumberLog(tmp_path / "frames.log")
    log.append(np.array([BEGIN_NS, BEGIN_NS + 1]), np.array([[1.0, 2.0], [3.0, 4.0]]))
    lines.append((BEGIN_NS, True))
    with (tmp_path / "imu.log").open("ab") as file:
        file.write(b"torn")
    with (tmp_path / "frames.log").open("ab") as file:
        file.write(b"17,")
    reader, numbers = ReadingLog(tmp_path / "imu.log", 2), NumberLog(tmp_path / "frames.log")
    assert reader.read()[0].tolist() == [BEGIN_NS, BEGIN_NS + 1] and numbers.read() == [(BEGIN_NS, 1)]
    ReadingLog(tmp_path / "imu.log", 2).append(np.array([BEGIN_NS + 2]), np.array([[5.0, 6.0]]))
    NumberLog(tmp_path / "frames.log").append((18,))
    stamps, values = reader.read()
    assert stamps.tolist() == [BEGIN_NS + 2] and values.tolist() == [[5.0, 6.0]]
    assert numbers.read() == [(18,)] and numbers.read() == []
    assert reader.last(2)[0].tolist() == [BEGIN_NS + 1, BEGIN_NS + 2]


def test_a_log_that_grows_while_it_is_read_gives_no_more_rows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two rows came for one that was asked for, so that two places couldn't be subtracted."""
    log = ReadingLog(tmp_path / "crane.log", 1)
    log.append(np.array([1, 2]), np.zeros((2, 1)))
    rows = log._rows

    def grown(first: int) -> np.ndarray:
        log.append(np.array([3]), np.zeros((1, 1)))
        return rows(first)

    monkeypatch.setattr(log, "_rows", grown)
    assert log.last(1)[1].shape == (1, 1) and log.last(0)[0].size == 0


def test_pairs_form_by_stamp_and_each_lone_picture_counts() -> None:
    """cam0 at 0, 10, 30, 41 and cam1 at 1, 20, 30, 40, tolerance 2."""
    former = PairFormer(2)
    order = [(0, 0), (1, 1), (0, 10), (1, 20), (0, 30), (1, 30), (1, 40), (0, 41)]
    pairs = [
        (found.stamp_ns, exposed)
        for camera, stamp in order
        for found, exposed in former.push(LivePicture(camera, stamp, 1000 + stamp, DARK))
    ]
    assert pairs == [(0, 1001), (30, 1030), (41, 1041)]
    assert former.lost == [1, 1]
    list(former.push(LivePicture(0, 50, 0, DARK)))
    former.end()
    assert former.lost == [2, 1]


def test_a_wide_tolerance_pairs_no_neighbours(
    whole: Path, board: Counters, ring: PairRing, tmp_path: Path
) -> None:
    """At 30 Hz, with a tolerance over an interval, the pictures after one that was lost."""
    settings = replace(SETTINGS, recording=replace(SETTINGS.recording, pair_tolerance_s=0.05)).chosen()
    link = Link(LiveInput(whole), settings, LiveSettings(), tmp_path, tmp_path, "", board.name, None)
    board["capture", "interval_ns"] = 33_333_333
    capture = Capture(link, board, ring)
    for k in range(8):
        for camera in (0, 1):
            if (k, camera) != (2, 0):
                stamp_ns = BEGIN_NS + k * 33_333_333 + camera * 100_000
                capture._take(LivePicture(camera, stamp_ns, stamp_ns, DARK, k))
    assert board["capture", "max_skew_ns"] == 100_000
    assert (board["capture", "paired"], board["capture", "unpaired_cam1"]) == (7, 1)


HEARD = SensorActivity((10**9, 10**9), 10**9, 30_000_000, {"imu": 10**9, "crane": 10**9})


@pytest.mark.parametrize(
    ("heard", "after_s", "down", "name", "lifts", "word"),
    [
        (HEARD, 0.05, {}, "full", True, None),
        (HEARD, 0.25, {}, "no-imu", True, "the IMU: silent for 0.25 s (bound 0.20 s)"),
        (replace(HEARD, readings_ns={"crane": 10**9}), 0.05, {}, "no-imu", True, "none in use"),
        (replace(HEARD, frozen=True), 0.05, {}, "no-encoders", False, "frozen"),
        (replace(HEARD, readings_ns={"imu": 10**9, "crane": 10**8}), 0, {}, "no-encoders", False, "silent"),
        (replace(HEARD, cameras_ns=(10**9, 10**8)), 0.05, {}, "encoders-only", False, "cam1: silent"),
        (replace(HEARD, cameras_ns=(0, 10**9)), 0.05, {}, "encoders-only", False, "cam0: no picture yet"),
        (HEARD, 1.0, {}, "blind", False, "cam0: silent"),
        (replace(HEARD, pair_ns=3 * 10**8), 0, {}, "encoders-only", False, "cam1: no pair for 0.70 s"),
        (replace(HEARD, pair_ns=5 * 10**8), 0, {}, "full", True, None),
        (replace(HEARD, pair_ns=0), 0, {}, "encoders-only", False, "cam1: no pair yet"),
        (HEARD, 0, {"capture": "killed"}, "blind", False, "capture is down: killed"),
        (replace(HEARD, jumped_m=0.5), 0, {}, "no-encoders", False, "jumped by 500 mm"),
        (replace(HEARD, clock_step_s=-40.0), 0, {}, "full", False, "stepped by -40.0 s"),
        (replace(HEARD, clock_step_s=0.4), 0, {}, "full", True, None),
        (replace(HEARD, off_m=(0.2, 0.0, -0.1)), 0, {}, "full", False, "224 mm off by cameras and IMU"),
        (replace(HEARD, off_m=(0.03, 0.0, 0.02)), 0, {}, "full", True, None),
        (replace(HEARD, restarted=True), 0, {}, "full", False, "their zero may have changed"),
        (replace(HEARD, skew_ns=-4_900_000), 0, {}, "full", False, "cam1 is exposed 4.9 ms before cam0"),
        (replace(HEARD, skew_ns=900_000), 0, {}, "full", True, None),
        (replace(HEARD, troubles={"cam0": "has 1x1"}), 0, {}, "full", True, None),
        (
            replace(HEARD, cameras_ns=(0, 10**9), troubles={"cam0": "has 1x1"}), 0.05, {}, "encoders-only",
            False, "cam0: no picture yet: has 1x1",
        ),
        (replace(HEARD, troubles={"cam0": "has 1x1"}), 1.0, {}, "blind", False, "(bound 0.30 s): has 1x1"),
        (replace(HEARD, troubles={"imu_clock": "it drifts"}), 0, {}, "full", False, "imu: it drifts"),
        (replace(HEARD, troubles={"pictures": "black"}), 0, {}, "encoders-only", False, "cam1: black"),
        (HEARD, 0, {"track": "x"}, "encoders-only", False, "track is down"),
        (HEARD, 0, {"map": "x"}, "full", False, "map is down"),
    ],
)  # fmt: skip
def test_modes_have_reasons(
    heard: SensorActivity, after_s: float, down: dict[str, str], name: str, lifts: bool, word: str | None
) -> None:
    mode = judge_mode(heard, 10**9 + round(after_s * 1e9), LiveSettings(), down)
    assert (mode.name, mode.lifts) == (name, lifts)
    assert (word is None and mode.reasons == ()) or any(word in reason for reason in mode.reasons if word)


def test_a_freeze_shows_within_a_second_and_a_stop_is_none() -> None:
    """0.5 m/s at 20 Hz; frozen from 3 s on, or braked by 0.25 m/s2 to a stand."""
    t = np.arange(0, 8, 0.05)
    mounted = CraneSamples(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(3), np.eye(3), 0.002)
    braking = np.where(t < 3, 0.5 * t, 1.5 + 0.5 * (t - 3) - 0.125 * (t - 3) ** 2)
    braking = np.where(t > 5, 2.0, braking)
    stamps = (1e9 * t).astype(np.int64)
    for way, frozen in ((np.where(t < 3, 0.5 * t, 1.5), True), (braking, False)):
        place = np.zeros((t.size, 3))
        place[:, 0] = np.round(way, 3)
        watch = FreezeWatch(mounted)
        seen = [watch.check(stamps[max(k - 100, 0) : k], place[max(k - 100, 0) : k]) for k in range(t.size)]
        first = t[seen.index(True)] if any(seen) else None
        assert (first is not None and 3 < first < 4 and all(seen[80:])) if frozen else first is None


def test_one_encoder_alone_that_freezes_shows_as_long_as_it_does() -> None:
    """The bridge stands at 1.5 m from 3 to 10 s; the trolley jitters by a count, then travels too."""
    t = np.arange(0, 14, 0.05)
    stamps, rng = (1e9 * t).astype(np.int64), np.random.default_rng(5)
    place = np.zeros((t.size, 3))
    place[:, 0] = np.where((t > 3) & (t < 10), 1.5, 0.5 * t).round(3)
    place[:, 1] = (np.clip(t - 5, 0, None) * 0.2 + rng.normal(0, 0.0007, t.size)).round(3)
    watch = FreezeWatch(CraneSamples(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(3), np.eye(3), 0.002))
    parts = [slice(max(k - 100, 0), k) for k in range(t.size)]
    seen = np.array([watch.check(stamps[part], place[part]) for part in parts])
    assert not seen[t <= 3].any() and seen[(t > 4) & (t <= 10)].all() and not seen[t > 10.2].any()


def test_a_replay_gives_all_in_order_and_goes_on_where_it_was(whole: Path) -> None:
    recording = bs.open_recording(whole)
    source = ReplaySource(recording, ReplayClock(0, 0, 0.0), lambda: True)
    start = dict.fromkeys(("cam0", "cam1", "imu", "crane"), 0)
    packets = list(source.packets(start))
    taken = [packet for packet in packets if isinstance(packet, LivePicture)]
    assert [p.stamp_ns for p in taken if p.camera == 0] == list(recording.index.stamps_ns)
    imu = recording.imu()
    assert imu is not None
    given = [p.stamp_ns for p in packets if isinstance(p, Readings) and p.sensor == "imu"]
    assert np.array_equal(np.concatenate(given), imu.stamp_ns)
    after = {"cam0": taken[2].stamp_ns, "cam1": taken[2].stamp_ns, "imu": int(given[0][-1]), "crane": 0}
    again = [p for p in source.packets(after) if isinstance(p, LivePicture)]
    assert [(p.camera, p.stamp_ns) for p in again] == [(p.camera, p.stamp_ns) for p in taken[4:]]


def test_a_replay_that_begins_before_zero_loses_nothing(whole: Path) -> None:
    recording = bs.open_recording(whole)
    pictures = [replace(one, stamp_ns=k - 3) for k, one in enumerate(recording.stored_images())]
    early = SimpleNamespace(
        rig=recording.rig, imu=lambda: None, crane=lambda: None, stored_images=lambda: iter(pictures)
    )
    source = ReplaySource(cast(Any, early), ReplayClock(0, 0, 0.0), lambda: True)
    packets = source.packets(dict.fromkeys(("cam0", "cam1", "imu", "crane"), 0))
    assert [p.stamp_ns for p in packets if isinstance(p, LivePicture)] == [p.stamp_ns for p in pictures]


def test_a_resumed_replay_loses_what_was_due_meanwhile_and_no_more(whole: Path) -> None:
    recording = bs.open_recording(whole)
    stamps = recording.index.stamps_ns
    clock = ReplayClock(time.monotonic_ns(), stamps[1] + 1, 5.0)
    after = {"cam0": stamps[0], "cam1": stamps[0], "imu": 0, "crane": 0}
    packets = list(ReplaySource(recording, clock, lambda: True).packets(after))
    lost = [(p.camera, p.stamp_ns) for p in packets if isinstance(p, LostPicture)]
    came = [(p.camera, p.stamp_ns) for p in packets if isinstance(p, LivePicture)]
    assert lost == [(0, stamps[1]), (1, stamps[1])]
    assert came == [(camera, stamp) for stamp in stamps[2:] for camera in (0, 1)]


def test_counters_and_health_are_text_that_adds_up(board: Counters) -> None:
    seen = Counters(board.name)
    seen["capture", "paired"] = 5
    seen.add("capture", "unpaired_cam1", 2)
    assert board["capture", "paired"] == 5 and counts(board)["captured"] == 7
    seen.close()
    text = prometheus(
        {
            "frames": counts(board), "restarts": {"map": 1}, "queues": {"keyframes": 3}, "mode": "full",
            "memory_bytes": {"map": 9}, "lifts_may_stand": True, "disk_free_bytes": 7, "disk_days": 1.5,
            "sensors": {"cam0_drift_ppb": -40}, "record": {"paused": 1}, "calibration": {"pitch_rad": 2e-05},
        }
    )  # fmt: skip
    assert 'barsight_frames_total{stage="captured"} 7\n' in text
    assert 'barsight_frames_dropped_total{cause="unpaired_cam1"} 2\n' in text
    assert 'barsight_mode{mode="full"} 1\n' in text and 'barsight_mode{mode="blind"} 0\n' in text
    assert "barsight_lifts_may_stand 1\n" in text
    assert 'barsight_calibration{figure="pitch_rad"} 2e-05\n' in text
    assert 'barsight_sensor{sign="cam0_drift_ppb"} -40\n' in text and "barsight_disk_days 1.5\n" in text
    assert all(len(line.split(" ")) in (2, 4) for line in text.splitlines())
    assert spread([]) == {"n": 0, "p50": None, "p99": None, "max": None}
    assert spread([1.0, 3.0, 2.0])["p50"] == 2.0


@pytest.mark.parametrize("back_s", [2.0, np.inf])
@pytest.mark.parametrize("jump_m", [0.06, -0.5])
def test_a_jump_of_the_encoders_shows_at_once_and_stays_until_they_come_back(
    jump_m: float, back_s: float
) -> None:
    """0.5 m/s at 20 Hz, rounded to 1 mm, with 1.5 mm of noise; a jump at 4 s while it brakes by 0.25 m/s2."""
    rng, t = np.random.default_rng(7), np.arange(0, 10, 0.05)
    x = np.where(t < 3, 0.5 * t, 1.5 + 0.5 * (t - 3) - 0.125 * (t - 3) ** 2)
    x = np.where(t > 5, 2.0, x)
    place = np.zeros((t.size, 3))
    for has_jumped in (False, True):
        place[:, 0] = x + (has_jumped & (t >= 4) & (t < 4 + back_s)) * jump_m
        noisy = np.round(place + rng.normal(0, 0.0015, place.shape), 3)
        watch, stamps = JumpWatch(0.0015), (1e9 * (100 + t)).astype(np.int64)
        seen = np.array([watch.check(stamps[max(k - 99, 0) : k + 1], noisy[max(k - 99, 0) : k + 1])
                         for k in range(t.size)])  # fmt: skip
        out = t[seen > 0]
        if not has_jumped:
            assert out.size == 0
            continue
        assert out[0] == pytest.approx(4.0) and seen[seen > 0][0] == pytest.approx(abs(jump_m), abs=0.02)
        assert np.diff(out).max() < 0.06
        assert out[-1] == pytest.approx(4 + back_s + 0.95 if back_s < 5 else t[-1])


@pytest.mark.parametrize("begin_s", [-1000, -1, 0, 1_700_000_000])
def test_a_jump_shows_wherever_the_clock_begins(begin_s: int) -> None:
    stamps = np.arange(40) * 50_000_000 + begin_s * 10**9
    place = np.zeros((40, 3))
    place[:, 0] = 0.015 * np.arange(40)
    assert JumpWatch(0.002).check(stamps, place) == 0
    place[10:, 0] += 0.5
    assert JumpWatch(0.002).check(stamps, place) == pytest.approx(0.5)


def test_encoders_that_come_back_from_a_freeze_have_not_jumped() -> None:
    t = np.arange(0, 8, 0.05)
    mounted = CraneSamples(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(3), np.eye(3), 0.002)
    place, stamps = np.zeros((t.size, 3)), (1e9 * (100 + t)).astype(np.int64)
    place[:, 0] = np.round(np.where((t > 3) & (t < 5), 1.5, 0.5 * t), 3)
    freeze, jump, out = FreezeWatch(mounted), JumpWatch(0.002), []
    for k in range(2, t.size + 1, 2):
        now = stamps[max(k - 100, 0) : k], place[max(k - 100, 0) : k]
        frozen, jumped_m = freeze.check(*now), jump.check(*now)
        if frozen:
            jump.begin_anew()
        out.append(frozen or jumped_m > 0)
    assert any(out) and not any(out[int(5.2 / 0.1) :])


@pytest.mark.parametrize("rate_hz", [20, 200, 1000])
@pytest.mark.parametrize("fault", ["frozen", "jumped"])
def test_faults_of_encoders_show_at_every_rate_and_after_a_pause(
    fault: str, rate_hz: int, whole: Path, board: Counters, tmp_path: Path
) -> None:
    """0.4 m/s; the fault comes while the supervisor, which looks every 0.11 s, is held up for 0.9 s."""
    link = Link(LiveInput(whole), SETTINGS.chosen(), LiveSettings(), tmp_path, tmp_path, "", board.name, None)
    supervisor, log = Supervisor(link, board, print), link.readings("crane")
    t, begin_s, taken, out = np.arange(0, 8, 1 / rate_hz), 3.0, 0, []
    place, stamps = np.zeros((t.size, 3)), BEGIN_NS + (1e9 * t).astype(np.int64)
    place[:, 0] = np.round(0.4 * t + np.random.default_rng(5).normal(0, 5e-4, t.size), 4)
    late = t >= begin_s
    place[late, 0] = place[np.argmax(late), 0] if fault == "frozen" else place[late, 0] + 0.2
    for now_s in np.arange(0.5, 6, 0.11):
        if begin_s - 0.3 < now_s < begin_s + 0.6:
            continue
        come = int(np.searchsorted(t, now_s))
        log.append(stamps[taken:come], place[taken:come])
        taken, heard = come, supervisor._heard()
        out.append((now_s > begin_s, heard.frozen if fault == "frozen" else heard.jumped_m > 0.15))
    assert not any(is_out for is_late, is_out in out if not is_late)
    assert all([is_out for is_late, is_out in out if is_late][2:])


def test_exposures_apart_count_only_by_one_clock(whole: Path, board: Counters, tmp_path: Path) -> None:
    """Two clocks are told apart by the least delays of their pictures, which may differ by milliseconds."""
    link = Link(LiveInput(whole), SETTINGS.chosen(), LiveSettings(), tmp_path, tmp_path, "", board.name, None)
    supervisor, found = Supervisor(link, board, lambda line: None), []
    board["capture", "skew_ns"] = 4_900_000
    for is_one in (0, 1):
        board["sensors", "one_clock"] = is_one
        found.append(supervisor._heard().skew_ns)
    assert found == [0, 4_900_000]


def test_tracking_begun_anew_beats_as_it_follows_all_keyframes(
    whole: Path, board: Counters, ring: PairRing, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without encoders it follows every one of them, in an hour's run for longer than a start may take."""
    link = Link(LiveInput(whole), SETTINGS.chosen(), LiveSettings(), tmp_path, tmp_path, "", board.name, None)
    recording, beats = bs.open_recording(whole), []
    for stamp in recording.index.stamps_ns[:3]:
        link.frames().append((stamp, 0, 0, True, True))
    tracking = Tracking(link, GrowingRecording(recording, [], link), board, ring)

    def placed(seen: Any) -> RefusedFrame:
        beats.append(board["track", "beat_ns"])
        board["track", "beat_ns"] = 0
        return RefusedFrame(seen.stamp_ns, "dark")

    monkeypatch.setattr(tracking, "_placed", placed)
    tracking.follow_again()
    assert len(beats) == 3 and all(beats)


def test_pictures_in_which_nothing_can_be_matched_are_reported_until_they_can(
    whole: Path, board: Counters, ring: PairRing, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both lenses are covered for four pairs; tracking that then begins anew tells that they are free."""
    link = Link(LiveInput(whole), SETTINGS.chosen(), LiveSettings(), tmp_path, tmp_path, "", board.name, None)
    recording = bs.open_recording(whole)
    seen = next(one for one in recording.frames() if isinstance(one, StereoFrame))
    black = np.zeros_like(seen.left)
    monkeypatch.setattr(Tracking, "_wait_for_readings", lambda self, stamp_ns: None)
    monkeypatch.setattr(Tracking, "_placed", lambda self, pair: RefusedFrame(pair.stamp_ns, "dark"))

    def begun() -> Tracking:
        tracking = Tracking(link, GrowingRecording(recording, [], link), board, ring)
        tracking.follow_again()
        return tracking

    tracking, told = begun(), []
    for k in range(6):
        if k == 4:
            tracking = begun()
        pair = StereoFrame(seen.stamp_ns + k, *((black, black) if k < 4 else (seen.left, seen.right)))
        tracking.take(CapturedPair(k + 1, 0, pair), range(0))
        told.append(link.told("pictures"))
    assert told[:2] == told[4:] == ["", ""]
    assert all("the left image is black all over" in one for one in told[2:4])


def test_lenses_that_are_covered_but_for_the_sensors_noise_are_reported_until_they_are_free(
    whole: Path, board: Counters, ring: PairRing, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No real picture is of one gray: mode full stood, with lifts, to the end of the run."""
    link = Link(LiveInput(whole), SETTINGS.chosen(), LiveSettings(), tmp_path, tmp_path, "", board.name, None)
    recording, rng = bs.open_recording(whole), np.random.default_rng(0)
    seen = next(one for one in recording.frames() if isinstance(one, StereoFrame))
    monkeypatch.setattr(Tracking, "_wait_for_readings", lambda self, stamp_ns: None)
    crane, imu = recording.crane(), recording.imu()
    assert crane is not None and imu is not None
    link.readings("crane").append(crane.stamp_ns, crane.position_m)
    link.readings("imu").append(imu.stamp_ns, np.hstack([imu.gyro_radps, imu.accel_mps2]))
    growing = GrowingRecording(recording, [], link)
    growing.grow()
    tracking, told = Tracking(link, growing, board, ring), []
    tracking.follow_again()
    for k in range(14):
        noise = np.rint(rng.normal(1.0, 0.9, (2, *seen.left.shape))).clip(0, 255).astype(np.uint8)
        images = (seen.left, seen.right) if k < 2 or k > 11 else tuple(noise)
        pair = StereoFrame(seen.stamp_ns + 10_000_000 * k, *images)
        tracking.take(CapturedPair(k + 1, 0, pair), range(0))
        told.append(bool(link.told("pictures")))
    assert told == [False] * 9 + [True] * 3 + [False] * 2


@pytest.mark.parametrize("frozen", [(0,), (1,), (0, 1)])
def test_a_camera_that_repeats_its_picture_while_the_crane_moves_is_reported(
    frozen: tuple[int, ...], whole: Path, board: Counters, ring: PairRing, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """Three pairs of a crane that stands, four of one that moves by 40 mm from each to the next, then a new
    picture; a picture may come again while the crane stands.
    """
    link = Link(LiveInput(whole), SETTINGS.chosen(), LiveSettings(), tmp_path, tmp_path, "", board.name, None)
    recording = bs.open_recording(whole)
    seen = [one for one in recording.frames() if isinstance(one, StereoFrame)]
    monkeypatch.setattr(Tracking, "_wait_for_readings", lambda self, stamp_ns: None)
    monkeypatch.setattr(Tracking, "_placed", lambda self, pair: RefusedFrame(pair.stamp_ns, "not tried"))
    tracking, told = Tracking(link, GrowingRecording(recording, [], link), board, ring), []
    for k in range(8):
        link.readings("crane").append(np.array([k]), np.array([[0.04 * max(k - 2, 0), 1.0, 8.0]]))
        images = [
            getattr(seen[0], side) if k < 3 or (camera in frozen and k < 7) else getattr(seen[1], side) + k
            for camera, side in enumerate(("left", "right"))
        ]
        tracking.take(CapturedPair(k + 1, 0, StereoFrame(k, *images)), range(0))
        told.append(link.told("pictures"))
    names = " and ".join(f"cam{camera}" for camera in frozen)
    why = f"the same picture comes again and again from {names} while the crane moves"
    assert told == [""] * 4 + [why] * 3 + [""]


def test_pairs_without_a_pose_are_kept_unless_their_pictures_are_old(
    whole: Path, board: Counters, ring: PairRing, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each pair of a frozen camera was kept while the crane travelled on: 20 MB a pair, and nothing is mapped
    by it.
    """
    link = Link(LiveInput(whole), SETTINGS.chosen(), LiveSettings(), tmp_path, tmp_path, "", board.name, None)
    recording = bs.open_recording(whole)
    seen = next(one for one in recording.frames() if isinstance(one, StereoFrame))
    monkeypatch.setattr(Tracking, "_wait_for_readings", lambda self, stamp_ns: None)
    tracking, kept = Tracking(link, GrowingRecording(recording, [], link), board, ring), []
    for k, is_stale in enumerate((False, True, True, False)):
        refused = RefusedFrame(seen.stamp_ns + k, "no pose", is_stale)
        monkeypatch.setattr(tracking, "_placed", lambda pair, refused=refused: refused)
        frame = StereoFrame(seen.stamp_ns + k, seen.left, seen.right)
        tracking.take(CapturedPair(k + 1, 0, frame), range(0))
        kept.append(board["track", "kept"])
    assert kept == [1, 1, 1, 2]


def test_a_trouble_that_changes_is_never_read_as_over(
    whole: Path, board: Counters, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A file is empty while it is written: whoever read it then said that lifts are valid."""
    link = Link(LiveInput(whole), SETTINGS.chosen(), LiveSettings(), tmp_path, tmp_path, "", board.name, None)
    link.tell("imu_clock", "it drifts by 300 ppm")
    found, write = [], Path.write_text

    def slowly(self: Path, text: str, **how: Any) -> int:
        write(self, "", **how)
        found.append(link.told("imu_clock"))
        return write(self, text, **how)

    monkeypatch.setattr(Path, "write_text", slowly)
    for why in ("it drifts by 300 ppm", "it drifts by 500 ppm", ""):
        link.tell("imu_clock", why)
    assert found == ["it drifts by 300 ppm", "it drifts by 500 ppm"] and link.told("imu_clock") == ""


def test_what_the_encoders_are_off_by_outlives_tracking_and_counts_once(
    whole: Path, board: Counters, ring: PairRing, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A jump of 0.3 m; a restarted process may find it again in the keyframes that it follows, or not."""
    link = Link(LiveInput(whole), SETTINGS.chosen(), LiveSettings(), tmp_path, tmp_path, "", board.name, None)
    recording = GrowingRecording(bs.open_recording(whole), [], link)
    for found_again_um, found_um in ((0, 300_000), (300_000, 300_000), (0, 0)):
        tracking = Tracking(link, recording, board, ring)
        sizes = iter((found_again_um, found_um))
        monkeypatch.setattr(
            tracking, "_encoders_um", lambda sizes=sizes: dict(zip(OFF, (next(sizes), 0, 0), strict=True))
        )
        tracking.follow_again()
        tracking._tell_encoders()
        assert [board["track", name] for name in OFF] == [300_000, 0, 0]


def test_why_a_camera_is_not_connected_reaches_the_run(
    whole: Path, board: Counters, ring: PairRing, tmp_path: Path
) -> None:
    link = Link(LiveInput(whole), SETTINGS.chosen(), LiveSettings(), tmp_path, tmp_path, "", board.name, None)
    capture = Capture(link, board, ring)
    for why in ("gives 640x480,\nthe calibration is for 1280x1024", ""):
        signs = SensorSigns({"cam1_connects": 1}, {"cam0": "", "cam1": why})
        capture.run(SimpleNamespace(packets=lambda after, signs=signs: iter([signs])))  # type: ignore[arg-type]
        assert (link.told("cam0"), link.told("cam1")) == ("", " ".join(why.split()))


def test_a_process_that_lives_but_does_not_go_on_counts_as_down_before_it_is_ended(
    whole: Path, board: Counters, tmp_path: Path
) -> None:
    """Tracking that hung for 25 s was told nowhere, and lifts stood."""
    link = Link(LiveInput(whole), SETTINGS.chosen(), LiveSettings(), tmp_path, tmp_path, "", board.name, None)
    supervisor = Supervisor(link, board, lambda _: None)
    for role, one in supervisor.state.processes.items():
        one.state = "running"
        board.beat(role)
    assert supervisor._down() == {}
    board["track", "beat_ns"] -= 6 * 10**9
    assert supervisor._down() == {"track": "has not gone on for 6 s"}
    supervisor.state.processes["track"].state = "done"
    assert supervisor._down() == {}
