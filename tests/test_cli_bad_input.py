"""A user's mistakes with `barsight measure`: one line, an exit code, and nothing left behind."""

import contextlib
import errno
import os
import shutil
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest
import yaml

from barsight.cli import main
from barsight.cli.main import run
from cli_runs import FAST, cut_short, edit, measure, pictures, refused


def test_a_whole_recording_measures(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, text = measure(recording, capsys)
    assert code == 0 and "4 of 4 frames" in text
    out = recording.parent / "out"
    names = {path.name for path in out.iterdir()}
    assert names == {
        "result.json", "trajectory.tum", "cloud.ply", "height.tif", "free.tif", "tops.tif", "contour.csv",
        "laser.csv", "preview.png", "report.html", "bundles.json", "lifts.json", "ortho.tif", "ortho.png",
    }  # fmt: skip


def test_no_such_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    refused(tmp_path / "nothing", capsys, "nothing", "no such")


def test_no_right_camera(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.rmtree(recording / "mav0" / "cam1")
    refused(recording, capsys, "cam1")


def test_one_torn_picture_is_refused_and_the_run_goes_on(
    recording: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    torn = pictures(recording, "cam1")[1]
    cut_short(torn)
    code, text = measure(recording, capsys, "-v")
    assert code == 0 and "3 of 4 frames" in text
    assert torn.stem in text and torn.name in text


def test_all_pictures_torn(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for path in pictures(recording, "cam0"):
        cut_short(path)
    refused(recording, capsys, "none of the 4 frames", ".png")


def test_swapped_pictures(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mav0 = recording / "mav0"
    (mav0 / "cam0" / "data").rename(mav0 / "aside")
    (mav0 / "cam1" / "data").rename(mav0 / "cam0" / "data")
    (mav0 / "aside").rename(mav0 / "cam1" / "data")
    refused(recording, capsys, "swapped", "exchange")


def test_swapped_calibration(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mav0 = recording / "mav0"
    (mav0 / "cam0" / "sensor.yaml").rename(mav0 / "aside.yaml")
    (mav0 / "cam1" / "sensor.yaml").rename(mav0 / "cam0" / "sensor.yaml")
    (mav0 / "aside.yaml").rename(mav0 / "cam1" / "sensor.yaml")
    refused(recording, capsys, "swapped")


def test_calibration_with_a_non_rotation(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = recording / "mav0" / "cam0" / "sensor.yaml"
    text = path.read_text()
    start = text.index("data:")
    number = next(word for word in text[start:].replace("[", " ").replace(",", " ").split() if "." in word)
    path.write_text(text[:start] + text[start:].replace(number, "0.7", 1))
    refused(recording, capsys, "sensor.yaml", "not a rotation")


@pytest.mark.parametrize("sensor", ["cam0", "imu0", "crane0"])
def test_stamps_out_of_order(recording: Path, capsys: pytest.CaptureFixture[str], sensor: str) -> None:
    path = recording / "mav0" / sensor / "data.csv"
    edit(path, lambda rows: [rows[0], rows[2], rows[1], *rows[3:]])
    refused(recording, capsys, f"{sensor}/data.csv", "line 3", "sort")


@pytest.mark.parametrize("sensor", ["cam1", "imu0", "crane0"])
def test_doubled_stamps(recording: Path, capsys: pytest.CaptureFixture[str], sensor: str) -> None:
    path = recording / "mav0" / sensor / "data.csv"
    edit(path, lambda rows: [*rows[:3], rows[2], *rows[3:]])
    refused(recording, capsys, f"{sensor}/data.csv", "line 4")


def test_nan_in_the_imu(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = recording / "mav0" / "imu0" / "data.csv"
    edit(path, lambda rows: [*rows[:5], rows[5].rsplit(",", 1)[0] + ",nan", *rows[6:]])
    refused(recording, capsys, "imu0/data.csv", "line 6")
    code, _ = measure(recording, capsys, "--use", "stereo", "crane")
    assert code == 0, "without the IMU it measures"


@pytest.mark.parametrize("sensor", ["cam0", "cam1", "imu0", "crane0", "laser0"])
def test_empty_tables(recording: Path, capsys: pytest.CaptureFixture[str], sensor: str) -> None:
    path = recording / "mav0" / sensor / "data.csv"
    edit(path, lambda rows: rows[:1])
    refused(recording, capsys, f"{sensor}/data.csv")


def test_wrong_size_of_picture(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    edit(
        recording / "mav0" / "cam0" / "sensor.yaml",
        lambda rows: [row.replace("320", "322") for row in rows],
    )
    refused(recording, capsys, "320x256")


def test_a_calibration_that_does_not_fit_is_said(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = recording / "mav0" / "cam1" / "sensor.yaml"
    document = yaml.safe_load(path.read_text())
    document["intrinsics"][3] += 4
    path.write_text(yaml.safe_dump(document))
    code, text = measure(recording, capsys)
    assert code == 0 and "px off their rows" in " ".join(text.split())


def test_a_demo_into_a_recording(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["demo", "-o", str(recording)]) == 4
    assert f"{recording}: exists and is not empty" in capsys.readouterr().err
    assert {path.name for path in recording.iterdir()} == {"mav0", "truth"}


def test_out_under_a_file(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    blocker = recording.parent / "file"
    blocker.write_text("in the way")
    code = run(["measure", str(recording), "-o", str(blocker / "out"), *FAST])
    assert code == 4
    assert "name another folder" in capsys.readouterr().err
    assert blocker.read_text() == "in the way"


def test_out_not_empty(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = recording.parent / "out"
    out.mkdir()
    (out / "mine.txt").write_text("keep")
    refused(recording, capsys, "not empty")
    assert [path.name for path in out.iterdir()] == ["mine.txt"]


def test_overwriting_leaves_no_file_of_the_earlier_run(
    recording: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = recording.parent / "out"
    assert measure(recording, capsys)[0] == 0 and (out / "laser.csv").exists()
    (out / "mine.txt").write_text("keep")
    shutil.rmtree(recording / "mav0" / "laser0")
    assert measure(recording, capsys, "--overwrite")[0] == 0
    assert not (out / "laser.csv").exists() and (out / "mine.txt").read_text() == "keep"


def test_out_inside_the_recording(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["measure", str(recording), "-o", str(recording / "out"), *FAST]) == 4
    assert "in the recording" in capsys.readouterr().err
    assert not (recording / "out").exists()


@pytest.mark.parametrize("writer", ["numpy.save", "tifffile.imwrite"])
def test_disk_full_in_the_middle(
    recording: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, writer: str
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(writer, full)
    refused(recording, capsys, "disk is full", "out")


@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_interrupted_in_the_middle(recording: Path, sent: signal.Signals) -> None:
    """Many copies of one frame keep the run busy; the signal comes once it has begun to write."""
    mav0 = recording / "mav0"
    for camera in ("cam0", "cam1"):
        rows = (mav0 / camera / "data.csv").read_text().splitlines()
        stamp, name = rows[2].split(",")
        more = [f"{int(stamp) + 1000 * k},{name}" for k in range(1, 400)]
        (mav0 / camera / "data.csv").write_text("\n".join([rows[0], rows[1], rows[2], *more]) + "\n")
    out = recording.parent / "out"
    before = set(recording.parent.iterdir())
    command = [sys.executable, "-m", "barsight", "measure", str(recording), "-o", str(out), *FAST]
    # nohup, which ignores SIGHUP, must not make the run ignore it too.
    heard = partial(signal.signal, signal.SIGHUP, signal.SIG_DFL)
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, preexec_fn=heard) as process:
        deadline = time.monotonic() + 60
        while set(recording.parent.iterdir()) == before and time.monotonic() < deadline:
            time.sleep(0.05)
        time.sleep(0.5)
        process.send_signal(sent)
        _, text = process.communicate(timeout=60)
    assert process.returncode == 130
    assert text.strip().splitlines()[-1] == "barsight: interrupted; nothing half-written is left"
    assert "Traceback" not in text
    assert set(recording.parent.iterdir()) == before


def test_an_interrupt_inside_exec_keeps_its_exit_code(tmp_path: Path) -> None:
    """Python 3.11 ends `-m` by SIGINT where an interrupt has passed through `exec` of a string."""
    (tmp_path / "interrupted.py").write_text("""
import importlib, sys, types
from barsight.cli import main
importlib.import_module = lambda _: types.SimpleNamespace(run=lambda _: exec("raise KeyboardInterrupt"))
sys.argv = ["barsight", "info"]
main.main()
""")
    command = [sys.executable, "-m", "interrupted"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, cwd=tmp_path)
    assert done.returncode == 130
    assert done.stderr == "barsight: interrupted; nothing half-written is left\n"


def test_an_interrupt_inside_a_finalizer_is_raised_again(tmp_path: Path) -> None:
    """Python lets no exception out of `__del__`: it prints a traceback, and the run would go on."""
    (tmp_path / "finalized.py").write_text("""
import importlib, os, signal, sys, time, types
from barsight.cli import main
class Held:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.01)
def run(_):
    Held()
    time.sleep(10)
    print("went on")
importlib.import_module = lambda _: types.SimpleNamespace(run=run)
sys.argv = ["barsight", "info"]
main.main()
""")
    command = [sys.executable, "-m", "finalized"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, cwd=tmp_path)
    assert (done.returncode, done.stdout) == (130, "")
    assert done.stderr == "barsight: interrupted; nothing half-written is left\n"


def test_an_interrupt_that_a_library_hides_is_one_still(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Libraries in C that are just being loaded make an ImportError of it."""

    def load(_: str) -> None:
        with contextlib.suppress(KeyboardInterrupt):
            main._interrupt(signal.SIGINT, None)
        raise ImportError("initialization failed")

    handlers = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    monkeypatch.setattr("importlib.import_module", load)
    try:
        assert main.run(["measure", "x"]) == 130
    finally:
        for number, handler in zip((signal.SIGINT, signal.SIGTERM), handlers, strict=True):
            signal.signal(number, handler)
    assert "interrupted" in capsys.readouterr().err


def test_truth_is_never_read_by_a_measurement(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, _ = measure(recording, capsys)
    with_truth = (recording.parent / "out" / "contour.csv").read_bytes()
    shutil.rmtree(recording / "truth")
    shutil.rmtree(recording / "mav0" / "state_groundtruth_estimate0")
    again = recording.parent / "again"
    assert code == run(["measure", str(recording), "-o", str(again), *FAST]) == 0
    assert (again / "contour.csv").read_bytes() == with_truth


def test_a_bag_measures_to_the_same_bytes(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    measure(recording, capsys)
    bag, from_bag = recording.parent / "bag", recording.parent / "from_bag"
    assert run(["convert", str(recording), "-o", str(bag), "--to", "ros2-mcap"]) == 0
    assert run(["measure", str(bag), "-o", str(from_bag), *FAST]) == 0
    for name in ("contour.csv", "trajectory.tum", "cloud.ply", "height.tif"):
        assert (recording.parent / "out" / name).read_bytes() == (from_bag / name).read_bytes(), name


def test_a_stamp_that_no_clock_has(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = recording / "mav0" / "cam0" / "data.csv"
    edit(path, lambda rows: [*rows[:-1], "9" * 20 + "," + rows[-1].split(",")[1]])
    refused(recording, capsys, "cam0/data.csv", "line 5", "9" * 20)


def test_a_disk_that_fills_up_under_numpy(
    recording: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """NumPy's writer drops the system's error number."""

    def full(*_: object, **__: object) -> None:
        raise OSError("4096 requested and 0 written")

    monkeypatch.setattr("numpy.save", full)
    refused(recording, capsys, "could not be written completely", "out")


def test_folders_made_for_a_run_that_failed_are_gone(
    recording: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = sorted(recording.parent.iterdir())
    out = recording.parent / "new" / "newer" / "out"
    assert run(["measure", str(recording), "-o", str(out), *FAST, "--map.min-views", "99"]) == 5
    assert sorted(recording.parent.iterdir()) == before


def test_another_run_was_first(
    recording: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = recording.parent / "out"

    def meanwhile(*_: object) -> None:
        out.mkdir()
        (out / "result.json").write_text("theirs")

    monkeypatch.setattr("barsight.measure_folder.write_report", meanwhile)
    assert run(["measure", str(recording), "-o", str(out), *FAST]) == 4
    assert "not empty" in capsys.readouterr().err
    assert [path.name for path in out.iterdir()] == ["result.json"]
    assert (out / "result.json").read_text() == "theirs"


def test_stamps_that_a_bag_cannot_hold(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.rmtree(recording / "mav0" / "imu0")
    shutil.rmtree(recording / "mav0" / "crane0")
    for camera in ("cam0", "cam1"):
        path = recording / "mav0" / camera / "data.csv"
        edit(path, lambda rows: [rows[0], *(f"-{row}" for row in reversed(rows[1:]))])
    assert run(["convert", str(recording), "-o", str(recording.parent / "bag"), "--to", "ros2-mcap"]) == 3
    assert "can't be held by a ROS bag" in capsys.readouterr().err
    assert [path.name for path in recording.parent.iterdir()] == ["recording"]
