"""Lifts of a measured folder: command, page, 3D view, orthophoto, comparison; and what bad folders get."""

from __future__ import annotations

import json
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile

from barsight.cli.main import run
from barsight.core.stamps import NS_PER_S
from barsight.mapping.settings import MapSettings
from barsight.report.files.orthophoto import orthophoto, write_orthophoto
from barsight.result_folder import open_folder, read_heights
from barsight.viewer.yard_lines import yard_lines
from barsight.yard.inventory.bundle_file import write_bundles
from barsight.yard.lifting.lift_file import read_lifts
from lift_yards import laid, map_of
from mapping_views import block, fused, view
from yard_folders import STOCK, lifts, write_folder


def test_heights_come_back_as_they_were(tmp_path: Path) -> None:
    folder, heights = write_folder(tmp_path / "out"), map_of(STOCK)
    back = read_heights(folder)
    assert (back.x0_m, back.y0_m) == pytest.approx((heights.x0_m, heights.y0_m))
    assert back.shape == heights.shape
    for rows, columns in (
        (slice(0, back.shape[0]), slice(0, back.shape[1])), (slice(37, 300), slice(250, 260)),
    ):  # fmt: skip
        part, true = back.part(rows, columns), heights.part(rows, columns)
        assert (part.x0_m, part.y0_m) == pytest.approx((true.x0_m, true.y0_m))
        for name in ("z_m", "sigma_m", "views", "source"):
            np.testing.assert_array_equal(getattr(part, name), getattr(true, name))


