"""The viewer: it starts, serves this machine, stops; its mistakes are one line."""

from __future__ import annotations

import http.client
import socket
import sys
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest

from barsight.cli.main import run
from barsight.core.errors import InputError, OutputError
from barsight.core.records.heights import HeightSource
from barsight.result_folder import read_cloud, read_heights
from barsight.viewer.cloud import SOURCE_RGB, colour_layer, seen_layer, surface_layer
from barsight.viewer.view import line_segments, serving, view
from result_folders import bands, surface_m, write_folder, write_height


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_folder(tmp_path_factory.mktemp("out"))


def get(url: str, **headers: str) -> tuple[int, bytes]:
    parts = urlsplit(url)
    connection = http.client.HTTPConnection(parts.hostname or "", parts.port, timeout=10)
    try:
        connection.request("GET", "/", headers=headers)
        answer = connection.getresponse()
        return answer.status, answer.read()
    finally:
        connection.close()


def test_it_serves_and_stops(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with serving(folder, 0) as url:
        status, body = get(url)
        assert status == 200
        assert b"<html" in body
        with (
            pytest.raises(OutputError, match=r"is taken; name another"),
            serving(folder, urlsplit(url).port or 0),
        ):
            pass
    with pytest.raises(ConnectionRefusedError):
        get(url)
    assert capsys.readouterr().out == ""


UPGRADE = {
    "Connection": "Upgrade", "Upgrade": "websocket", "Sec-WebSocket-Version": "13",
    "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==", "Sec-WebSocket-Protocol": "viser-v1.1.1",
}  # fmt: skip


def test_other_pages_in_the_browser_are_refused(folder: Path) -> None:
    """Origin and Host tell them: a name of another page's that was made to lead here."""
    with serving(folder, 0) as url:
        port = urlsplit(url).port
        assert get(url, Origin=url)[0] == get(url, Host=f"localhost:{port}")[0] == 200
        assert get(url, **UPGRADE, Origin=url)[0] == 101
        for foreign in ("https://evil.example", f"http://127.0.0.1:{(port or 0) + 1}", "null"):
            assert get(url, **UPGRADE, Origin=foreign)[0] == get(url, Origin=foreign)[0] == 403
        for host in (f"evil.example:{port}", "127.0.0.1", "127.0.0.1:1"):
            assert get(url, **UPGRADE, Host=host)[0] == get(url, Host=host)[0] == 403


def test_ctrl_c_ends_it(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    opened: list[str] = []

    def pressed(url: str) -> bool:
        opened.append(url)
        raise KeyboardInterrupt

    monkeypatch.setattr("barsight.viewer.view.webbrowser.open", pressed)
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    view(folder, port, True)
    assert opened == [f"http://127.0.0.1:{port}"]
    assert opened[0] in capsys.readouterr().out


def test_mistakes_are_one_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder"):
        view(tmp_path / "none", 0, False)
    folder = write_folder(tmp_path / "out")
    with pytest.raises(OutputError, match="port 70000"):
        view(folder, 70000, False)
    cloud = folder / "cloud.ply"
    whole = cloud.read_bytes()
    empty = whole[: whole.index(b"end_header") + 11].replace(b"vertex 5000", b"vertex 0")
    for torn in (b"", b"ply\n", whole[:-1000], whole.replace(b"sigma_z", b"sigma_q"), empty):
        cloud.write_bytes(torn)
        with pytest.raises(InputError, match=r"cloud\.ply"):
            view(folder, 0, False)
    cloud.unlink()
    with pytest.raises(InputError, match="no such file"):
        view(folder, 0, False)


def test_a_map_without_heights_is_shown_by_its_cloud(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "out")
    unknown = bands()
    unknown[:2], unknown[2:] = np.nan, 0
    write_height(folder / "height.tif", unknown)
    with serving(folder, 0) as url:
        assert get(url)[0] == 200


def test_a_missing_extra_is_named(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    monkeypatch.delitem(sys.modules, "barsight.viewer.view")
    assert run(["view", str(folder)]) == 2
    assert capsys.readouterr().err == "barsight: viser is not installed; run: pip install 'barsight[view]'\n"


def test_the_cloud_is_thinned_evenly(folder: Path) -> None:
    whole = read_cloud(folder / "cloud.ply", 10_000)
    thin = read_cloud(folder / "cloud.ply", 1700)
    assert whole.xyz_m.shape == (5000, 3)
    assert (thin.xyz_m.shape, thin.total) == ((1700, 3), 5000)
    np.testing.assert_array_equal(thin.xyz_m, whole.xyz_m[np.arange(1700) * 5000 // 1700])


@pytest.mark.parametrize("by", ["height", "intensity", "sigma", "views"])
def test_colours_follow_the_property(folder: Path, by: str) -> None:
    layer = seen_layer(read_cloud(folder / "cloud.ply", 10_000))
    painted = colour_layer(layer, by)
    assert painted.rgb.shape == (5000, 3)
    values = layer.properties[by]
    highest, lowest = int(np.argmax(values)), int(np.argmin(values))
    np.testing.assert_array_equal(painted.rgb[lowest], painted.ramp[0])
    if values[highest] > values[lowest]:
        np.testing.assert_array_equal(painted.rgb[highest], painted.ramp[255])


def test_the_surface_shows_filled_cells_and_says_so(folder: Path) -> None:
    """280 of 300 columns are known, a block of 10 x 10 cells among them is filled."""
    layer = surface_layer(read_heights(folder), 10**6)
    assert (layer.total, layer.xyz_m.shape) == (150 * 280, (150 * 280, 3))
    assert list(layer.properties) == ["height", "source", "sigma", "views"]
    np.testing.assert_allclose(layer.xyz_m[:, 2], surface_m(layer.xyz_m[:, 0].astype(np.float64)), atol=2e-3)
    painted = colour_layer(layer, "source")
    filled = (painted.rgb == SOURCE_RGB[HeightSource.FILLED][1]).all(axis=1)
    assert filled.sum() == 100
    assert (painted.rgb[~filled] == SOURCE_RGB[HeightSource.VISION][1]).all()
    assert painted.caption == "vision 99.8 %, filled 0.2 %"
    assert surface_layer(read_heights(folder), 1000).xyz_m.shape == (1000, 3)


def test_lines_are_open_where_unknown() -> None:
    points = np.array([[0, 0, 0], [1, 0, 0], [2, 0, np.nan], [3, 0, 0], [4, 0, 1.0]])
    np.testing.assert_array_equal(line_segments(points), [[[0, 0, 0], [1, 0, 0]], [[3, 0, 0], [4, 0, 1]]])
    assert 10_000 < len(line_segments(np.zeros((70_000, 3)))) <= 20_000
