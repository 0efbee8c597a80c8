"""Files of fuzzing's finds, each once: a damaged file ends soon in one line that names it."""

import json
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fuzz.mutators import png_bomb, reseal_folder
from fuzz.seeds import write_kitti, write_results

from barsight.calibration.files.euroc import read_rig
from barsight.calibration.files.rig_file import write_rig_file
from barsight.cli.main import run
from barsight.core.errors import InputError
from barsight.core.reading.sealed_json import read_sealed
from barsight.recording.own_files import file_digests
from barsight.recording.pairing import pair_cameras
from barsight.result_folder import identify_map
from barsight.store.opening import open_store
from barsight.yard.inventory.bundle_file import read_bundles
from barsight.yard.magnet.description import example_magnet

MAX_CPU_S = 8.0
"""Twice what the slowest takes; a digest of 8 GiB takes longer."""
Damage = Callable[[Path], object]


def number(of: str, value: str) -> Damage:
    """Put a value in place of what the pattern finds first."""

    def damage(path: Path) -> None:
        text, count = re.subn(of, value, path.read_text(), count=1)
        assert count == 1
        path.write_text(text)

    return damage


def resealed(change: Callable[[dict[str, Any]], object]) -> Damage:
    """Change result.json and seal it again, as a program of another version might write it."""

    def damage(path: Path) -> None:
        result = json.loads(path.read_text())
        change(result)
        path.write_text(json.dumps(result))
        reseal_folder(path.parent)

    return damage


def without_digest(path: Path) -> None:
    """Leave out what older versions did not write; the identity holds."""
    result = json.loads(path.read_text())
    del result["files"]["laser.csv"]
    path.write_text(json.dumps(result | {"map_id": identify_map(result).map_id}))


def then_sealed(damage: Damage) -> Damage:
    """Seal a result's folder again after one of its files was damaged."""

    def damaged(path: Path) -> None:
        damage(path)
        reseal_folder(path.parent)

    return damaged


def link_to_itself(path: Path) -> None:
    path.unlink()
    path.symlink_to(path.name)


