"""`barsight calibrate` on real pictures: what must come out, and mistakes in one line."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from barsight.calibration.boards.board import parse_board
from barsight.calibration.boards.board_views import Corners
from barsight.calibration.boards.detection import detect
from barsight.calibration.files.rig_file import read_covariance
from barsight.cli.main import run


def calibrate(pictures: Path, out: Path, board: str) -> dict:
    code = run(["calibrate", "stereo", str(pictures), "--board", board, "-o", str(out)])
    assert out.with_suffix(".html").read_text().count("plotly") > 10
    report = json.loads(out.with_suffix(".json").read_text())
    assert code == (5 if report["verdict"] == "redo" else 0)
    return report


def refused(capsys: pytest.CaptureFixture[str], arguments: list[str]) -> str:
    assert run(arguments) in (2, 3, 4)
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    return lines[0]


def test_bouguets_rig(data: Path, tmp_path: Path) -> None:
    report = calibrate(data / "checkerboard_bouguet", tmp_path / "rig.yaml", "checkerboard:9x6:0.03")
    assert report["rms_px"] <= 0.22
    assert abs(report["baseline_mm"] - 99.85) <= 0.5
    assert report["cross_validation"]["ratio"] <= 2
    assert len(report["views"]) == 13
    found = read_covariance(tmp_path / "rig.yaml")
    assert found is not None
    assert found[1].shape == (len(found[0]), len(found[0]))
    assert np.linalg.eigvalsh(found[1]).min() > 0


def test_sourishgs_rig(data: Path, tmp_path: Path) -> None:
    report = calibrate(data / "checkerboard_sourishg", tmp_path / "rig.yaml", "checkerboard:9x6:0.02423")
    assert report["rms_px"] <= 0.25
    assert report["cross_validation"]["ratio"] <= 2
    assert abs(report["baseline_mm"] - 94.0) < 0.5


def test_every_view_of_the_webcams_is_used(data: Path, tmp_path: Path) -> None:
    report = calibrate(data / "checkerboard_webcams", tmp_path / "rig.yaml", "checkerboard:9x6:0.025")
    assert report["verdict"] == "redo"
    assert {r["view"] for r in report["removed"] if r["camera"] == "both"} == set()
    assert not [r for r in report["removed"] if "checkerboard" in r["reason"]]
    assert abs(report["baseline_mm"] - 60.39) <= 0.003 * 60.39


def test_a_blurred_view_and_one_of_another_board_are_left_out(data: Path, tmp_path: Path) -> None:
    folder = tmp_path / "pictures"
    shutil.copytree(data / "checkerboard_bouguet", folder, copy_function=shutil.copyfile)
    folder.chmod(0o755)
    blurred = cv2.imread(str(folder / "left04.jpg"), cv2.IMREAD_GRAYSCALE)
    cv2.imwrite(str(folder / "left04.jpg"), cv2.GaussianBlur(blurred, (0, 0), 2.5))
    for side in ("left", "right"):
        other = cv2.imread(str(data / "checkerboard_sourishg" / f"{side}5.jpg"), cv2.IMREAD_GRAYSCALE)
        framed = cv2.copyMakeBorder(other, 60, 60, 0, 0, cv2.BORDER_REPLICATE)
        cv2.imwrite(str(folder / f"{side}06.jpg"), framed)
    report = calibrate(folder, tmp_path / "rig.yaml", "checkerboard:9x6:0.03")
    reasons = {(r["view"], r["camera"]): r["reason"] for r in report["removed"]}
    assert "blurred" in reasons["04", "cam0"]
    assert "another board" in reasons["06", "both"]
    assert abs(report["baseline_mm"] - 99.85) <= 0.5


def test_swapped_folders_and_wrong_sizes_are_said(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pictures = data / "checkerboard_bouguet"
    for side, other in (("left", "right"), ("right", "left")):
        (tmp_path / "swapped" / other).mkdir(parents=True)
        for file in pictures.glob(f"{side}*.jpg"):
            shutil.copyfile(file, tmp_path / "swapped" / other / file.name.replace(side, other))
    out = ["-o", str(tmp_path / "rig.yaml")]
    board = ["--board", "checkerboard:9x6:0.03"]
    line = refused(capsys, ["calibrate", "stereo", str(tmp_path / "swapped"), *board, *out])
    assert "left and right are swapped" in line
    line = refused(capsys, ["calibrate", "stereo", str(pictures), "--board", "checkerboard:8x6:0.03", *out])
    assert "no 8x6 checkerboard found; the picture shows one of 9x6 inner corners" in line
    assert "no such folder" in refused(capsys, ["calibrate", "stereo", str(tmp_path / "no"), *board, *out])
    assert "holds no pairs" in refused(capsys, ["calibrate", "stereo", str(tmp_path), *board, *out])
    assert "known are" in refused(capsys, ["calibrate", "lidar"])
    assert not list(tmp_path.glob("rig*"))


def test_a_board_is_printed_in_its_true_size(tmp_path: Path) -> None:
    board, out = "checkerboard:9x6:0.025", tmp_path / "board.png"
    assert run(["calibrate", "board", "--board", board, "-o", str(out)]) == 0
    with Image.open(out) as picture:
        dpi, image = picture.info["dpi"][0], np.array(picture)
    assert dpi == pytest.approx(300, abs=0.1)
    found = detect(parse_board(board), image)
    assert isinstance(found, Corners)
    across = np.linalg.norm(found.pixels[8] - found.pixels[0]) * 0.0254 / dpi
    assert across == pytest.approx(8 * 0.025, rel=2e-3)
    views = tmp_path / "views.pdf"
    assert run(["calibrate", "board", "--board", "aprilgrid:6x6:0.088:0.3", "--views", "-o", str(views)]) == 0
    assert views.read_bytes().startswith(b"%PDF")
    assert run(["calibrate", "board", "--board", board, "--dpi", "5", "-o", str(out)]) == 2
    assert run(["calibrate", "board", "--board", board, "-o", str(tmp_path / "board.jpg")]) == 4
