"""Labels: codes drawn into pictures are read, placed on the map, attached and held against the stock list."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from barsight.calibration.files.rig_file import write_rig_file
from barsight.calibration.geometry.rig import StereoRig
from barsight.cli.main import run
from barsight.core.errors import InputError
from barsight.core.pose import Pose
from barsight.labels.attachment import PlacedCode, contradictions, merge_codes
from barsight.labels.bundle_labels import ILLEGIBLE, bundle_label, unread_label
from barsight.labels.code_reading import read_codes
from barsight.labels.placing import pose_at
from barsight.labels.reading import _expect_own
from barsight.motion.rig_check.self_calibration import turn_right_camera
from barsight.recording.open import open_recording
from barsight.result_folder import read_heights, read_path
from barsight.simulation.lighting import bake, hall_lamps
from barsight.simulation.render import Shading, render_view
from barsight.simulation.scene import Primitives, Scene, build_grid
from barsight.simulation.settings.recording import SimulationSettings
from barsight.simulation.settings.rig import CameraSettings
from barsight.simulation.settings.yard import YardSettings
from barsight.simulation.simulate import simulate
from barsight.simulation.textures import label_codes, label_text, surface_tile
from barsight.simulation.truth import label_rows
from barsight.yard.inventory.stock_list import ListedBundle, contradicted_bundles, match_stock
from barsight.yard.plates import find_plates
from barsight.yard.types import Bundle, BundleLabel, HeightMap
from cli_runs import FAST
from lift_yards import laid, map_of, record

zxingcpp = pytest.importorskip("zxingcpp")


def code(text: str, kind: str = "DataMatrix") -> np.ndarray:
    """One pixel a module, with its quiet zone, light on dark as 0 and 255."""
    made = zxingcpp.create_barcode(text, getattr(zxingcpp.BarcodeFormat, kind))
    return np.pad(np.array(made.to_image(scale=1)), 2, constant_values=255)


def project(rig: StereoRig, number: int, map_from_body: Pose, points: np.ndarray) -> np.ndarray:
    camera = (rig.cam0, rig.cam1)[number]
    body_from_cam = (rig.body_from_cam0, rig.body_from_cam1)[number]
    inside = (map_from_body @ body_from_cam).inverse().apply(points)
    matrix = np.array([[camera.fx_px, 0, camera.cx_px], [0, camera.fy_px, camera.cy_px], [0, 0, 1]])
    distortion = np.array(camera.coefficients, dtype=np.float64)
    return cv2.projectPoints(inside, np.zeros(3), np.zeros(3), matrix, distortion)[0].reshape(-1, 2)


def stick(image: np.ndarray, label: np.ndarray, corners_px: np.ndarray) -> np.ndarray:
    """Draw a label over a picture by the homography of its corners; area sampling by drawing it large."""
    large = cv2.resize(label, None, fx=8, fy=8, interpolation=cv2.INTER_NEAREST)
    height, width = large.shape
    source = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
    wide = 4
    turn = cv2.getPerspectiveTransform(source, (wide * corners_px).astype(np.float32))
    size = (wide * image.shape[1], wide * image.shape[0])
    drawn = cv2.warpPerspective(large, turn, size, flags=cv2.INTER_AREA)
    inside = cv2.warpPerspective(np.full_like(large, 255), turn, size)
    small = cv2.resize(drawn, image.shape[::-1], interpolation=cv2.INTER_AREA)
    share = cv2.resize(inside, image.shape[::-1], interpolation=cv2.INTER_AREA) / 255.0
    return np.where(share > 0, (1 - share) * image + 0.75 * small + 20 * share, image).astype(np.uint8)


def labelled(recording: Path, out: Path, text: str, size_m: float) -> np.ndarray:
    """Stick a label over the middle of the map in all pictures, by the measured poses; its place."""
    parted, rig, path = read_heights(out), open_recording(recording).rig, read_path(out)
    heights = parted.whole()
    assert path is not None
    x, y = path.position_m[:, 0].mean(), float(np.mean(heights.y_m))
    column, row = np.abs(heights.x_m - x).argmin(), np.abs(heights.y_m - y).argmin()
    around = heights.z_m[row - 2 : row + 3, column - 2 : column + 3]
    middle = np.array([x, y, np.nanmedian(around)])
    half = size_m / 2
    corners = middle + half * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])
    for number in (0, 1):
        for file in sorted((recording / "mav0" / f"cam{number}" / "data").glob("*.png")):
            body = pose_at(path, int(file.stem))
            assert body is not None
            image = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
            cv2.imwrite(str(file), stick(image, code(text), project(rig, number, body, corners)))
    return middle


def test_labels_are_read_placed_and_held_against_the_stock(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert run(["measure", str(recording), "-o", str(out), *FAST]) == 0
    middle = labelled(recording, out, "B-17", 1.2)
    stock = tmp_path / "stock.csv"
    stock.write_text("name,x_m,y_m\nB-16,1.0,2.0\n")
    assert run(["labels", str(recording), str(out), "--stock-list", str(stock)]) == 0
    content = json.loads((out / "labels.json").read_text())
    assert [(one["text"], one["bundle"], one["is_sure"]) for one in content["labels"]] == [
        ("B-17", None, True)
    ]
    assert content["illegible"] == []
    label = content["labels"][0]
    assert np.linalg.norm([label["x_m"] - middle[0], label["y_m"] - middle[1]]) < 0.1
    assert label["pictures"] >= 4
    assert content["contradictions"] == ["label 'B-17' is not in the list"]
    assert "not in the list" in capsys.readouterr().out


def worn(image: np.ndarray, module_px: float, rng: np.random.Generator) -> np.ndarray:
    """A label as a camera sees it: small, turned, blurred, noisy, with a highlight across it."""
    size = int(np.ceil(1.6 * module_px * max(image.shape)))
    angle, scale = rng.uniform(0, 360), 8 * module_px
    turn = cv2.getRotationMatrix2D((image.shape[1] / 2, image.shape[0] / 2), angle, scale)
    turn[:, 2] += 4 * size - np.array([image.shape[1], image.shape[0]]) / 2
    large = cv2.warpAffine(image, turn, (8 * size, 8 * size), flags=cv2.INTER_NEAREST, borderValue=110.0)
    small = cv2.resize(large, (size, size), interpolation=cv2.INTER_AREA).astype(np.float64)
    small = cv2.GaussianBlur(small, (0, 0), rng.uniform(0.3, 0.9))
    bright = rng.uniform(0, 90) * np.exp(
        -(((np.arange(size) - rng.uniform(0, size)) / rng.uniform(2, 9)) ** 2)
    )
    seen = (
        rng.uniform(0.25, 0.8) * small
        + rng.uniform(0, 40)
        + bright
        + rng.normal(0, rng.uniform(1, 6), small.shape)
    )
    return np.clip(seen, 0, 255).astype(np.uint8)


def read_share(count: int, module_px: float, seed: int) -> tuple[dict[str, float], int]:
    """Share of labels of each kind that one picture reads, and how many were read wrongly."""
    rng = np.random.default_rng(seed)
    right, wrong = dict.fromkeys(("DataMatrix", "QRCode", "Code128"), 0), 0
    for number in range(count):
        kind = list(right)[number % 3]
        text = f"{rng.integers(10**8, 10**9)}"
        found = {one.text for one in read_codes(worn(code(text, kind), module_px, rng))}
        right[kind] += text in found
        wrong += bool(found - {text})
    return {kind: 3 * number / count for kind, number in right.items()}, wrong


def test_worn_labels_are_read_right_or_not_at_all() -> None:
    share, wrong = read_share(150, 3.0, 41)
    assert min(share["DataMatrix"], share["QRCode"]) > 0.85 and share["Code128"] > 0.3 and wrong == 0


@pytest.mark.slow
@pytest.mark.parametrize("module_px", [1.5, 2.0, 2.5, 3.0, 4.0])
def test_ten_thousand_labels(module_px: float) -> None:
    share, wrong = read_share(2000, module_px, 7000 + int(10 * module_px))
    told = ", ".join(f"{kind} {100 * part:.1f} %" for kind, part in share.items())
    print(f"{module_px} px a module: {told} read, {wrong} of 2000 wrong")
    assert wrong == 0


def test_other_texts_at_the_place_and_single_pictures_are_doubted() -> None:
    place = np.array([1.0, 2.0, 0.5])
    codes = [PlacedCode("A", "QRCode", place + 0.01 * k, (k, 0)) for k in range(3)]
    codes += [PlacedCode("B", "QRCode", place, (9, 1)), PlacedCode("C", "QRCode", place + 3, (1, 0))]
    labels = {one.text: one for one in merge_codes(codes, ())}
    assert not labels["A"].is_sure and labels["A"].agreement_ratio == 0.75
    assert "1 picture" in labels["C"].doubts[0]


def test_another_recording_or_rig_is_refused(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert run(["measure", str(recording), "-o", str(out), *FAST]) == 0
    turned = turn_right_camera(open_recording(recording).rig, np.array([0.0, 0.001, 0.0]))
    write_rig_file(tmp_path / "rig.yaml", turned)
    assert run(["labels", str(recording), str(out), "--rig", str(tmp_path / "rig.yaml")]) == 3
    assert "was measured with another rig" in capsys.readouterr().err.replace("\n", " ")
    result = json.loads((out / "result.json").read_text())
    rig = recording / "mav0" / "cam0" / "sensor.yaml"
    rig.write_text(rig.read_text() + "\n# another\n")
    said = result | {"passes": [{"inputs": result["hashes"]["inputs"]}]}
    for content in (result, said):
        with pytest.raises(InputError, match="is not the result of"):
            _expect_own(open_recording(recording), out, content)
    assert run(["labels", str(recording), str(out)]) == 3
    assert "is not the result of" in capsys.readouterr().err.replace("\n", " ")
    assert not (out / "labels.json").exists()


def test_a_label_lies_on_the_highest_bundle_there_and_the_list_may_contradict() -> None:
    low, high = record(laid(1.0), 4), record(laid(1.05, z=0.3), 7)
    at = np.array([1.06, 0.5, high.top_z_m])
    codes = [PlacedCode("N7", "QRCode", at, (k, 0)) for k in range(2)]
    codes += [PlacedCode("N9", "QRCode", at + np.array([5.0, 0, 0]), (k, 0)) for k in range(2)]
    labels = merge_codes(codes, (low, high))
    assert [(one.text, one.bundle) for one in labels] == [("N7", 7), ("N9", None)]
    listed = (ListedBundle("N7", 1.1, 0.2), ListedBundle("N9", 6.0, 0.0))
    assert contradictions(labels, (low, high), listed) == ()
    (told,) = contradictions(labels, (low, high), (ListedBundle("N7", 3.0, 0.2), listed[1]))
    assert told.startswith("N7 is listed at x 3.00 m")


NEAR = SimulationSettings(
    length_m=1.4,
    frames=7,
    seed=41,
    depth_views=0,
    camera=CameraSettings(
        width_px=640, height_px=512, focal_px=1000, above_floor_m=2.2, baseline_m=0.2, trolley_y_m=0.75
    ),
    yard=YardSettings(max_layers=1, bar_length_m=3, label_m=(0.16, 0.14)),
)
"""Labels of 140 mm squares: 5.6 mm a module, 2.2 mm a pixel."""


def measured_bundles(recording: Path, out: Path, *flags: str) -> dict[str, Any]:
    how = ("--labels.read", "--stereo.method", "sgbm")
    assert run(["measure", str(recording), "-o", str(out), *how, *flags]) == 0
    content: dict[str, Any] = json.loads((out / "bundles.json").read_text())
    return content


def on_top(bundle: Bundle, text: str, aside_m: float = 0.0, along_m: float = 0.0) -> list[PlacedCode]:
    place = np.array([bundle.centre_m[0] + aside_m, bundle.centre_m[1] + along_m, bundle.top_z_m])
    return [PlacedCode(text, "QRCode", place, (k, 0)) for k in range(3)]


def test_a_label_on_the_border_of_two_bundles_is_surely_on_neither() -> None:
    """The neighbour is 4 mm higher; the label's place is known to some mm."""
    first = record(laid(0.0), 1)
    aside = np.array([first.width_m, 0, 0])
    second = replace(first, id=2, centre_m=first.centre_m + aside, top_z_m=first.top_z_m + 0.004)
    for inside_m, sure in ((0.01, False), (0.05, True)):
        codes = on_top(first, "B-17", first.width_m / 2 - inside_m)
        (label,) = merge_codes(codes, (first, second))
        assert (label.bundle, label.is_sure) == (1, sure)
        assert sure or "on the border of bundle 2" in label.doubts[0]
    over = replace(second, centre_m=first.centre_m)  # it lies across: the label is on the upper one
    (label,) = merge_codes(on_top(over, "B-17"), (first, over))
    assert (label.bundle, label.is_sure) == (2, True)


