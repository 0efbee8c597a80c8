"""The same files from one recording: killed at any moment and gone on with, whatever is matched early."""

import json
import pickle
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import pytest

from barsight import map_building, pipeline
from barsight.calibration.files.rig_file import write_rig_file
from barsight.checkpoint import checkpoint_folder, checkpointed
from barsight.cli.main import run
from barsight.recording.base import RecordingSettings
from barsight.recording.open import open_recording
from cli_runs import FAST, cut_short, pictures

SAME = ("height.tif", "contour.csv", "trajectory.tum", "cloud.ply")


def killed_at(monkeypatch: pytest.MonkeyPatch, name: str, call: int) -> list[int]:
    """Let the pipeline's function `name` be interrupted at its call-th call (0: never); the calls made."""
    room = pipeline if hasattr(pipeline, name) else map_building
    whole, calls = getattr(room, name), []

    def counted(*arguments: Any, **named: Any) -> Any:
        calls.append(1)
        if len(calls) == call:
            raise KeyboardInterrupt
        return whole(*arguments, **named)

    monkeypatch.setattr(room, name, counted)
    return calls


def test_a_killed_run_goes_on(
    recording: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = recording.parent
    in_one_go, out, keep = folder / "one", folder / "out", folder / ".out.resume"
    assert run(["measure", str(recording), "-o", str(in_one_go), *FAST]) == 0
    command = ["measure", str(recording), "-o", str(out), *FAST, "--resume"]
    for stage, call in (("make_estimator", 1), ("fuse_view", 2), ("SurfaceElection", 1)):
        with monkeypatch.context() as patch:
            killed_at(patch, stage, call)
            assert run(command) == 130
        assert keep.is_dir() and not out.exists()
    with monkeypatch.context() as patch:
        fused = killed_at(patch, "fuse_view", 0)
        matched = counting_matches(patch)
        assert run(command) == 0
    assert (len(fused), len(matched)) == (4, 0)
    assert not keep.exists()
    for name in SAME:
        assert (out / name).read_bytes() == (in_one_go / name).read_bytes(), name
    capsys.readouterr()


def test_what_is_matched_early_changes_nothing(
    recording: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    stamps = open_recording(recording, RecordingSettings()).index.stamps_ns
    written = {}
    for early in ((), (0, 1), (0, 3), None):
        out = recording.parent / f"out{early}"
        with monkeypatch.context() as patch:
            if early is not None:
                guess = frozenset(stamps[k] for k in early)
                patch.setattr(map_building, "_known_early", lambda *_, guess=guess: guess)
            matched = counting_matches(patch)
            assert run(["measure", str(recording), "-o", str(out), *FAST, "--map.min-shift", "0.2"]) == 0
        written[early] = [(out / name).read_bytes() for name in SAME]
        if early is None:
            used = json.loads((out / "result.json").read_text())["frames"]["used"]
            assert len(matched) == used < 4  # the encoders' guess is right: none is matched in vain
    assert all(files == written[()] for files in written.values())
    capsys.readouterr()


def counting_matches(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    whole, calls = map_building.Matcher.__call__, []

    def counted(self: Any, *arguments: Any) -> Any:
        calls.append(1)
        return whole(self, *arguments)

    monkeypatch.setattr(map_building.Matcher, "__call__", counted)
    return calls


def test_another_key_starts_anew(tmp_path: Path) -> None:
    first = checkpoint_folder(tmp_path / "kept", "a" * 64)
    assert checkpointed(first, "x", lambda: 1) == 1
    assert checkpointed(first, "x", lambda: 2) == 1
    second = checkpoint_folder(tmp_path / "kept", "b" * 64)
    assert checkpointed(second, "x", lambda: 2) == 2
    assert not first.exists()
    assert checkpointed(None, "x", lambda: 3) == 3


def test_a_failure_leaves_nothing_to_go_on_from(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError):
        checkpointed(tmp_path, "x", lambda: 1 // 0)
    assert list(tmp_path.iterdir()) == []


def change_a_picture(recording: Path) -> tuple[str, ...]:
    first = pictures(recording, "cam0")[0]
    picture = cv2.imread(str(first), cv2.IMREAD_GRAYSCALE)
    assert picture is not None
    picture[100:110, 100:110] ^= 1
    cv2.imwrite(str(first), picture)
    return ()


def change_the_rig(recording: Path) -> tuple[str, ...]:
    rig = recording.parent / "rig.yaml"
    own = open_recording(recording).rig
    write_rig_file(rig, replace(own, timeshift_cam_imu_ns=own.timeshift_cam_imu_ns + 1_000_000))
    return ("--recording.rig", str(rig))


def change_a_setting(recording: Path) -> tuple[str, ...]:
    return ("--map.fill-m", "0.1")


@pytest.mark.parametrize("change", [change_a_picture, change_the_rig, change_a_setting, None])
def test_checkpoints_hold_only_for_what_made_them(
    recording: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    change: Callable[[Path], tuple[str, ...]] | None,
) -> None:
    command = ["measure", str(recording), "-o", str(recording.parent / "out"), *FAST, "--resume"]
    with monkeypatch.context() as patch:
        killed_at(patch, "SurfaceElection", 1)
        assert run(command) == 130
    flags = ("--bundles.slice-m", "0.3") if change is None else change(recording)
    with monkeypatch.context() as patch:
        matched = counting_matches(patch)
        assert run([*command, *flags]) == 0
    assert len(matched) == (0 if change is None else 4)
    capsys.readouterr()


def test_torn_checkpoints_are_made_anew(
    recording: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """One cut short, one with a wrong bit, one empty, one that is a pickle."""
    one, out = recording.parent / "one", recording.parent / "out"
    assert run(["measure", str(recording), "-o", str(one), *FAST]) == 0
    command = ["measure", str(recording), "-o", str(out), *FAST, "--resume"]
    with monkeypatch.context() as patch:
        killed_at(patch, "SurfaceElection", 1)
        assert run(command) == 130
    trajectory, *kept = sorted(recording.parent.glob(".out.resume/*/*.npz"), reverse=True)
    assert trajectory.stem == "trajectory"
    cut_short(trajectory)
    content = bytearray(kept[0].read_bytes())
    content[len(content) // 2] ^= 1
    kept[0].write_bytes(content)
    kept[1].write_bytes(b"")
    kept[2].write_bytes(pickle.dumps({"tree": 1}))
    with monkeypatch.context() as patch:
        matched = counting_matches(patch)
        assert run(command) == 0
    assert len(matched) == 3
    for name in SAME:
        assert (out / name).read_bytes() == (one / name).read_bytes(), name
    capsys.readouterr()
