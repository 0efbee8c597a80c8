"""The same files from one recording: killed at any moment and gone on with, whatever is matched early."""

import contextlib
import json
import pickle
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from barsight.calibration.files.rig_file import write_rig_file
from barsight.calibration.files.yaml_document import write_document
from barsight.cli.main import run
from barsight.core.errors import BarsightError, Failed, InputError
from barsight.mapping.view import Matcher
from barsight.measure_settings import MeasureSettings
from barsight.pipeline import mapped_yard
from barsight.reconstruction import checkpoint, map_building, tracked_recording
from barsight.reconstruction.checkpoint import checkpoint_folder, checkpointed, read_checkpoint
from barsight.reconstruction.probed_recording import inspect_recording
from barsight.recording.base import RecordingSettings
from barsight.recording.open import open_recording
from barsight.yard.magnet.description import example_magnet
from cli_runs import FAST, cut_short, edit, pictures
from recording_samples import write_euroc

SAME = ("height.tif", "contour.csv", "trajectory.tum", "cloud.ply")


def killed_at(monkeypatch: pytest.MonkeyPatch, name: str, call: int) -> list[int]:
    """Let the pipeline's function `name` be interrupted at its call-th call (0: never); the calls made."""
    room = next(one for one in (mapped_yard, tracked_recording, map_building) if hasattr(one, name))
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
    for stage, call in (("make_estimator", 1), ("fuse_view", 2), ("cut_profiles", 1)):
        with monkeypatch.context() as patch:
            killed_at(patch, stage, call)
            assert run(command) == 130
        assert keep.is_dir() and not out.exists()
    with monkeypatch.context() as patch:
        fused = killed_at(patch, "fuse_view", 0)
        matched = counting_matches(patch)
        assert run(command) == 0
    assert (len(fused), len(matched)) == (0, 0)
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
                patch.setattr(tracked_recording, "_known_early", lambda *_, guess=guess: guess)
            matched = counting_matches(patch)
            assert run(["measure", str(recording), "-o", str(out), *FAST, "--map.min-shift", "0.2"]) == 0
        written[early] = [(out / name).read_bytes() for name in SAME]
        if early is None:
            used = json.loads((out / "result.json").read_text())["frames"]["used"]
            assert len(matched) == used < 4  # the encoders' guess is right: none is matched in vain
    assert all(files == written[()] for files in written.values())
    capsys.readouterr()


