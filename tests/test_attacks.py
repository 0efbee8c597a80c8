"""Attacks that were mended, each once: one line and an exit code, no hang, nothing taken from elsewhere."""

import fcntl
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from fuzz.mutators import png_bomb

from barsight.calibration.files.yaml_document import read_document
from barsight.cli.main import run
from barsight.core.errors import CalibrationError, ConfigError, InputError, OutputError
from barsight.core.files import atomic_directory, atomic_path, atomic_paths, changed_folder
from barsight.core.printing import printable
from barsight.core.reading.bounded_reading import read_arrays, read_json, read_text, read_toml
from barsight.core.records.gray_levels import TornImageError
from barsight.core.stamps import parse_seconds
from barsight.recording.image_decoding import decode_gray
from barsight.recording.open import open_recording
from barsight.yard.magnet.description import example_magnet, load_magnet
from recording_samples import write_euroc


def bomb(merged: bool) -> str:
    lines = ["a0: &a0 {x: 1}" if merged else "a0: &a0 [1, 1]"]
    for k in range(1, 30):
        inner = ", ".join([f"*a{k - 1}"] * 9)
        lines.append(f"a{k}: &a{k} {{<<: [{inner}]}}" if merged else f"a{k}: &a{k} [{inner}]")
    return "\n".join(lines)


MANY_KEYS = "".join(f"k{k}: 1\n" for k in range(30_000))
HOSTILE_YAML = [
    bomb(False), bomb(True), "a: &a [*a]", "[" * 3000, "a: 2001-99-99", f"a: {'9' * 400}", f"a: {'9' * 5000}",
    "? [1]\n: !!int x", "a: !!python/object/apply:os.system [exit]", MANY_KEYS,
]  # fmt: skip
HOSTILE_JSON = ["[" * 3000, "9" * 400, '{"a": NaN}', '{"a": ' * 100 + "1" + "}" * 100, "\ufeff{"]


@pytest.mark.parametrize("text", HOSTILE_YAML)
def test_yaml_of_any_kind_is_refused_at_once(tmp_path: Path, text: str) -> None:
    path = tmp_path / "sensor.yaml"
    path.write_text(text)
    began = time.process_time()
    with pytest.raises(CalibrationError, match=r"sensor\.yaml") as told:
        read_document(path)
    assert "\n" not in str(told.value) and time.process_time() - began < 8


@pytest.mark.parametrize("text", HOSTILE_JSON)
def test_json_of_any_kind_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "x.json"
    path.write_text(text)
    with pytest.raises(InputError, match=r"x\.json: is not a JSON"):
        read_json(path)


def test_numbers_that_no_float_holds(tmp_path: Path) -> None:
    path = tmp_path / "magnet.toml"
    for number in ("9" * 400, "9" * 25, "1e999", "nan"):
        path.write_text(example_magnet().replace("own_mass_kg = ", f"own_mass_kg = {number} #", 1))
        with pytest.raises((InputError, ConfigError), match=r"magnet\.toml"):
            load_magnet(path)
    path.write_text("a = " + "[" * 3000)
    with pytest.raises(InputError, match="deep"):
        read_toml(path)


def test_a_pipe_a_device_and_a_huge_file_are_not_read(tmp_path: Path) -> None:
    pipe, device, huge = tmp_path / "pipe", tmp_path / "zero", tmp_path / "huge"
    os.mkfifo(pipe)
    device.symlink_to("/dev/zero")
    with huge.open("wb") as file:
        file.truncate(1 << 34)
    for path, says in ((pipe, "a pipe or a device"), (device, "a pipe or a device"), (huge, "at most")):
        for read in (read_text, read_json, read_arrays):
            with pytest.raises(InputError, match=says):
                read(path)  # type: ignore[operator]


def test_a_time_with_a_large_exponent_is_none() -> None:
    for text in ("1e999990", "-1e20", "nan", "9" * 400):
        with pytest.raises(ValueError, match="not a time"):
            parse_seconds(text)


def test_a_bomb_is_refused_by_its_header() -> None:
    data = png_bomb(9000, 9000)
    for size, says in ((None, "at most"), ((640, 480), "calibration is for")):
        with pytest.raises(TornImageError, match=says):
            decode_gray(data, size)


