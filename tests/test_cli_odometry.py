"""`barsight odometry`: what it writes, and sensors that mislead it."""

import json
import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from barsight.cli.main import run
from barsight.recording.formats.ground_truth import EUROC_FOLDER
from contradicting_inputs import swapped_pictures

PITCH_M = 0.09
"""A bar of the development yard."""


def test_what_is_written(whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "a [b] c"
    assert run(["odometry", str(whole), "-o", str(out), "--use", "stereo,imu,crane"]) == 0
    assert "placed in yard" in capsys.readouterr().out
    assert sorted(path.name for path in out.iterdir()) == [
        "odometry.json", "relative.csv", "report.html", "trajectory.tum",
    ]  # fmt: skip
    header, *rows = (out / "relative.csv").read_text().splitlines()
    table = np.array([row.split(",") for row in rows], np.float64)
    assert table.shape == (3, header.count(",") + 1) == (3, 30)
    assert (table[:, [9, 15, 20, 24, 27, 29]] > 0).all()  # variances
    page = (out / "report.html").read_text()
    body = page.partition("<script>")[0]
    assert 'src="http' not in body and 'href="http' not in body
    for section in ("path", "truth", "sigma", "states", "innovations", "matches", "refused"):
        assert f'<section id="{section}">' in page
    for picture in ("features", "raw", "filtered", "guided", "enlarged"):
        assert f'<figure id="{picture}">' in page
    data = json.loads((out / "odometry.json").read_text())
    assert len(data["frames"]) + len(data["refused"]) == data["frames_total"] == 4
    assert data["sensors"] == ["crane", "imu", "stereo"]
    frame = data["frames"][0]
    assert np.array(frame["covariance"]).shape == (6, 6)
    assert (np.array(frame["velocity_sigma_mps"]) > 0).all()
    assert set(data["residuals_in_sigma"]) == {"pictures", "imu", "encoders", "innovations"}
    assert all(max(part["rms"]) < 3 for part in data["residuals_in_sigma"].values())
    assert data["drift"]["reference_rmse_mm"] < 20
    assert run(["odometry", str(whole), "-o", str(out), "--use=stereo"]) == 0
    data = json.loads((out / "odometry.json").read_text())
    assert data["reference"] == "world" and "velocity_mps" not in data["frames"][0]


@pytest.mark.parametrize("estimator", ["fused", "live", "odometry"])
def test_swapped_pictures_are_named(
    recording: Path, estimator: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """They were blamed on too little texture; the encoders placed all frames."""
    swapped_pictures(recording / "mav0")
    assert run(["odometry", str(recording), "--estimator", estimator]) != 0
    told = capsys.readouterr()
    assert "left and right images are swapped" in told.err and "placed" not in told.out
    assert run(["odometry", str(recording), "--use", "imu", "crane"]) == 0


def test_a_truth_that_cant_be_read_is_named_before_the_work(
    recording: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """An hour's estimate was lost at the end."""
    monkeypatch.setattr("barsight.cli.odometry.make_estimator", lambda _: pytest.fail("estimated first"))
    with (recording / "mav0" / EUROC_FOLDER / "data.csv").open("a", encoding="utf-8") as file:
        file.write("1,0,0,0,1,0,0,0\n")
    assert run(["odometry", str(recording)]) == 3
    assert "goes back in time" in capsys.readouterr().err


def test_a_measured_folder_is_left_alone(
    whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "result.json").touch()
    assert run(["odometry", str(whole), "-o", str(tmp_path)]) == 4
    assert "name another folder" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["result.json"]


@pytest.mark.parametrize(("out", "why"), [("mav0/out", "lies in the recording"), ("a_file", "is a file")])
def test_an_out_that_can_not_be_is_refused_at_once(
    recording: Path, capsys: pytest.CaptureFixture[str], out: str, why: str
) -> None:
    (recording.parent / "a_file").touch()
    target = recording / out if "/" in out else recording.parent / out
    assert run(["odometry", str(recording), "-o", str(target)]) == 4
    assert f"{target}: {why}" in capsys.readouterr().err
    assert not target.is_dir()


@pytest.fixture(scope="module")
def development_yard(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return Path(shutil.copytree(data / "yard_dev", tmp_path_factory.mktemp("development") / "yard"))


@pytest.fixture
def yard(development_yard: Path, tmp_path: Path) -> Path:
    """The development yard, its pictures linked and its tables open to change."""
    source, copy = development_yard, tmp_path / "yard"
    for folder, _, names in os.walk(source / "mav0"):
        to = copy / Path(folder).relative_to(source)
        to.mkdir(parents=True)
        for name in names:
            if name.endswith(".png"):
                os.link(Path(folder) / name, to / name)
            else:
                shutil.copyfile(Path(folder) / name, to / name)
    return copy


def change(yard: Path, sensor: str, edit: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> None:
    """edit: stamps (N,) in s since the first and values (N, C) to new values, NaN first to drop a row."""
    path = yard / "mav0" / sensor / "data.csv"
    header, *rows = path.read_text().splitlines()
    stamps = np.array([int(row.split(",")[0]) for row in rows])
    values = edit((stamps - stamps[0]) / 1e9, np.array([row.split(",")[1:] for row in rows], float))
    lines = [
        ",".join([str(stamp), *map(repr, row)])
        for stamp, row in zip(stamps.tolist(), values.tolist(), strict=True) if row[0] == row[0]
    ]  # fmt: skip
    path.write_text("\n".join([header, *lines]) + "\n")


def figures(text: str) -> tuple[float, float]:
    """mm and degrees in the yard."""
    line = next(line for line in text.splitlines() if line.startswith("in the yard"))
    return float(line.split()[3]), float(line.split()[5])


def test_encoders_off_by_a_bar_and_a_torn_imu(yard: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """From 12 s on the encoders, and with them all predictions, are one bar further; the IMU stands at the
    end of its scale for 0.1 s and is silent for 0.3 s.
    """

    def jump(time: np.ndarray, place: np.ndarray) -> np.ndarray:
        return place + np.where(time >= 12, PITCH_M, 0)[:, None] * [1, 0, 0]

    def tear(time: np.ndarray, values: np.ndarray) -> np.ndarray:
        values[(time > 5) & (time < 5.1), 3] = 39.2
        values[(time > 7) & (time < 7.3)] = np.nan
        return values

    change(yard, "crane0", jump)
    change(yard, "imu0", tear)
    assert run(["odometry", str(yard)]) == 0
    text = capsys.readouterr().out
    told = r"the bridge's encoder jumps by (8[5-9]|9[0-5])\.\d mm \(1 sigma \d+\.\d mm\) at (11\.9|12\.\d) s"
    assert re.search(told, text.replace("\n", " "))
    assert "19 IMU samples are at the end of their scale" in text
    mm, deg = figures(text)
    assert mm < 1 and deg < 0.05


@pytest.mark.parametrize(
    ("sensor", "scale", "words"),
    [("imu0", [180 / np.pi] * 3 + [1] * 3, "degrees/s"), ("imu0", [1] * 3 + [1 / 9.80665] * 3, "in g")],
)
def test_wrong_units_are_refused(
    yard: Path, capsys: pytest.CaptureFixture[str], sensor: str, scale: list[float], words: str
) -> None:
    change(yard, sensor, lambda time, values: values * scale)
    assert run(["odometry", str(yard), "-o", str(yard.parent / "out")]) == 3
    error = capsys.readouterr().err
    assert words in error and error.count("\n") == 1
    assert not (yard.parent / "out").exists()


@pytest.mark.parametrize("frames", [7, 18])
def test_stamps_off_by_a_frame_are_found(yard: Path, capsys: pytest.CaptureFixture[str], frames: int) -> None:
    for camera in ("cam0", "cam1"):
        path = yard / "mav0" / camera / "data.csv"
        header, *rows = path.read_text().splitlines()
        stamps, names = zip(*(row.split(",") for row in rows), strict=True)
        moved = [f"{stamp},{name}" for stamp, name in zip(stamps[1:], names[:-1], strict=True)][-frames:]
        path.write_text("\n".join([header, *moved]) + "\n")
    assert run(["odometry", str(yard)]) == 3
    assert "1 frame(s) late against gyro and encoders" in capsys.readouterr().err