def counting_matches(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    whole, calls = Matcher.__call__, []

    def counted(self: Any, *arguments: Any) -> Any:
        calls.append(1)
        return whole(self, *arguments)

    monkeypatch.setattr(Matcher, "__call__", counted)
    return calls


def test_another_key_starts_anew(tmp_path: Path) -> None:
    made = [Failed("made", "at first"), Failed("made", "again")]
    first = checkpoint_folder(tmp_path / "kept", "a" * 64)
    assert checkpointed(first, "x", lambda: made[0]) == made[0]
    assert checkpointed(first, "x", lambda: made[1]) == made[0]
    second = checkpoint_folder(tmp_path / "kept", "b" * 64)
    assert checkpointed(second, "x", lambda: made[1]) == made[1]
    assert not first.exists()
    assert checkpointed(None, "x", lambda: made[1]) == made[1]


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


def key_of(recording: Path, settings: MeasureSettings | None = None) -> str:
    source = open_recording(recording)
    return checkpoint.checkpoint_key(source, source, settings or MeasureSettings(), source.digests())


def edit_imu(recording: Path) -> None:
    edit(recording / "mav0" / "imu0" / "data.csv", lambda rows: [*rows[:3], rows[3] + "1", *rows[4:]])


def edit_crane(recording: Path) -> None:
    path = recording / "mav0" / "crane0" / "sensor.yaml"
    edit(path, lambda rows: [row.replace("0.35", "0.36") for row in rows])


def edit_rig(recording: Path) -> None:
    path = recording / "mav0" / "cam0" / "sensor.yaml"
    edit(path, lambda rows: [row.replace("60.0", "60.5") for row in rows])


def edit_picture(recording: Path) -> None:
    pictures(recording, "cam1")[0].write_bytes(pictures(recording, "cam0")[0].read_bytes())


@pytest.mark.parametrize("change", [edit_imu, edit_crane, edit_rig, edit_picture])
def test_the_key_tells_each_input(tmp_path: Path, change: Callable[[Path], None]) -> None:
    recording = write_euroc(tmp_path)
    before = key_of(recording)
    assert key_of(recording) == before
    change(recording)
    assert key_of(recording) != before


def test_the_key_tells_sources_and_settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Magnet and lift settings are judged anew each time: nothing that is kept depends on them."""
    recording = write_euroc(tmp_path)
    before, settings = key_of(recording), MeasureSettings()
    assert key_of(recording, replace(settings, stereo=replace(settings.stereo, max_sigma_px=0.1))) != before
    assert key_of(recording, replace(settings, lift=replace(settings.lift, max_age_s=1.0))) == before
    monkeypatch.setattr(checkpoint, "sources_digest", lambda _: "of another version")
    assert key_of(recording) != before


def test_another_magnet_is_judged_from_the_same_checkpoints(
    recording: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    magnet = recording.parent / "magnet.toml"
    magnet.write_text(example_magnet())
    command = ["measure", str(recording), "-o", str(recording.parent / "out"), *FAST, "--resume"]
    with monkeypatch.context() as patch:
        killed_at(patch, "SurfaceElection", 1)
        assert run([*command, "--magnet", str(magnet)]) == 130
    magnet.write_text(example_magnet().replace('name = "', 'name = "other ', 1))
    with monkeypatch.context() as patch:
        matched = counting_matches(patch)
        assert run([*command, "--magnet", str(magnet)]) == 0
    lifts = json.loads((recording.parent / "out" / "lifts.json").read_text())
    assert len(matched) == 0 and lifts["magnet"]["name"].startswith("other ")
    capsys.readouterr()


def test_torn_checkpoints_are_made_anew(
    recording: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """One cut short, one with a wrong bit, one empty, one that is a pickle."""
    one, out = recording.parent / "one", recording.parent / "out"
    assert run(["measure", str(recording), "-o", str(one), *FAST]) == 0
    command = ["measure", str(recording), "-o", str(out), *FAST, "--resume"]
    with monkeypatch.context() as patch:
        killed_at(patch, "cut_profiles", 1)
        assert run(command) == 130
    trajectory, *kept = sorted(recording.parent.glob(".out.resume/*/*.npz"), reverse=True)
    assert trajectory.stem.startswith("trajectory_") and kept[4].stem.startswith("map_")
    cut_short(trajectory)
    cut_short(kept[4])
    cut_short(kept[5])
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


def test_a_planted_link_or_file_is_refused_and_nothing_behind_it_removed(tmp_path: Path) -> None:
    (tmp_path / "victim" / "precious").mkdir(parents=True)
    (tmp_path / "link").symlink_to(tmp_path / "victim")
    (tmp_path / "file").touch()
    for root in ("link", "file"):
        with pytest.raises(InputError, match="not this user's own folder"):
            checkpoint_folder(tmp_path / root, "key")
    own = checkpoint_folder(tmp_path / "own", "key")
    (own.parent / "stale").symlink_to(tmp_path / "victim")
    (own.parent / "old").touch()
    assert checkpoint_folder(tmp_path / "own", "key") == own
    assert [path.name for path in own.parent.iterdir()] == ["key"]
    assert (tmp_path / "victim" / "precious").is_dir()


@pytest.mark.parametrize("tree", ["[" * 100_000, '{"kind": "Pose", "fields": []}', "5"])
def test_a_foreign_checkpoint_is_made_anew(tmp_path: Path, tree: str) -> None:
    np.savez(tmp_path / "trajectory.npz", tree=np.frombuffer(tree.encode(), np.uint8))
    assert checkpointed(tmp_path, "trajectory", lambda: Failed("made", "anew")) == Failed("made", "anew")
    assert read_checkpoint(tmp_path / "trajectory.npz") == Failed("made", "anew")


def test_another_yard_file_is_another_key(tmp_path: Path) -> None:
    recording = open_recording(write_euroc(tmp_path))
    keys = set()
    for shift_m in (0.0, 5.0, 5.0):
        content = {"barsight_yard": 1, "yard_from_encoders": np.eye(4).tolist()}
        content |= {"covariance": (1e-6 * np.eye(6)).tolist()}
        content["yard_from_encoders"][0][3] = shift_m
        write_document(tmp_path / "yard.yaml", content)
        settings = MeasureSettings(yard=tmp_path / "yard.yaml")
        with contextlib.suppress(
            BarsightError
        ):  # the tiny recording can't be measured; its key is made first
            inspect_recording(recording, settings, tmp_path, tmp_path / "resume")
        keys.add(next((tmp_path / "resume").iterdir()).name)
    assert len(keys) == 2
