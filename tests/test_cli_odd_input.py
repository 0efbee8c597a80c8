"""Odd recordings, odd names and odd surroundings that are nobody's mistake: `barsight` copes with them."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from barsight.cli.main import run
from cli_runs import FAST, pictures


def measured(recording: Path, *flags: str) -> tuple[Path, dict]:
    out = recording.parent / "out"
    assert run(["measure", str(recording), "-o", str(out), *FAST, *flags]) == 0
    return out, json.loads((out / "result.json").read_text())


def keep_rows(recording: Path, count: int, *sensors: str) -> None:
    for sensor in sensors:
        path = recording / "mav0" / sensor / "data.csv"
        path.write_text("\n".join(path.read_text().splitlines()[: count + 1]) + "\n")


def contour_table(out: Path) -> np.ndarray:
    return np.genfromtxt(out / "contour.csv", delimiter=",", names=True)


def codes(result: dict) -> set[str]:
    return {warning["code"] for warning in result["warnings"]}


@pytest.mark.parametrize("name", ["sp ace ü [bold] x", "a[/y]z", "100 % {a} $x"])
def test_names_with_brackets_spaces_and_other_letters(
    whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    folder = tmp_path / name
    folder.mkdir(parents=True)
    recording = Path(shutil.copytree(whole, folder / "recording"))
    out, _ = measured(recording)
    assert f"report: {out / 'report.html'}" in capsys.readouterr().err
    assert run(["report", str(out)]) == 0
    assert f"report: {out / 'report.html'}" in capsys.readouterr().err
    assert run(["convert", str(recording), "-o", str(folder / "bag"), "--to", "ros2-mcap"]) == 0
    assert str(folder / "bag") in capsys.readouterr().err
    assert run(["info", str(recording)]) == 0


def test_a_name_that_is_no_text(recording: Path) -> None:
    out, result = measured(recording)
    result["recording"]["path"] = "no\udcfftext"
    (out / "result.json").write_text(json.dumps(result))
    assert run(["report", str(out)]) == 0
    assert "no?text" in (out / "report.html").read_text()


def test_a_single_frame_says_that_nothing_confirms_it(recording: Path) -> None:
    keep_rows(recording, 1, "cam0", "cam1")
    out, result = measured(recording)
    assert result["frames"]["used"] == result["frames"]["total"] == 1
    assert "one-view" in codes(result)
    assert len((out / "trajectory.tum").read_text().splitlines()) == 3


def test_unpaired_pictures_count_as_frames(recording: Path) -> None:
    keep_rows(recording, 3, "cam1")
    _, result = measured(recording)
    assert result["frames"]["total"] == 4 and result["frames"]["used"] == 3
    (told,) = [w["message"] for w in result["warnings"] if w["code"] == "frames-refused"]
    assert told.startswith("1 of 4 frames were refused; first: ")


@pytest.mark.parametrize(
    ("cameras", "estimator"), [(("cam0", "cam1"), "fused"), (("cam1",), "fused"), (("cam0", "cam1"), "live")]
)
def test_pictures_of_a_frozen_camera_are_mapped_nowhere(
    cameras: tuple[str, ...], estimator: str, recording: Path
) -> None:
    """They were mapped where the encoders were by then, and of half of the pictures the mounting was blamed
    that the encoders contradicted.
    """
    for camera in cameras:
        first, *later = pictures(recording, camera)
        for path in later[:2]:
            shutil.copy(first, path)
    _, result = measured(recording, "--motion.estimator", estimator)
    assert result["frames"]["used"] == 2
    assert [frame["stage"] for frame in result["frames"]["refused"]] == ["trajectory"] * 2
    (told,) = [w["message"] for w in result["warnings"] if w["code"] == "frames-refused"]
    frozen = f"the same picture comes again and again from {' and '.join(cameras)} while the crane moves"
    assert told == f"2 of 4 frames were refused; most often (2): {frozen}"


def test_an_old_picture_is_mapped_nowhere_where_only_one_frame_is_left(recording: Path) -> None:
    """The encoders placed it, since no graph is estimated then."""
    keep_rows(recording, 2, "cam0", "cam1")
    for camera in ("cam0", "cam1"):
        first, second, *_ = pictures(recording, camera)
        shutil.copy(first, second)
    _, result = measured(recording)
    assert result["frames"]["used"] == 1
    (told,) = [w["message"] for w in result["warnings"] if w["code"] == "frames-refused"]
    assert told.startswith("1 of 2 frames were refused; first: the same picture comes again and again")


def test_a_bayer_mosaic_taken_as_gray_is_named(recording: Path) -> None:
    for path in pictures(recording, "cam1"):
        picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        picture[::2, ::2] = picture[::2, ::2] * 0.7
        cv2.imwrite(str(path), picture)
    _, result = measured(recording)
    (told,) = [w["message"] for w in result["warnings"] if "Bayer" in w["message"]]
    assert told.startswith("the gray pictures of cam1 look like a Bayer mosaic: ")


def test_each_frame_is_used_refused_or_passed_over(
    recording: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    keep_rows(recording, 3, "cam1")
    _, result = measured(recording, "--map.min-shift", "0.5")
    frames = result["frames"]
    assert frames["used"] + len(frames["refused"]) + frames["passed_over"]["count"] == frames["total"] == 4
    assert frames["passed_over"]["count"] and "24 px" in frames["passed_over"]["reason"]
    assert f"({frames['passed_over']['count']} had hardly moved)" in " ".join(capsys.readouterr().err.split())


def test_the_laser_is_compared_in_the_yard_only(recording: Path) -> None:
    shutil.rmtree(recording / "mav0" / "crane0")
    out, result = measured(recording)
    assert result["reference"] == "world"
    assert result["agreement"] == [] and "laser-frame" in codes(result)
    assert not (out / "laser.csv").exists()
    assert np.unique(contour_table(out)["profile"]).size == 1


def test_contours_elsewhere_are_not_held_against_the_laser(recording: Path) -> None:
    _, whole_result = measured(recording)
    out, result = measured(recording, "--overwrite", "--map.profile-y-m", "0.2", "-1.15", "40")
    y = dict(zip(*(contour_table(out)[k] for k in ("profile", "y_m")), strict=True))
    assert y == {2: 0.2, 1: -1.15, 4: 40.0}
    assert [row["profile"] for row in result["agreement"]] == [1]
    assert result["agreement"][0] == whole_result["agreement"][1]
    table = contour_table(out)
    assert np.isnan(table["z_m"][table["profile"] == 4]).all()


def test_a_laser_that_vision_is_too_coarse_for_is_not_fused(recording: Path) -> None:
    _, compared = measured(recording)
    out, result = measured(recording, "--overwrite", "--map.laser", "fuse")
    assert compared["laser"] is None and result["agreement"] == compared["agreement"]
    assert [(row["profile"], row["fused"]) for row in result["laser"]] == [(0, False), (1, False)]
    reasons = [w["message"] for w in result["warnings"] if w["code"] == "laser-off"]
    assert reasons == [f"profile {row['profile']} is not fused: {row['reason']}" for row in result["laser"]]
    assert 2 not in contour_table(out)["source"] and "laser" not in result["sensors_used"]


def test_a_laser_of_one_point(recording: Path) -> None:
    keep_rows(recording, 1, "laser0")
    _, result = measured(recording)
    assert result["agreement"] == [] and "no-overlap" in codes(result)