@pytest.mark.parametrize("name", ["../../../secret.png", "/etc/passwd", "..", "a\x1b[31m.png"])
def test_names_stay_in_the_recording(tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    recording = write_euroc(tmp_path / "recording")
    path = recording / "mav0" / "cam0" / "data.csv"
    head, first, *others = path.read_text().splitlines()
    path.write_text("\n".join([head, f"{first.split(',')[0]},{name}", *others]))
    assert run(["convert", str(recording), "-o", str(tmp_path / "out"), "--to", "euroc"]) == 3
    told = capsys.readouterr().err
    assert "leads out of the recording" in told and "\x1b" not in told and not (tmp_path / "out").exists()


def test_links_out_of_a_recording_are_not_followed(tmp_path: Path) -> None:
    recording = write_euroc(tmp_path / "recording")
    secret = tmp_path / "secret.png"
    picture = min((recording / "mav0" / "cam0" / "data").iterdir())
    secret.write_bytes(picture.read_bytes())
    picture.unlink()
    picture.symlink_to(secret)
    assert "is a link out of the recording" in str(next(iter(open_recording(recording).frames())))
    assert len(list(open_recording(recording).stored_images())) == 5
    # A recording that is a link itself is the user's own doing.
    (tmp_path / "link").symlink_to(recording)
    assert len(list(open_recording(tmp_path / "link").stored_images())) == 5


def test_nothing_printed_gives_a_terminal_orders(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert printable("a\x1b[31mb\u202ec\udc80\n") == "a?[31mb?c?\n"
    assert run(["info", str(tmp_path / "\x1b]0;owned\x07")]) == 3
    assert "\x1b" not in capsys.readouterr().err


def killed_in(target: Path, how: str) -> None:
    """A process that is killed while it writes `target`."""
    code = (
        "import os, sys; from pathlib import Path; from barsight.core.files import *\n"
        f"with {how}(Path(sys.argv[1])) as path:\n"
        "    (path / 'half' if path.is_dir() else path).write_text('half'); os.kill(os.getpid(), 9)\n"
    )
    subprocess.run([sys.executable, "-c", code, str(target)], timeout=60)


@pytest.mark.parametrize("write", [atomic_path, atomic_directory])
def test_what_a_killed_run_left_is_gone_after_the_next(tmp_path: Path, write: Callable[..., object]) -> None:
    target = tmp_path / "out"
    killed_in(target, write.__name__)
    assert [path.name for path in tmp_path.iterdir()] == [".out.part"]
    with write(target) as path:  # type: ignore[attr-defined]
        assert path.name == "out" or list(path.iterdir()) == []
        (path / "x" if path.is_dir() else path).write_text("whole")
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_runs_at_the_same_time_and_others_folders_are_left_alone(tmp_path: Path) -> None:
    with atomic_path(tmp_path / "out") as first, atomic_path(tmp_path / "out") as second:
        assert first.parent != second.parent
        first.write_text("first")
        second.write_text("second")
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "mine").write_text("keep")
    (tmp_path / ".out.part").symlink_to(tmp_path / "elsewhere")
    with atomic_path(tmp_path / "out") as path:
        path.write_text("third")
    assert (tmp_path / "elsewhere" / "mine").read_text() == "keep"
    (tmp_path / ".out.part").unlink()
    (tmp_path / ".out.part").mkdir()
    held = os.open(tmp_path / ".out.part", os.O_RDONLY)
    fcntl.flock(held, fcntl.LOCK_EX)
    with atomic_path(tmp_path / "out") as path:
        assert path.parent.name == ".out.2.part"
        path.write_text("fourth")
    os.close(held)


def test_several_files_appear_together_or_not_at_all(tmp_path: Path) -> None:
    targets = (tmp_path / "a.yaml", tmp_path / "a.html")
    with pytest.raises(ZeroDivisionError), atomic_paths(*targets) as (first, _):
        first.write_text("half")
        raise ZeroDivisionError
    assert list(tmp_path.iterdir()) == []
    folder = tmp_path / "out"
    folder.mkdir()
    (folder / "kept").write_text("old")
    with pytest.raises(InputError, match="out/kept: wrong"), changed_folder(folder) as staging:
        (staging / "new").write_text("half")
        raise InputError(staging / "kept", "wrong")
    assert [path.name for path in folder.iterdir()] == ["kept"]
    with changed_folder(folder) as staging:
        (staging / "new").write_text("whole")
    assert sorted(path.name for path in folder.iterdir()) == ["kept", "new"]
    assert not (folder / "kept").is_symlink() and (folder / "kept").read_text() == "old"


def test_several_files_are_moved_one_after_the_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing comes between that a kill could meet for long; the result itself is the last."""
    done: list[str] = []
    real = Path.replace
    monkeypatch.setattr(Path, "replace", lambda one, to: (done.append(Path(to).name), real(one, to))[1])
    for name in ("unlink", "rmdir"):
        old = getattr(Path, name)
        monkeypatch.setattr(
            Path, name, lambda one, *a, old=old, name=name, **k: (done.append(name), old(one, *a, **k))[1]
        )  # fmt: skip
    with atomic_paths(tmp_path / "a.yaml", tmp_path / "a.html", tmp_path / "a.json") as paths:
        for path in paths:
            path.write_text(path.name)
        done.clear()
    assert done[:3] == ["a.json", "a.html", "a.yaml"]
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {name: name for name in done[:3]}


@pytest.mark.parametrize("moves", range(4))
def test_a_kill_while_files_are_replaced_leaves_no_mixed_folder_that_looks_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, moves: int
) -> None:
    names = ("contour.csv", "height.tif", "report.html", "result.json")
    for name in (*names, "laser.csv", "mine.txt"):
        (tmp_path / name).write_text("old")
    whole, done = Path.replace, list[Path]()

    def counted(source: Path, to: Path) -> Path:
        if len(done) == moves:
            raise KeyboardInterrupt  # as a kill would end it here
        done.append(to)
        return whole(source, to)

    monkeypatch.setattr(Path, "replace", counted)
    with (
        pytest.raises(KeyboardInterrupt),
        atomic_directory(tmp_path, replace=True, owned=("laser.csv",)) as staging,
    ):
        for name in names:
            (staging / name).write_text("new")
    assert not (tmp_path / "result.json").exists() and not (tmp_path / "laser.csv").exists()
    assert (tmp_path / "report.html").exists() == (moves == 3)
    assert (tmp_path / "mine.txt").read_text() == "old"


def test_closed_standard_streams_are_no_fault_and_take_nothing(tmp_path: Path) -> None:
    """Without a stand-in the first file opened would become the standard output."""
    for closed in (">&-", "<&-", "2>&-"):
        command = f"{sys.executable} -m barsight calibrate board --board checkerboard:4x3:0.03 -o board.png"
        done = subprocess.run(f"{command} --dpi 30 {closed}", shell=True, cwd=tmp_path, timeout=120)
        assert done.returncode == 0
        picture = (tmp_path / "board.png").read_bytes()
        assert picture.startswith(b"\x89PNG") and picture[-8:-4] == b"IEND"


def test_a_device_is_no_output(tmp_path: Path) -> None:
    (tmp_path / "x.csv").symlink_to("/dev/null")
    with pytest.raises(OutputError, match="a pipe or a device"), atomic_path(tmp_path / "x.csv"):
        pass


def test_a_reader_that_is_gone_and_a_full_disk() -> None:
    command = [sys.executable, "-m", "barsight", "--help"]
    with open("/dev/full", "w") as full:  # noqa: PTH123
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, timeout=120)
    assert done.returncode == 1 and done.stderr.count("\n") == 1
    read, write = os.pipe()
    os.close(read)
    done = subprocess.run(command, stdout=write, stderr=subprocess.PIPE, text=True, timeout=120)
    os.close(write)
    assert (done.returncode, done.stderr) == (1, "")


def test_the_command_line_needs_no_home(tmp_path: Path) -> None:
    recording = write_euroc(tmp_path / "recording")
    shutil.rmtree(recording / "mav0" / "laser0")
    env = {k: v for k, v in os.environ.items() if k != "HOME"}
    command = [sys.executable, "-m", "barsight", "info", str(recording)]
    done = subprocess.run(command, env=env, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