def sparse(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(1 << 33)


def link_out(path: Path) -> None:
    """Put the same file elsewhere and a link in its place."""
    recording = next(parent for parent in path.parents if parent.parent.name == "F")
    path.symlink_to(path.rename(recording.with_name("elsewhere")))


def repeated(unit: bytes, times: int) -> Damage:
    """Put so many equal pieces in the file's place."""
    return lambda path: path.write_bytes(unit * times)


def profiles(path: Path) -> None:
    """Give each row a profile of its own."""
    rows = "1.0,0.1,0.1,0.1,1" if path.name == "contour.csv" else "1.0,0.1,0.1"
    lines = [path.read_text().partition("\n")[0], *(f"{number},{rows}" for number in range(200_000))]
    path.write_text("\n".join(lines) + "\n")


def bomb(path: Path) -> None:
    path.write_bytes(png_bomb(9000, 9000))


A_NUMBER = r"-?\d+\.\d+(e[-+]\d+)?"
EXPORT = "calibrate export F/rig.xml -o F/made.yaml --to kalibr"
OPENCV = "calibrate export F/opencv.yaml -o F/made.yaml --to kalibr"
FOUND: list[tuple[str, Damage, str, str]] = [
    ("mcap/mcap.mcap", link_to_itself, "info F/mcap", "mcap.mcap: can't be read"),
    ("one.bag", sparse, "info F/one.bag", "is not a ROS 1 bag"),
    (
        "mcap/metadata.yaml", number(r"(?<=  - message_count: )\d+", "[]"),
        "info F/mcap", "no whole number",
    ),
    ("out/result.json", resealed(lambda of: of.pop("warnings")), "report F/out", "lacks what the report"),
    (
        "out/result.json", resealed(lambda result: result["map"].update(median_sigma_m={})),
        "report F/out", "median_sigma_m",
    ),
    ("kitti/calib.txt", number("-150", "1e300"), "info F/kitti", "line 2: expected 12 numbers in range"),
    ("kitti/calib.txt", number("312.5", "5e-324"), "info F/kitti", "the focal lengths 5e-324"),
    ("euroc/mav0/imu0/sensor.yaml", number(A_NUMBER, "-1e308"), "info F/euroc", "out of range"),
    ("euroc/mav0/imu0/data.csv", number(f",{A_NUMBER}", ",1e300"), "info F/euroc", "line 2: a value is NaN"),
    ("targets.csv", number(A_NUMBER, "-1e308"), "calibrate yard F/targets.csv -o F/made.yaml", "line 2: a"),
    (
        "targets.csv", number(r"0\.5", "a" * 140_000), "calibrate yard F/targets.csv -o F/made.yaml",
        "can't be read (field larger",
    ),
    ("rig.xml", number(r"(?<=<data>)\s*\S+", "-1e308"), EXPORT, "range"),
    ("opencv.yaml", number("data: ", "data: " + "[" * 100_000), OPENCV, "over 64 deep"),
    ("opencv.yaml", number("data: ", "x: " + "- " * 100_000), OPENCV, "over 64 deep"),
    ("rig.xml", number("<data>", "<data>" + "<a>" * 100_000), EXPORT, "over 64 deep"),
    ("out/preview.png", bomb, "report F/out", "at most"),
    ("out/preview.png", sparse, "report F/out", "at most"),
    ("out/ortho.png", bomb, "report F/out", "at most"),
    ("out/trajectory.tum", then_sealed(number(r" \S+", " 1e999990")), "report F/out", "pose 1: its numbers"),
    ("out/trajectory.tum", then_sealed(number(r"(?m)(?<= )\S+$", "5")), "report F/out", "pose 1: its quat"),
    ("out/laser.csv", then_sealed(number(A_NUMBER, "1e999990")), "report F/out", "out of range"),
    ("out/laser.csv", then_sealed(number(A_NUMBER, "nan")), "report F/out", "laser.csv: holds a number out"),
    ("out/contour.csv", then_sealed(number(A_NUMBER, "nan")), "report F/out", "contour.csv: holds a number"),
    ("out/laser.csv", then_sealed(number(A_NUMBER, "x")), "report F/out", "laser.csv: is damaged"),
    ("out/contour.csv", number(A_NUMBER, "7"), "report F/out", "is not the one that result.json was written"),
    ("out/trajectory.tum", number(A_NUMBER, "7"), "lifts F/out", "is not the one that result.json was wr"),
    ("out/contour.csv", sparse, "report F/out", "at most"),
    ("out/result.json", without_digest, "report F/out", "has no digest of laser.csv"),
    ("euroc/mav0/crane0/sensor.yaml", link_out, "info F/euroc", "is a link out of the recording"),
    ("euroc/mav0/cam1/data.csv", link_out, "convert F/euroc -o F/made --to ros1", "is a link out of the rec"),
    ("kitti/times.txt", link_out, "info F/kitti", "is a link out of the recording"),
    ("mcap/crane0.yaml", link_out, "convert F/mcap -o F/made --to euroc", "is a link out of the recording"),
    ("mcap/camchain-imucam.yaml", link_out, "convert F/mcap -o F/made --to euroc", "is a link out of its"),
    ("euroc/mav0/cam0/data.csv", number(r"(?m)\d(?=\.png)", "<" * 3000), "info F/euroc", "is too long for a"),
    (
        "euroc/mav0/cam0/data.csv", number(r"(?m)\d(?=\.png)", "<" * 3000),
        "convert F/euroc -o F/made --to ros1", "line 2: '17",
    ),
    ("euroc/mav0/cam0/data.csv", repeated(b"1,a\n", 7_000_000), "info F/euroc", "has over 500000 lines"),
    ("euroc/mav0/imu0/data.csv", repeated(b"\n", 29_000_000), "info F/euroc", "has over 4000000 lines"),
    ("euroc/mav0/imu0/data.csv", repeated(b"1", 29_000_000), "info F/euroc", "has a line of over"),
    ("out/contour.csv", then_sealed(profiles), "report F/out", "holds 200000 profiles, at most 5000"),
    ("euroc/mav0/laser0/data.csv", profiles, "measure F/euroc -o F/made", "has 200000 profiles, at most"),
    ("out/bundles.json", repeated(b"[],", 10_000_000), "lifts F/out", "over 4000000 values"),
    ("out/height.tif", sparse, "explain F/out 1", "is damaged"),
    ("out/tops.tif", sparse, "export F/out F/made.las", "is damaged"),
    ("out/cloud.ply", sparse, "store add sqlite:///F/yard.db F/out", "cloud.ply"),
]  # fmt: skip


@pytest.fixture(scope="module")
def seeds(whole: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("seeds")
    shutil.copytree(whole, folder / "euroc")
    assert run(["convert", str(whole), "-o", str(folder / "mcap"), "--to", "ros2-mcap"]) == 0
    write_kitti(folder / "kitti", whole)
    write_rig_file(folder / "rig.yaml", read_rig(whole / "mav0"))
    for name in ("rig.xml", "opencv.yaml"):
        words = [str(folder / "rig.yaml"), "-o", str(folder / name), "--to", "opencv"]
        assert run(["calibrate", "export", *words]) == 0
    rows = [f"T{k},{k}.5,{k * k}.5,1.0,{k}.0,{k * k}.0,0.5" for k in range(4)]
    (folder / "targets.csv").write_text("name,yard_x,yard_y,yard_z,x,y,z\n" + "\n".join(rows) + "\n")
    (folder / "one.bag").touch()
    write_results(folder / "out", 0.0)
    (folder / "magnet.toml").write_text(example_magnet(), encoding="utf-8")
    return folder


@pytest.mark.parametrize(("name", "damage", "command", "says"), FOUND)
def test_what_was_found_stays_mended(
    seeds: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str],
    name: str, damage: Damage, command: str, says: str,
) -> None:  # fmt: skip
    folder = tmp_path / "F"
    folder.mkdir()
    for path in seeds.iterdir():
        if path.is_dir() and name.startswith(f"{path.name}/"):
            shutil.copytree(path, folder / path.name)
        elif path.is_file():
            shutil.copy(path, folder)
    damage(folder / name)
    before = sorted(folder.rglob("*"))
    began = time.process_time()
    assert run([word.replace("F/", f"{folder}/") for word in command.split()]) == 3
    assert time.process_time() - began < MAX_CPU_S
    told = capsys.readouterr().err
    assert told.count("\n") == 1 and says in told and "Traceback" not in told
    assert sorted(folder.rglob("*")) == before


def test_a_camera_without_pictures_is_said() -> None:
    some = np.arange(3, dtype=np.int64)
    for left, right, name in ((some[:0], some, "cam0"), (some, some[:0], "cam1")):
        with pytest.raises(InputError, match=f"holds no picture of {name}"):
            pair_cameras(Path("bag"), left, right, 0.01)


@pytest.mark.parametrize("suffix", ["yaml", "xml"])
def test_a_full_disk_leaves_no_cut_opencv_file(seeds: Path, tmp_path: Path, suffix: str) -> None:
    """OpenCV's own writer passes over what the system refuses."""
    code = (
        "import resource, signal, sys; from barsight.cli.main import run; "
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN); "
        "resource.setrlimit(resource.RLIMIT_FSIZE, (600, 600)); "
        "sys.exit(run(['calibrate', 'export', sys.argv[1], '-o', sys.argv[2], '--to', 'opencv']))"
    )
    command = [sys.executable, "-c", code, str(seeds / "rig.yaml"), str(tmp_path / f"made.{suffix}")]
    done = subprocess.run(command, stderr=subprocess.PIPE, text=True, timeout=120)
    assert done.returncode == 4 and done.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_a_store_whose_schema_is_no_text_is_refused(tmp_path: Path) -> None:
    """Python can't decode SQLite's own message about it."""
    url = f"sqlite:///{tmp_path}/s.db"
    with open_store(url, create=True):
        pass
    data = (tmp_path / "s.db").read_bytes()
    assert data.count(b"CREATE TABLE surveys") == 1
    (tmp_path / "s.db").write_bytes(data.replace(b"CREATE TABLE surveys", b"CREATE \xe5ABLE surveys"))
    with pytest.raises(InputError, match=r"s\.db: is damaged"), open_store(url):
        pass