def test_one_text_on_two_bundles_is_no_label_and_at_both_ends_of_one_it_is() -> None:
    first = record(laid(0.0), 1)
    second = replace(first, id=2, centre_m=first.centre_m + np.array([1.0, 0, 0]))
    twins = merge_codes(on_top(first, "B-17") + on_top(second, "B-17"), (first, second))
    assert [bundle_label(one, twins) for one in (first, second)] == [ILLEGIBLE, ILLEGIBLE]
    ends = merge_codes(on_top(first, "B-17", 0, -1) + on_top(first, "B-17", 0, 1), (first, second))
    read = bundle_label(first, ends)
    assert read is not None and read.text == "B-17"
    listed = (ListedBundle("B-17", *first.centre_m[:2].tolist()),)
    assert contradictions(ends, (first, second), listed) == ()
    assert "'B-17' lies at two places" in contradictions(twins, (first, second), listed)[0]


@pytest.mark.slow
def test_measure_reads_labels_and_holds_the_stock_list_against_them(tmp_path: Path) -> None:
    recording = tmp_path / "recording"
    simulate(recording, NEAR)
    truth = {
        one["text"]: one["center"] for one in json.loads((recording / "truth" / "labels.json").read_text())
    }
    read = {
        one["label"]["text"]: one
        for one in measured_bundles(recording, tmp_path / "out")["bundles"]
        if one["label"] and one["label"]["text"]
    }
    assert read and set(read) <= set(truth)
    for text, one in read.items():
        assert abs(truth[text][0] - one["axis_centre_m"][0]) < one["width_m"] / 2
        assert one["label"]["kind"] == "QRCode" and one["label"]["reads"] >= 2
        assert one["label"]["confidence"] >= 0.75
    rows = [f"{text},{one['axis_centre_m'][0]},{one['axis_centre_m'][1]}" for text, one in read.items()]
    stock = tmp_path / "stock.csv"
    stock.write_text("\n".join(["name,x_m,y_m", *rows]))
    match = measured_bundles(recording, tmp_path / "right", "--bundles.stock-list", str(stock))["stock"]
    assert [one["disagrees"] for one in match["matched"]] == [[]] * len(read)
    stock.write_text("\n".join(["name,x_m,y_m", *rows]).replace(next(iter(read)), "OTHER"))
    match = measured_bundles(recording, tmp_path / "wrong", "--bundles.stock-list", str(stock))["stock"]
    told = {one["name"]: one["disagrees"] for one in match["matched"]}
    assert told["OTHER"] == [f"its label reads {next(iter(read))!r}, which the list lacks"]
    warned = json.loads((tmp_path / "wrong" / "result.json").read_text())["warnings"]
    assert any(w["code"].startswith("stock-") and "OTHER" in w["message"] for w in warned)


