"""The report page: what it says, what it shows, that it asks nobody for anything."""

from __future__ import annotations

import json
import re
import tracemalloc
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from barsight.core.errors import InputError, OutputError
from barsight.core.records.heights import Contour, HeightSource
from barsight.core.records.sensor_samples import LaserProfile
from barsight.report.map_images import cut_strips, hillshade, paint_height, read_raster
from barsight.report.page import format_number, render_page, write_report
from barsight.report.page_trajectory import turned_since_start_deg
from barsight.report.plots import contour_plot, keep_extremes, pair_with_laser
from barsight.result_folder import CameraPath, read_contours, read_laser
from result_folders import BIAS_MM, CELL_M, LEFT_M, TOP_M, bands, summary, write_folder, write_height


class Page(HTMLParser):
    """Text outside of scripts, the ids, and every address that the browser would ask for."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.addresses: list[str] = []
        self.ids: set[str] = set()
        self.scripts: list[str] = []
        self.text = ""
        self._inside = ""
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self._inside = tag
        if tag == "script":
            self.scripts.append("")
        for key, value in attrs:
            if key in ("src", "href", "srcset", "action", "data", "poster", "xlink:href"):
                self.addresses.append(value or "")
            if key == "id":
                self.ids.add(value or "")

    def handle_data(self, data: str) -> None:
        if self._inside == "script":
            self.scripts[-1] += data
        elif self._inside != "style":
            self.text += data

    def handle_endtag(self, tag: str) -> None:
        self._inside = ""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_folder(tmp_path_factory.mktemp("out"))


@pytest.fixture(scope="module")
def html(folder: Path) -> str:
    return render_page(folder)


@pytest.fixture(scope="module")
def page(html: str) -> Page:
    return Page(html)


def figures(page: Page) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(page.scripts[1])
    return found


def test_the_page_names_the_key_figures(page: Page) -> None:
    for text in (
        "12 of 14",
        "2 refused",
        "2.75\u00a0m",
        "6.0\u00a0mm",
        "3.0\u00a0mm with steps and gullies",
        "2.0\u00a0mm with steps and gullies",
        "1\u202f512\u00a0MiB",
        "SIMULATED",
    ):
        assert text in page.text
    assert "frames-refused" in page.text
    assert "cam1: <png> is cut short" in page.text
    assert "Against the truth" in page.text and "median / mm" in page.text
    assert "smooth.median_mm" not in page.text
    assert "6.2" in page.text and "97.0" in page.text


def test_every_address_is_in_the_page_itself(page: Page, html: str) -> None:
    assert page.addresses
    assert [a for a in page.addresses if not a.startswith("data:")] == []
    own = html.replace(page.scripts[0], "")
    assert "http" not in re.sub(r"data:[^\"]*", "", own)
    assert "@import" not in own
    assert "url(" not in own.replace("url(#unknown)", "")


def test_plotly_is_carried_once_and_sends_nothing(page: Page) -> None:
    assert [len(script) > 1_000_000 for script in page.scripts] == [True, False, False]
    assert 'plotlyServerURL: ""' in page.scripts[2]
    assert "modeBarButtons:" in page.scripts[2]


def test_every_figure_has_its_place(page: Page) -> None:
    names = {"contour-0", "contour-1", "histogram", "limits", "path-above", "path-time"}
    assert set(figures(page)) == names
    assert names <= page.ids
    assert {"map-height", "map-sigma", "map-views", "map-source", "preview", "provenance"} <= page.ids


def test_what_the_input_says_is_escaped(tmp_path: Path) -> None:
    evil = "</script><script>alert(1)</script><b>"
    changes = {
        "recording": {"path": evil, "format": evil},
        "warnings": [{"code": evil, "message": evil}],
        "configuration": {evil: evil},
        "stages": [{"name": evil, "seconds": 1.0, "frames": 1}],
        "reference": evil,
    }
    page = Page(render_page(write_folder(tmp_path, **changes)))
    assert len(page.scripts) == 3
    assert page.text.count(evil) >= 6
    assert figures(page)


def test_a_world_without_laser_says_so(tmp_path: Path) -> None:
    page = Page(render_page(write_folder(tmp_path, laser=False, reference="world", is_simulated=False)))
    assert "no laser profiles" in page.text
    assert "SIMULATED" not in page.text
    assert set(figures(page)) == {"contour-0", "contour-1", "path-above", "path-time"}


def test_the_summary_alone_makes_a_page(tmp_path: Path) -> None:
    (tmp_path / "result.json").write_text(json.dumps(summary() | {"agreement": [], "stages": []}))
    page = Page(render_page(tmp_path))
    assert "no height.tif" in page.text
    assert figures(page) == {}


@pytest.mark.parametrize(
    "change", [{"vetoes": 1}, {"vetoes": [1]}, {"passes": [{"number": 1}]}, {"passes": [None]}]
)
def test_a_summary_that_is_not_as_its_schema_says_is_refused(tmp_path: Path, change: dict[str, Any]) -> None:
    (tmp_path / "result.json").write_text(json.dumps(summary() | change))
    with pytest.raises(InputError, match=next(iter(change))):
        render_page(tmp_path)


def test_a_missing_number_is_a_dash(tmp_path: Path) -> None:
    lacking = summary()
    lacking["map"]["median_sigma_m"] = None
    lacking["agreement"][0]["bias_mm"] = None
    assert "Median sigma–" in Page(render_page(write_folder(tmp_path, **lacking))).text.replace("\n", "")
    assert format_number(float("nan")) == format_number("text") == format_number(True) == "–"
    assert format_number(-1234.56, 1, "mm") == "−1\u202f234.6\u00a0mm"


def test_mistakes_are_one_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder"):
        write_report(tmp_path / "none", tmp_path / "report.html")
    with pytest.raises(InputError, match=r"has no result\.json"):
        write_report(tmp_path, tmp_path / "report.html")
    (tmp_path / "result.json").write_text("{")
    with pytest.raises(InputError, match="is not a JSON file"):
        write_report(tmp_path, tmp_path / "report.html")
    folder = write_folder(tmp_path / "out")
    whole = (folder / "height.tif").read_bytes()
    for torn in (whole[:100], whole[: len(whole) // 2], b"no tiff at all"):
        (folder / "height.tif").write_bytes(torn)
        with pytest.raises(InputError, match=r"height\.tif: is damaged"):
            write_report(folder, tmp_path / "report.html")
    write_height(folder / "height.tif", bands()[:3])
    with pytest.raises(InputError, match=r"height\.tif: has the shape .*, not 4 planar bands in tiles"):
        write_report(folder, tmp_path / "report.html")
    (folder / "height.tif").unlink()
    preview = (folder / "preview.png").read_bytes()
    for cut in (b"", preview[:30]):
        (folder / "preview.png").write_bytes(cut)
        with pytest.raises(InputError, match=r"preview\.png: is (empty|a PNG cut short)"):
            write_report(folder, tmp_path / "report.html")
    (folder / "preview.png").unlink()
    for name, text in (
        ("contour.csv", "a\n1,2\n"),
        ("contour.csv", "a\n0,1,x\n"),
        ("trajectory.tum", "1 2\n"),
    ):
        kept = (folder / name).read_text()
        (folder / name).write_text(text)
        with pytest.raises(InputError, match=name):
            write_report(folder, tmp_path / "report.html")
        (folder / name).write_text(kept)
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError):
        write_report(folder, tmp_path / "file" / "report.html")
    assert not list(tmp_path.glob("*.html")) and not list(tmp_path.glob(".*"))


def test_the_raster_is_the_map(folder: Path) -> None:
    raster = read_raster(folder / "height.tif")
    z, sigma, views, source = bands()
    assert (raster.step, raster.cell_m, raster.left_m, raster.top_m) == (1, CELL_M, LEFT_M, TOP_M)
    np.testing.assert_array_equal(raster.z_m, z)
    np.testing.assert_array_equal(raster.sigma_m, sigma)
    np.testing.assert_array_equal(raster.source, source)
    np.testing.assert_array_equal(np.isnan(raster.views), views == 0)
    picture = paint_height(raster, 0.0, 0.5)
    np.testing.assert_array_equal(picture[..., 3] == 0, source == HeightSource.UNKNOWN)
    seen, filled = picture[65, 95, :3].astype(int), picture[65, 105, :3].astype(int)
    assert np.abs(seen - filled).max() > 60


@pytest.mark.parametrize("shape", [(240, 14_000), (1600, 2300)])
def test_a_large_map_is_averaged(tmp_path: Path, shape: tuple[int, int]) -> None:
    draw = np.random.default_rng(3)
    layers = draw.uniform(1.0, 2.0, (4, *shape)).astype(np.float32)
    layers[3] = draw.choice([0, 1, 3], shape, p=[0.5, 0.3, 0.2])
    layers[0, layers[3] == 0] = np.nan
    write_height(tmp_path / "height.tif", layers, tile=256)
    raster = read_raster(tmp_path / "height.tif")
    step = raster.step
    assert step > 1
    assert raster.z_m.shape == (-(-shape[0] // step), -(-shape[1] // step))
    for row, column in ((0, 0), (raster.z_m.shape[0] - 1, raster.z_m.shape[1] - 1), (13, 401)):
        block = layers[:, row * step : (row + 1) * step, column * step : (column + 1) * step]
        counts = [(block[3] == code).sum() for code in (1, 2, 3)]
        expected = np.nanmean(block[0]) if np.isfinite(block[0]).any() else np.nan
        assert raster.z_m[row, column] == pytest.approx(expected, abs=1e-6, nan_ok=True)
        assert raster.source[row, column] == (1 + int(np.argmax(counts)) if any(counts) else 0)
    strips = cut_strips(paint_height(raster, 1.0, 2.0), raster, lossless=False)
    assert strips[0].x_min_m == LEFT_M
    assert strips[-1].x_max_m == pytest.approx(LEFT_M + raster.z_m.shape[1] * raster.cell_m)
    assert (len(strips) > 1) == (shape[1] / shape[0] > 7)


def test_reading_a_large_map_takes_little_memory(tmp_path: Path) -> None:
    layers = np.ones((4, 1000, 12_000), np.float32)
    write_height(tmp_path / "height.tif", layers, tile=256)
    tracemalloc.start()
    read_raster(tmp_path / "height.tif")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 0.75 * layers.nbytes


def test_a_slope_towards_the_lamp_is_bright() -> None:
    x = np.arange(20, dtype=np.float32) * 0.01
    rising = np.tile(x * 0.3, (20, 1)).astype(np.float32)
    assert np.allclose(hillshade(np.zeros((20, 20), np.float32), 0.01), 1)
    assert hillshade(rising, 0.01)[10, 10] > 1.1
    assert hillshade(-rising, 0.01)[10, 10] < 0.9
    assert hillshade(-rising.T.copy(), 0.01)[10, 10] < hillshade(rising.T.copy(), 0.01)[10, 10]
    # A slope that the heights' noise may make is hardly shaded, one of bars as ever.
    for slope, sigma_m, ratio in ((0.05, 0.008, 0.1), (0.5, 0.008, 0.85), (0.05, 0.0005, 0.9)):
        plain, unsure = (hillshade(rising * slope / 0.3, 0.01, s)[10, 10] - 1 for s in (0.0, sigma_m))
        assert unsure / plain == pytest.approx(ratio, abs=0.1)


def test_the_difference_is_the_bias(folder: Path) -> None:
    compared = pair_with_laser(read_contours(folder), read_laser(folder))
    for item, bias in zip(compared, BIAS_MM, strict=True):
        known = item.error_m[np.isfinite(item.error_m)] * 1e3
        assert known.size == 280 - 14
        np.testing.assert_allclose(known, bias, atol=0.011)
        traces = {trace["name"]: trace for trace in contour_plot(item).traces}
        assert len(traces["filled"]["x"]) == 4
        assert traces["vision"]["y"].count(None) == 14
        assert traces["± 1.96 sigma"]["x"].count(None) == 2


def test_a_long_contour_keeps_its_extremes() -> None:
    draw = np.random.default_rng(0)
    z = draw.normal(0, 0.01, 70_001)
    z[30_000:31_000] = np.nan
    z[12_345], z[54_321] = 3.0, -3.0
    kept = keep_extremes(z, 20_000)
    assert 15_000 < kept.size <= 20_000
    assert (np.diff(kept) > 0).all()
    assert {12_345, 54_321} <= set(kept.tolist())
    assert np.isnan(z[kept]).sum() > 100
    np.testing.assert_array_equal(keep_extremes(z[:500], 20_000), np.arange(500))
    x = np.arange(z.size) * 0.01
    contour = Contour(0, x, 0 * x, z, 0 * x + 0.01, np.where(np.isnan(z), 0, 1).astype(np.uint8))
    laser = LaserProfile(0, x, 0 * x, 0 * x, 0.001)
    plot = contour_plot(pair_with_laser((contour,), (laser,))[0])
    assert "70001 samples" in plot.caption
    assert max(len(trace["x"]) for trace in plot.traces if trace["name"] == "vision") <= 20_000


def test_a_turn_beyond_half_a_circle_goes_on() -> None:
    angle = np.radians(np.linspace(0, 500, 51))
    attitude = np.stack([0 * angle, 0 * angle, np.sin(angle / 2), np.cos(angle / 2)], axis=1)
    path = CameraPath(np.arange(51), np.zeros((51, 3)), attitude)
    expected = np.stack([0 * angle, 0 * angle, np.degrees(angle)], axis=1)
    np.testing.assert_allclose(turned_since_start_deg(path), expected, atol=1e-6)
