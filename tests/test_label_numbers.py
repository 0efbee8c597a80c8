"""Plain numbers on labels: drawn into patches and pictures, read right or not at all."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from barsight.cli.main import run
from barsight.core.errors import ConfigError
from barsight.labels.attachment import NUMBER, PlacedCode, merge_codes
from barsight.labels.number_reading import PATCH_PX, data_folder, number_reader, read_number
from barsight.labels.placing import pose_at
from barsight.measure_settings import MeasureSettings
from barsight.pipeline.mapped_yard import map_yard
from barsight.recording.open import open_recording
from barsight.result_folder import read_path
from barsight.simulation.settings.recording import SimulationSettings
from barsight.simulation.settings.rig import CameraSettings
from barsight.simulation.settings.yard import YardSettings
from barsight.simulation.simulate import simulate
from barsight.yard.label_settings import LabelSettings
from test_labels import project, stick

FONTS = (cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_DUPLEX, cv2.FONT_HERSHEY_TRIPLEX)
SIZE_M = (0.2, 0.12)


def can_read() -> bool:
    try:
        data_folder()
        with number_reader():
            return True
    except ConfigError:
        return False


reads_numbers = pytest.mark.skipif(
    not can_read(), reason="needs the extra `numbers` and Tesseract's English data (tesseract-ocr-eng)"
)


def plate(text: str, font: int = FONTS[1]) -> np.ndarray:
    """A white label of 100 x 60, ten pixels a step, its number as large as fits."""
    image = np.full((600, 1000), 255, np.uint8)
    scale = 1.0
    while True:
        (width, height), _ = cv2.getTextSize(text, font, scale, round(2 + 2 * scale))
        if width > 850 or height > 400:
            break
        scale *= 1.1
    at = round(500 - width / 2.2), round(300 + height / 2.2)
    return cv2.putText(image, text, at, font, scale / 1.1, 0, round(2 + 2 * scale), cv2.LINE_AA)


def worn(image: np.ndarray, px_mm: float, rng: np.random.Generator) -> np.ndarray:
    """A patch about a label on bars, as a camera sees it: turned, sampled by area, blurred, noisy, shone."""
    side = round(180 * px_mm)
    turn = cv2.getRotationMatrix2D((500, 300), rng.uniform(0, 360), 0.8 * px_mm)
    turn[:, 2] += 4 * side - np.array([500, 300])
    large = (8 * side, 8 * side)
    paper = cv2.warpAffine(image, turn, large, flags=cv2.INTER_AREA)
    inside = cv2.warpAffine(np.full_like(image, 255), turn, large)
    bars = 70 + 40 * np.sin(np.arange(8 * side) / (160 * px_mm))
    scene = np.where(inside > 127, paper * rng.uniform(0.4, 0.85) + rng.uniform(0, 40), bars)
    small = cv2.GaussianBlur(cv2.resize(scene, (side, side), interpolation=cv2.INTER_AREA), (0, 0), 0.6)
    shine = rng.uniform(0, 60) * np.exp(
        -(((np.arange(side) - rng.uniform(0, side)) / rng.uniform(2, 9)) ** 2)
    )
    seen = np.clip(small + shine + rng.normal(0, rng.uniform(1, 6), small.shape), 0, 255).astype(np.uint8)
    return cv2.resize(seen, (PATCH_PX, PATCH_PX), interpolation=cv2.INTER_CUBIC)


def read_share(count: int, px_mm: float, seed: int) -> tuple[float, list[tuple[str, str]]]:
    """Share of numbers that one picture reads right, and those that were read as others."""
    rng, right, wrong = np.random.default_rng(seed), 0, []
    with number_reader() as reader:
        for number in range(count):
            text = "".join(rng.choice(list("0123456789"), rng.integers(4, 9)))
            found = read_number(reader, worn(plate(text, FONTS[number % 3]), px_mm, rng), 0.6)
            right += found == text
            if found not in (None, text):
                wrong.append((text, str(found)))
    return right / count, wrong


@reads_numbers
def test_worn_numbers_are_read_right_or_not_at_all() -> None:
    share, wrong = read_share(30, 1.0, 3)
    assert share > 0.7 and not wrong


@pytest.mark.slow
@reads_numbers
@pytest.mark.parametrize("px_mm", [0.8, 1.0, 1.5, 2.0])
def test_two_thousand_numbers(px_mm: float) -> None:
    share, wrong = read_share(500, px_mm, 9100 + round(10 * px_mm))
    print(f"{px_mm} px a mm: {100 * share:.1f} % read, of 500 wrong: {wrong}")
    assert len(wrong) <= 3 and share > 0.7


@reads_numbers
def test_what_reads_both_ways_or_is_no_label_is_not_sure() -> None:
    with number_reader() as reader:
        patch = np.full((PATCH_PX, PATCH_PX), 60, np.uint8)
        assert read_number(reader, patch, 0.6) is None
        patch[120:240, 80:280] = cv2.resize(plate("1689"), (200, 120), interpolation=cv2.INTER_AREA)
        assert read_number(reader, patch, 0.6) is None
        patch[120:240, 80:280] = cv2.resize(plate("1682"), (200, 120), interpolation=cv2.INTER_AREA)
        assert read_number(reader, patch, 0.6) == "1682"
        assert read_number(reader, patch[::-1, ::-1].copy(), 0.6) == "1682"
        assert read_number(reader, patch, 0.2) is None, "a label of another shape"


def test_a_number_needs_three_pictures() -> None:
    place = np.array([1.0, 2.0, 0.5])
    for pictures, is_sure in ((2, False), (3, True)):
        (label,) = merge_codes([PlacedCode("4711", NUMBER, place, (k, 0)) for k in range(pictures)], ())
        assert label.is_sure == is_sure
    (label,) = merge_codes([PlacedCode("B-17", "QRCode", place, (k, 0)) for k in range(2)], ())
    assert label.is_sure


def test_without_data_the_remedy_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("TESSDATA_PREFIX", str(tmp_path))
    pytest.importorskip("tesserocr")
    with pytest.raises(ConfigError, match=r"eng.traineddata.*TESSDATA_PREFIX"):
        map_yard(
            [], MeasureSettings(labels=LabelSettings(read=True, numbers=True)), tmp_path, lambda *_: None
        )
    with pytest.raises(ConfigError, match=r"labels.numbers needs labels.read"):
        LabelSettings(numbers=True)


def write_on_bundles(recording: Path, out: Path) -> dict[str, int]:
    """Lay a plate with a number over each bundle in all pictures, by the measured poses; ids by text."""
    path, rig = read_path(out), open_recording(recording).rig
    assert path is not None
    bundles = json.loads((out / "bundles.json").read_text())["bundles"]
    numbers = {f"47{11 + 23 * k}": one for k, one in enumerate(bundles)}
    for number in (0, 1):
        for file in sorted((recording / "mav0" / f"cam{number}" / "data").glob("*.png")):
            body = pose_at(path, int(file.stem))
            assert body is not None
            image = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
            assert image is not None
            for text, one in numbers.items():
                yaw = np.radians(one["yaw_deg"])
                along = np.array([-np.sin(yaw), np.cos(yaw), 0]) * SIZE_M[0] / 2
                across = np.array([np.cos(yaw), np.sin(yaw), 0]) * SIZE_M[1] / 2
                middle = np.array([*one["axis_centre_m"][:2], one["top_z_m"]])
                corners = [middle + a * along + b * across for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
                label = cv2.resize(plate(text), (100, 60), interpolation=cv2.INTER_AREA)
                image = stick(image, label, project(rig, number, body, np.array(corners)))
            cv2.imwrite(str(file), image)
    return {text: one["id"] for text, one in numbers.items()}


@pytest.mark.slow
@reads_numbers
def test_numbers_on_bundles_are_read_by_measure_and_by_labels(tmp_path: Path) -> None:
    recording, out = tmp_path / "recording", tmp_path / "out"
    camera = CameraSettings(
        width_px=640, height_px=512, focal_px=1000, above_floor_m=2.2, baseline_m=0.2, trolley_y_m=0.75
    )
    yard = YardSettings(max_layers=1, bar_length_m=3)
    simulate(recording, SimulationSettings(1.4, 7, 43, depth_views=0, camera=camera, yard=yard))
    assert run(["measure", str(recording), "-o", str(out), "--stereo.method", "sgbm"]) == 0
    written = write_on_bundles(recording, out)
    size = [str(side) for side in SIZE_M]
    read = ["--labels.read", "--labels.numbers", "--labels.size-m", *size]
    out = tmp_path / "again"
    assert run(["measure", str(recording), "-o", str(out), "--stereo.method", "sgbm", *read]) == 0
    bundles = json.loads((out / "bundles.json").read_text())["bundles"]
    labels = {one["label"]["text"]: one["label"] for one in bundles if one["label"]}
    sure = {text for text in labels if text is not None}
    assert len(sure) >= 2 and sure <= set(written)
    assert all(labels[text]["kind"] == NUMBER and labels[text]["reads"] >= 3 for text in sure)
    assert run(["labels", str(recording), str(out), "--numbers", "--label-m", *size]) == 0
    told = json.loads((out / "labels.json").read_text())["labels"]
    assert sure <= {one["text"] for one in told if one["is_sure"]} <= set(written)
