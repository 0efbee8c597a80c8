"""Every file of a measured folder names the frame of its places, and foreign frames aren't mixed."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile

from barsight.acceptance.budgets.error_sources import measured_load
from barsight.acceptance.watch.record import WatchedSurvey, WatchRecord, read_watch, with_survey, write_watch
from barsight.cli.main import run
from barsight.core.errors import InputError
from barsight.core.reading.ply import read_vertices
from barsight.core.reading.sealed_json import write_sealed
from barsight.report.export import export
from barsight.result_folder import read_contours, read_path
from barsight.store.adding import add_survey, read_survey
from barsight.store.opening import Store
from cli_runs import FAST
from yard_folders import write_folder


def named(folder: Path, name: str) -> str:
    """The frame that a file of any kind says."""
    path = folder / name
    if path.suffix == ".tif":
        with tifffile.TiffFile(path) as file:
            return str(file.pages.first.geotiff_tags["GTCitationGeoKey"])
    head = path.read_bytes()[:2000].decode("latin-1").splitlines()
    (line,) = (line for line in head if line.startswith(("comment frame", "# frame")))
    return line.split()[-1]


@pytest.mark.parametrize("arguments", [(), ("--use", "stereo")], ids=["yard", "world"])
def test_every_file_names_the_frame_of_result_json(
    whole: Path, tmp_path: Path, arguments: tuple[str, ...]
) -> None:
    out = tmp_path / "out"
    assert run(["measure", str(whole), "-o", str(out), *FAST, *arguments]) == 0
    result = json.loads((out / "result.json").read_text())
    placed = result["yard_frame_id"]
    assert result["frame_id"] == f"yard:{placed}" if placed else result["frame_id"].startswith("world:")
    files = ("trajectory.tum", "cloud.ply", "height.tif", "free.tif", "tops.tif", "ortho.tif")
    assert {named(out, name) for name in files} == {result["frame_id"]}
    path, (contour, *_) = read_path(out), read_contours(out)
    assert path is not None and len(path.stamp_ns) == 4 and len(contour.z_m) > 20
    assert len(read_vertices(out / "cloud.ply")) > 100
    export(out, out / "points.pcd")
    assert named(out, "points.pcd") == result["frame_id"]
    export(out, out / "points.csv")  # whose readers take the names from its first line
    points = np.genfromtxt(out / "points.csv", delimiter=",", names=True)
    assert points.dtype.names == ("x_m", "y_m", "z_m", "intensity", "sigma_m", "views")


def moved(folder: Path, frame: str) -> Path:
    """A folder whose result says another yard frame."""
    return write_folder(folder, yard_frame_id=frame)


def test_maps_of_two_yard_frames_are_not_compared(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    old, new = moved(tmp_path / "old", "f00d"), moved(tmp_path / "new", "beef")
    assert run(["compare", str(old), str(new)]) == 3
    said = capsys.readouterr().err
    assert "lies in another yard frame (beef) than" in said and "--same-yard" in said
    assert run(["compare", str(old), str(new), "--same-yard"]) == 0
    assert run(["compare", str(old), str(moved(tmp_path / "again", "f00d"))]) == 0


def test_a_store_holds_one_yard_frame_unless_told(store: Store, tmp_path: Path) -> None:
    add_survey(store, read_survey(moved(tmp_path / "old", "f00d")), "ann")
    new = read_survey(moved(tmp_path / "new", "beef"))
    with pytest.raises(InputError, match="than the store's newest survey"):
        add_survey(store, new, "ann")
    assert add_survey(store, new, "ann", same_yard=True).is_new


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"yard_frame_id": "beef"}, r"another yard frame \(beef; the folder has f00d\)"),
        ({"magnet_offset": {"x_m": 0.012}}, "was made with a magnet's offset"),
    ],
)
def test_a_certificate_of_another_frame_or_of_a_corrected_magnet_budgets_nothing(
    changed: dict[str, object], reason: str, tmp_path: Path
) -> None:
    """With an offset its touch-downs say what that left over, not how the magnet hangs."""
    folder = write_folder(tmp_path / "out")
    told = {
        "schema_version": 1,
        "calibration_id": "ca1b",
        "yard_frame_id": "f00d",
        "quantities": [],
        "plan": {},
    }
    write_sealed(told | changed, tmp_path / "certificate.json")
    with pytest.raises(InputError, match=reason):
        measured_load(folder, None, tmp_path / "certificate.json", 5.0)


def test_a_bundle_that_is_not_there_is_a_wrong_argument(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["budget", str(write_folder(tmp_path / "out")), "--bundle", "99"]) == 2
    assert "there is no bundle 99; bundles.json has " in capsys.readouterr().err


def test_a_watch_of_another_yard_frame_wants_an_approval(tmp_path: Path) -> None:
    path, first = tmp_path / "watch.json", WatchedSurvey("a", "1", "cal", (), "f00d")
    record = with_survey(WatchRecord(), first, path)
    with pytest.raises(InputError, match=r"lies in yard frame beef, but watch\.json watches f00d"):
        with_survey(record, replace(first, recording_id="2", yard_frame_id="beef"), path)
    older = replace(first, recording_id="2", yard_frame_id=None)
    assert len(with_survey(record, older, path).surveys) == 2
    write_watch(record, path)
    content = json.loads(path.read_text())
    del content["surveys"][0]["yard_frame_id"], content["content_sha256"]
    write_sealed(content, path)
    assert read_watch(path).surveys == (replace(first, yard_frame_id=None),)