def test_a_bundle_has_the_text_that_is_sure_or_is_illegible() -> None:
    bundle = record(laid(1.0), 3)
    at = bundle.centre_m.copy()
    at[2] = bundle.top_z_m

    def of(*readings: tuple[str, int]) -> BundleLabel | None:
        codes = [PlacedCode(text, "QRCode", at, (k, len(text))) for text, n in readings for k in range(n)]
        return bundle_label(bundle, merge_codes(codes, (bundle,)))

    assert of(("N7", 3)) == BundleLabel("N7", "QRCode", 3, 0.8)
    assert of(("N7", 1)) == of(("N7", 3), ("N99", 1)) == BundleLabel(None, "illegible", 0, 0.0)
    assert of() is None


def test_a_label_that_reads_another_name_contradicts_the_list() -> None:
    bundle = replace(record(laid(1.0), 3), label=BundleLabel("N7", "QRCode", 3, 0.8))
    x, y = bundle.centre_m[:2]
    other = ListedBundle("N7", x + 5, y)
    for name, told in (("N7", ()), ("N8", ("its label reads 'N7', another one's of the list",))):
        listed = (ListedBundle(name, x, y), *((other,) if name == "N8" else ()))
        match = match_stock(listed, (bundle,))
        assert match.matched[0].disagrees == told
        assert bool(contradicted_bundles(match)) == bool(told)
    unread = replace(bundle, label=BundleLabel(None, "illegible", 0, 0.0))
    assert match_stock((ListedBundle("N8", x, y),), (unread,)).matched[0].disagrees == ()