def test_a_file_that_grew_is_told_before_it_is_hashed(tmp_path: Path) -> None:
    sparse(tmp_path / "body.yaml")
    (tmp_path / "a.bag").write_bytes(b"bag")
    began = time.process_time()
    with pytest.raises(InputError, match=r"body\.yaml: has 8589934592 bytes"):
        file_digests(tmp_path, [tmp_path / "body.yaml"], [tmp_path / "a.bag"])
    assert time.process_time() - began < 1.0


def test_a_version_that_is_no_number_is_told_without_its_control_characters(tmp_path: Path) -> None:
    (tmp_path / "watch.json").write_text(json.dumps({"schema_version": "\x1b[31mred" * 100}))
    with pytest.raises(InputError, match=r"has schema version '\\x1b\[31m.{,40} instead of 1") as caught:
        read_sealed(tmp_path / "watch.json", 1, "take another")
    assert str(caught.value).isprintable() and len(caught.value.problem) < 100


def test_a_bundle_further_than_any_number_goes_is_refused(tmp_path: Path) -> None:
    write_results(tmp_path / "out", 0.0)
    path = tmp_path / "out/bundles.json"
    content = json.loads(path.read_text())
    content["bundles"][0]["axis_centre_m"][0] = 10**19
    path.write_text(json.dumps(content))
    reseal_folder(tmp_path / "out")
    with pytest.raises(InputError, match="a number is out of range"):
        read_bundles(path)
