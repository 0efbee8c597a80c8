"""The same files from one recording: killed at any moment and gone on with, whatever is matched early."""

import json
from pathlib import Path
from typing import Any

import pytest

from barsight import pipeline
from barsight.cli.main import run
from barsight.kept import keeping_folder, once
from barsight.recording.base import RecordingSettings
from barsight.recording.open import open_recording
from cli_runs import FAST

SAME = ("height.tif", "contour.csv", "trajectory.tum", "cloud.ply")


def killed_at(monkeypatch: pytest.MonkeyPatch, name: str, call: int) -> list[int]:
    """Let the pipeline's function `name` be interrupted at its call-th call (0: never); the calls made."""
    whole, calls = getattr(pipeline, name), []

    def counted(*arguments: Any, **named: Any) -> Any:
        calls.append(1)
        if len(calls) == call:
            raise KeyboardInterrupt
        return whole(*arguments, **named)

    monkeypatch.setattr(pipeline, name, counted)
    return calls


def test_a_killed_run_goes_on(
    recording: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = recording.parent
    in_one_go, out, keep = folder / "one", folder / "out", folder / ".out.resume"
    assert run(["measure", str(recording), "-o", str(in_one_go), *FAST]) == 0
    command = ["measure", str(recording), "-o", str(out), *FAST, "--resume"]
    for stage, call in (("make_estimator", 1), ("fuse", 2), ("finish", 1)):
        with monkeypatch.context() as patch:
            killed_at(patch, stage, call)
            assert run(command) == 130
        assert keep.is_dir() and not out.exists()
    with monkeypatch.context() as patch:
        fused = killed_at(patch, "fuse", 0)
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
                patch.setattr(pipeline, "_known_early", lambda *_, guess=guess: guess)
            matched = counting_matches(patch)
            assert run(["measure", str(recording), "-o", str(out), *FAST, "--map.least-shift", "0.2"]) == 0
        written[early] = [(out / name).read_bytes() for name in SAME]
        if early is None:
            used = json.loads((out / "result.json").read_text())["frames"]["used"]
            assert len(matched) == used < 4  # the encoders' guess is right: none is matched in vain
    assert all(files == written[()] for files in written.values())
    capsys.readouterr()


def counting_matches(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    whole, calls = pipeline.Matcher.__call__, []

    def counted(self: Any, *arguments: Any) -> Any:
        calls.append(1)
        return whole(self, *arguments)

    monkeypatch.setattr(pipeline.Matcher, "__call__", counted)
    return calls


def test_other_settings_start_anew(tmp_path: Path) -> None:
    first = keeping_folder(tmp_path / "kept", "a" * 64)
    assert once(first, "x", lambda: 1) == 1
    assert once(first, "x", lambda: 2) == 1
    second = keeping_folder(tmp_path / "kept", "b" * 64)
    assert once(second, "x", lambda: 2) == 2
    assert not first.exists()
    assert once(None, "x", lambda: 3) == 3


def test_a_failure_leaves_nothing_to_go_on_from(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError):
        once(tmp_path, "x", lambda: 1 // 0)
    assert list(tmp_path.iterdir()) == []