def test_drawn_codes_are_read_off_the_render() -> None:
    """A box with a code on its upper face, seen from above by a camera that is turned."""
    codes = label_codes(12, 3)
    shape = np.array([[0, 0, 0.5, 1, 0, 0, 0, 1, 0, 0, 0, 1, 0.1, 0.06, 0.01]], dtype=np.float64)
    material = np.array([[0.75, 0, 0, 0, 0, 1, 0, 0.3, 2, 1]], np.float32)
    primitives = Primitives(shape, material, 0)
    scene = Scene(primitives, build_grid(primitives, (0.1, 0.5)))
    lamps = hall_lamps(8.0)
    look = Shading(
        lamps, bake(scene, lamps, np.random.default_rng(0)), surface_tile(np.random.default_rng(1), 0.0064),
        codes,
    )  # fmt: skip
    u, v = np.meshgrid((np.arange(320) - 159.5) / 400, (np.arange(256) - 127.5) / 400)
    c, s = np.cos(0.4), np.sin(0.4)
    above = Pose("yard", "cam0", np.array([[c, s, 0], [s, -c, 0], [0, 0, -1]]), np.array([0, 0, 0.8]))
    rays = np.stack([u, v], axis=-1).astype(np.float32)
    image = np.clip(300 * render_view(scene, look, rays, 1, above), 0, 255).astype(np.uint8)
    (found,) = read_codes(image)
    assert (found.text, found.kind) == (label_text(12, 2), "QRCode") == ("000120002", "QRCode")
    np.testing.assert_allclose(found.middle_px, [159.5, 127.5], atol=3)
    assert label_rows(scene, 12) == [{"text": "000120002", "center": [0.0, 0.0, 0.5]}]