def test_lifts_are_chosen_shown_and_drawn(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_folder(tmp_path / "out")
    assert lifts(folder) == 0
    assert "safest first" in capsys.readouterr().err
    written = read_lifts(folder / "lifts.json")
    assert sorted(lift["bundles"] for lift in written["lifts"]) == [[0], [1]]
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert "Bundles and lifts on the orthophoto" in page and ">#1</text>" in page
    assert page.count('class="shape"') == 2 * (2 * 5 + 2 * 4)
    lines = yard_lines(folder)
    assert lines["free"].shape == (24, 2, 3) and lines["poles"].shape == (2 * 4 * 12, 2, 3)
    assert lines["free"][..., 2].max() == pytest.approx(STOCK[0].top_z_m, abs=0.001)
    assert lines["poles"][..., 2].min() == pytest.approx(STOCK[0].top_z_m, abs=0.01)


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"age_s": 7200.0}, "map-too-old"),
        ({"age_s": -3600.0}, "map-from-the-future"),
        ({"reference": "world"}, "no-yard-frame"),
        ({"travel": None}, "trajectory-degraded"),
        ({"warnings": [{"code": "calibration", "message": "rows off"}]}, "calibration-drift"),
    ],
)
def test_what_result_says_vetoes_every_lift(
    tmp_path: Path, change: dict[str, object], code: str, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write_folder(tmp_path / "out", **change)  # type: ignore[arg-type]
    assert lifts(folder) == 0
    assert code in capsys.readouterr().err
    written = read_lifts(folder / "lifts.json")
    assert written["lifts"] == [] and len(written["refused"]) == 2
    assert code in [veto["code"] for veto in written["vetoes"]]
    assert "No lift is offered" in (folder / "report.html").read_text(encoding="utf-8")


def test_a_place_that_no_frame_surely_saw_is_not_lifted_from(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "out", more=(laid(3.5),))
    assert lifts(folder) == 0
    written = read_lifts(folder / "lifts.json")
    assert sorted(lift["bundles"] for lift in written["lifts"]) == [[0], [1]]
    (refused,) = written["refused"]
    assert refused["valid_until_ns"] is None and {veto["code"] for veto in refused["vetoes"]} == {
        "map-too-old"
    }


def test_without_a_magnet_nothing_is_offered(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_folder(tmp_path / "out")
    assert run(["lifts", str(folder)]) == 0
    assert "no-magnet" in capsys.readouterr().err
    written = read_lifts(folder / "lifts.json")
    assert written["lifts"] == [] and written["vetoes"][0]["code"] == "no-magnet"


def test_an_old_yard_can_be_looked_back_at(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_folder(tmp_path / "out", age_s=3e7)
    assert lifts(folder, "--at", "end") == 0
    assert "not for a crane" in capsys.readouterr().err
    assert "for review only. Never use these lifts at a crane." in (folder / "report.html").read_text()
    written = read_lifts(folder / "lifts.json")
    assert len(written["lifts"]) == 2
    assert written["judged_at_ns"] == written["captured_to_ns"] < time.time_ns() - 2e7 * NS_PER_S


def test_a_bundle_is_fetched_by_name_or_said_why_not(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write_folder(tmp_path / "out")
    assert lifts(folder, "--fetch", "1", "--max-stack-m", "3") == 0
    told = capsys.readouterr().err
    assert "Lifts that fetch bundle 1" in told and "Measure again after every lift" in told
    (step,) = read_lifts(folder / "lifts.json")["fetch"]["steps"]
    assert step["bundle"] == 1 and step["is_offered"] and step["travel_z_m"] == pytest.approx(3.5)
    before = {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}
    assert lifts(folder, "--fetch", "1,0") != 0
    said = capsys.readouterr().err
    assert said.count("not seen") == 2 and "no lifts were written" in said and said.count("\n") == 1
    assert {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()} == before


def test_fetching_a_bundle_that_there_is_not_is_one_line_and_writes_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write_folder(tmp_path / "out")
    assert lifts(folder, "--fetch", "7", "--lifted", "0") == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "--fetch 7" in said and "it has 2" in said
    assert not {"lifts.json", "report.html", "events.csv"} & {path.name for path in folder.iterdir()}


def test_an_empty_yard_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_folder(tmp_path / "out")
    _, identity = open_folder(folder)
    assert identity is not None
    write_bundles((), None, "yard", identity, folder / "bundles.json")
    assert lifts(folder) == 0
    assert "no lift is offered: no bundle was found" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["bundles.json", "height.tif", "result.json"])
@pytest.mark.parametrize("torn", [True, False])
def test_a_torn_folder_is_one_line(
    tmp_path: Path, name: str, torn: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write_folder(tmp_path / "out")
    if torn:
        (folder / name).write_bytes((folder / name).read_bytes()[:200])
    else:
        (folder / name).unlink()
    assert lifts(folder) == 3
    assert capsys.readouterr().err.count("\n") == 1
    assert not (folder / "lifts.json").exists()


def test_two_folders_compared(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    old, new = write_folder(tmp_path / "old"), write_folder(tmp_path / "new", shift_m=-0.08)
    assert run(["compare", str(old), str(new), "--json", str(tmp_path / "c.json")]) == 0
    assert "unchanged: 1 of 2 bundles" in capsys.readouterr().out
    changes = json.loads((tmp_path / "c.json").read_text())["changes"]
    assert [c["kind"] for c in changes] == ["moved", "same"]
    assert changes[0]["across_mm"] == pytest.approx(-80, abs=1) and changes[0]["significant"]


def test_a_map_of_its_own_frame_cannot_be_compared(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    old, new = write_folder(tmp_path / "old"), write_folder(tmp_path / "new", reference="world")
    assert run(["compare", str(old), str(new)]) == 5
    assert capsys.readouterr().err.count("\n") == 1


def test_the_orthophoto_lies_on_the_height_maps_grid(tmp_path: Path) -> None:
    x, y = block(40, 30, column=-7, row=5)
    surface = fused([view(x, y, 0.1 * np.ones(x.shape))], tmp_path / "tiles", MapSettings(min_views=1))
    write_orthophoto(surface, tmp_path, "yard:f00d")
    with tifffile.TiffFile(tmp_path / "ortho.tif") as file:
        page = file.pages.first
        assert page.asarray().shape == surface.shape and page.asarray().dtype == np.uint8
        assert page.tags["ModelPixelScaleTag"].value[:2] == (0.01, 0.01)
        tie = page.tags["ModelTiepointTag"].value
        assert tie[3:5] == pytest.approx((-0.075, 0.345))
        assert (page.asarray() == 100).all()
    picture = cv2.imread(str(tmp_path / "ortho.png"), cv2.IMREAD_GRAYSCALE)
    np.testing.assert_array_equal(picture, orthophoto(surface))
