"""`barsight disparity`: one pair in, one file out, mistakes in one line."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from barsight.calibration.files.rig_file import write_rig_file
from barsight.calibration.geometry.camera import Camera, Distortion
from barsight.calibration.geometry.rig import StereoRig
from barsight.cli.main import run
from barsight.core.pose import Pose
from barsight.stereo.disparity_files import read_disparity
from motion_recordings import ideal_rig

SHIFT_PX = 12


@pytest.fixture
def pair(tmp_path: Path) -> tuple[Path, Path]:
    """A textured wall 12 px away."""
    noise = np.random.default_rng(5).integers(0, 255, (150, 260 + SHIFT_PX)).astype(np.uint8)
    wall = cv2.GaussianBlur(noise, (0, 0), 1.2)
    left, right = tmp_path / "left [bold].png", tmp_path / "right.png"
    cv2.imwrite(str(left), wall[:, :-SHIFT_PX])
    cv2.imwrite(str(right), wall[:, SHIFT_PX:])
    return left, right


def refused(arguments: list[str], capsys: pytest.CaptureFixture[str], *words: str) -> None:
    assert run(["disparity", *arguments]) in (2, 3, 4, 5)
    text = capsys.readouterr().err
    assert text.count("\n") == 1
    for word in words:
        assert word in text


@pytest.mark.parametrize("name", ["d.pfm", "d.png", "d.tif"])
def test_a_wall_has_one_disparity(pair: tuple[Path, Path], tmp_path: Path, name: str) -> None:
    out = tmp_path / name
    preview = tmp_path / "preview.png"
    assert run(["disparity", *map(str, pair), "-o", str(out), "--preview", str(preview)]) == 0
    found = read_disparity(out).disparity_px
    known = np.isfinite(found)
    assert known[:, SHIFT_PX + 8 :].mean() > 0.95
    assert abs(np.median(found[known]) - SHIFT_PX) < 0.05
    assert cv2.imread(str(preview)).shape == (150, 520, 3)


def test_a_rig_gives_what_makes_depth_of_it(pair: tuple[Path, Path], tmp_path: Path) -> None:
    camera = Camera(260, 150, 300.0, 300.0, 129.5, 74.5, Distortion.RADTAN, (-0.01, 0.0, 0.0, 0.0))
    aside = Pose("cam0", "cam1", np.eye(3), np.array([0.4, 0, 0]))
    body = Pose("body", "cam0", np.eye(3), np.zeros(3))
    write_rig_file(tmp_path / "rig.yaml", StereoRig(camera, camera, body, body @ aside))
    out = tmp_path / "d.pfm"
    assert run(["disparity", *map(str, pair), "--rig", str(tmp_path / "rig.yaml"), "-o", str(out)]) == 0
    said = dict(line.split("=") for line in (tmp_path / "d_calib.txt").read_text().splitlines())
    focal = float(said["cam0"].strip("[]").split()[0])
    disparity = read_disparity(out).disparity_px
    depth = float(said["baseline"]) * focal / (disparity + float(said["doffs"]))
    assert np.nanmedian(depth) == pytest.approx(400 * 300 / SHIFT_PX, rel=0.02)


def test_colour_and_16_bits_are_turned_to_gray(pair: tuple[Path, Path], tmp_path: Path) -> None:
    left, right = (cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in pair)
    colour, deep = tmp_path / "colour.png", tmp_path / "deep.png"
    cv2.imwrite(str(colour), cv2.cvtColor(left, cv2.COLOR_GRAY2BGR))
    cv2.imwrite(str(deep), right.astype(np.uint16) * 257)
    plain, mixed = tmp_path / "plain.pfm", tmp_path / "mixed.pfm"
    assert run(["disparity", *map(str, pair), "-o", str(plain)]) == 0
    assert run(["disparity", str(colour), str(deep), "-o", str(mixed)]) == 0
    assert plain.read_bytes() == mixed.read_bytes()


def test_csca_looks_at_the_colours_of_raw_pictures_too(pair: tuple[Path, Path], tmp_path: Path) -> None:
    tinted = [tmp_path / "left tinted.png", tmp_path / "right tinted.png"]
    for path, out in zip(pair, tinted, strict=True):
        gray = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        cv2.imwrite(str(out), np.dstack([gray, gray, gray // 2]))
    rig = tmp_path / "rig.yaml"
    write_rig_file(rig, ideal_rig(260, 150))
    plain, raw = tmp_path / "plain.pfm", tmp_path / "raw.pfm"
    csca = ["--method", "csca", "--range", "4:20"]
    assert run(["disparity", *map(str, tinted), "-o", str(plain), *csca]) == 0
    assert run(["disparity", *map(str, tinted), "-o", str(raw), *csca, "--rig", str(rig)]) == 0
    assert plain.read_bytes() == raw.read_bytes()
    assert abs(np.nanmedian(read_disparity(raw).disparity_px) - SHIFT_PX) < 0.1


def test_what_shows_nothing_is_told(
    pair: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    left, right = map(str, pair)
    black, gray, white = (str(tmp_path / name) for name in ("black.png", "gray.png", "white.png"))
    cv2.imwrite(black, np.zeros((150, 260), np.uint8))
    cv2.imwrite(gray, np.full((150, 260), 128, np.uint8))
    cv2.imwrite(white, np.full((150, 260), 65535, np.uint16))
    out = ["-o", str(tmp_path / "d.tif")]
    refused([black, black, *out], capsys, "black.png", "nothing can be matched", "left image is black")
    refused([black, black, *out, "--range", "0:16"], capsys, "left image is black")
    refused([left, gray, *out], capsys, "right image is gray 128")
    refused([white, right, *out], capsys, "left image is white")
    refused([left, left, *out], capsys, "the same image", "two pictures of one pair")
    assert not any(tmp_path.glob("d.*"))
    assert run(["disparity", left, left, *out, "--range", "-8:8"]) == 0


@pytest.mark.parametrize(("rows", "columns"), [(1, 260), (2, 260), (150, 1), (150, 8), (1, 1)])
def test_scraps_of_pictures_are_refused(
    pair: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str], rows: int, columns: int
) -> None:
    scraps = [str(tmp_path / name) for name in ("a.png", "b.png")]
    for path, scrap in zip(pair, scraps, strict=True):
        cv2.imwrite(scrap, cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)[:rows, :columns])
    refused([*scraps, "-o", str(tmp_path / "d.pfm")], capsys, f"{columns}x{rows}", "16x3")


def test_what_is_refused(pair: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    left, right = map(str, pair)
    out = ["-o", str(tmp_path / "d.pfm")]
    smaller, lower, torn = tmp_path / "small.png", tmp_path / "low.png", tmp_path / "torn.png"
    picture = cv2.imread(right, cv2.IMREAD_GRAYSCALE)
    cv2.imwrite(str(smaller), picture[:-10])
    cv2.imwrite(str(lower), np.roll(picture, 4, axis=0))
    torn.write_bytes(pair[1].read_bytes()[:500])
    refused([left, str(smaller), *out], capsys, "260x150 and 260x140")
    refused([left, str(lower), *out], capsys, "not rectified", "4.")
    refused([left, str(torn), *out], capsys, "torn.png")
    refused([left, str(tmp_path / "none.png"), *out], capsys, "none.png")
    refused([right, left, *out], capsys, "swapped", "exchange")
    refused([left, right, *out, "--range", "30:30"], capsys, "30:30", "empty")
    refused([left, right, *out, "--range", "0:900"], capsys, "0:900", "260 px wide")
    refused([left, right, *out, "--range", "many"], capsys, "many")
    refused([left, right, "-o", str(tmp_path / "d.jpg")], capsys, "d.jpg", ".pfm")
    refused([left, right, "-o", left], capsys, left, "is an input")
    refused([left, right, *out, "--preview", right], capsys, right, "is an input")
    assert (cv2.imread(right, cv2.IMREAD_GRAYSCALE) == picture).all()
    refused([left, right, "-o", str(tmp_path / "d.png"), "--preview", str(tmp_path / "d.png")], capsys,
            "is the disparity's file; name another")  # fmt: skip
    refused([left, right, *out, "--preview", str(tmp_path / "none" / "p.png")], capsys, "there is no folder")
    assert not any(tmp_path.glob("d*"))


def test_pictures_that_do_not_belong_together_are_told(
    pair: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Noise matches itself somewhere; a wall has no such warning."""
    noise = [
        np.random.default_rng(k).normal(128, 60, (200, 300)).clip(0, 255).astype(np.uint8) for k in (1, 2)
    ]
    left, right = tmp_path / "noise.png", tmp_path / "other.png"
    for path, picture in zip((left, right), noise, strict=True):
        cv2.imwrite(str(path), cv2.GaussianBlur(picture, (0, 0), 1.2))
    for pictures, told in (((left, right), True), (pair, False)):
        assert run(["disparity", *map(str, pictures), "-o", str(tmp_path / "d.pfm")]) == 0
        assert ("warning: hardly anything is matched well" in capsys.readouterr().err) == told