def shining(shape: tuple[int, int], level: float) -> np.ndarray:
    """Bars along the first axis whose level varies across them and a little along, two dark straps."""
    rng = np.random.default_rng(8)
    gray = level * (0.6 + 0.4 * np.sin(0.9 * np.arange(shape[1])) ** 2) * np.exp(rng.normal(0, 0.05, shape))
    gray[200:203] = gray[500:503] = 25.0
    return gray


def yard_with(gray: np.ndarray, heights: HeightMap) -> HeightMap:
    return replace(heights, gray=np.clip(gray, 1, 255).astype(np.uint8))


def paper(heights: HeightMap, gray: np.ndarray, half_m: tuple[float, float], is_code: bool = True) -> None:
    """Lay white paper over x = 0.3 m, y = 0.7 m; in its middle a code's dark and white, blurred."""
    along, across = np.abs(heights.y_m - 0.7), np.abs(heights.x_m - 0.3)
    gray[np.ix_(along <= half_m[1], across <= half_m[0])] = 250.0
    if is_code:
        inner = np.ix_(along <= 0.026, across <= 0.026)
        gray[inner] = 150.0 + np.random.default_rng(3).normal(0, 25, gray[inner].shape)


@pytest.mark.parametrize("level", [90.0, 160.0, 300.0])
def test_a_plate_of_a_labels_size_is_an_illegible_label(level: float) -> None:
    """Bars from dark to shining as white as the paper."""
    bundle, heights = record(laid(0.3)), map_of([laid(0.3)])
    gray = shining(heights.shape, level)
    assert unread_label(bundle, yard_with(gray, heights), (0.1, 0.06)) is None
    paper(heights, gray, (0.03, 0.05))
    seen = yard_with(gray, heights)
    (first, *_) = find_plates(bundle, seen, (0.1, 0.06))
    np.testing.assert_allclose(first, [0.3, 0.7], atol=0.02)
    assert unread_label(bundle, seen, (0.1, 0.06)) == BundleLabel(None, "illegible", 0, 0.0)
    assert unread_label(bundle, seen, (0.0, 0.0)) is None
    assert not find_plates(bundle, seen, (0.3, 0.2)), "labels of another size are looked for"


def test_what_is_longer_or_stands_up_is_no_label() -> None:
    bundle, heights = record(laid(0.3)), map_of([laid(0.3)])
    gray = shining(heights.shape, 90.0)
    long, block = gray.copy(), gray.copy()
    paper(heights, long, (0.03, 0.4), is_code=False)
    assert not find_plates(bundle, yard_with(long, heights), (0.1, 0.06)), "a gleam along a bar"
    paper(heights, block, (0.03, 0.05), is_code=False)
    assert find_plates(bundle, yard_with(block, heights), (0.1, 0.06))
    on_it = np.ix_(np.abs(heights.y_m - 0.7) <= 0.05, np.abs(heights.x_m - 0.3) <= 0.03)
    raised = heights.z_m.copy()
    raised[on_it] += 0.05
    stood = replace(yard_with(block, heights), z_m=raised)
    assert not find_plates(bundle, stood, (0.1, 0.06)), "a block of wood"
