"""Every format is read back by its own library and holds the same points."""

import sys
from pathlib import Path

import laspy
import numpy as np
import pye57
import pytest
from pypcd4 import PointCloud

from barsight.cli.main import run
from barsight.core.errors import ConfigError, InputError
from barsight.core.reading.ply import read_vertices
from barsight.report.export import export
from result_folders import CLOUD_POINT, write_points

COUNT = 500


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    rng = np.random.default_rng(4)
    points = np.empty(COUNT, CLOUD_POINT)
    points["x"], points["y"] = rng.uniform(-30, 35, COUNT), rng.uniform(-4, 4, COUNT)
    points["z"], points["sigma_z"] = rng.uniform(0, 2, COUNT), rng.uniform(0.001, 0.02, COUNT)
    points["intensity"], points["views"] = rng.integers(0, 256, COUNT), rng.integers(2, 30, COUNT)
    write_points(tmp_path / "cloud.ply", points)
    return tmp_path


def expected(folder: Path) -> np.ndarray:
    data = read_vertices(folder / "cloud.ply")
    return np.column_stack([data[n] for n in ("x", "y", "z", "intensity", "sigma_z", "views")]).astype(float)


def read_las(path: Path) -> np.ndarray:
    las = laspy.read(path)
    # Single returns, and the bit that LAS 1.4 requires of this point format: validators and PDAL want both.
    assert las.header.global_encoding.wkt and set(las.return_number) == set(las.number_of_returns) == {1}
    assert las.header.number_of_points_by_return[0] == len(las)
    return np.column_stack([las.x, las.y, las.z, np.asarray(las.intensity) / 257, las.sigma_z, las.views])


def read_e57(path: Path) -> np.ndarray:
    with pye57.E57(str(path)) as file:
        scan = file.read_scan_raw(0)
    return np.column_stack([scan[n] for n in ("cartesianX", "cartesianY", "cartesianZ", "intensity")])


READERS = {
    "las": read_las,
    "laz": read_las,
    "pcd": lambda path: PointCloud.from_path(path).numpy(),
    "e57": read_e57,
    "csv": lambda path: np.loadtxt(path, delimiter=",", skiprows=1),
}


@pytest.mark.parametrize("kind", READERS)
def test_the_points_come_back(folder: Path, kind: str) -> None:
    target = folder / f"points.{kind}"
    assert export(folder, target) == COUNT
    found = READERS[kind](target)
    np.testing.assert_allclose(found, expected(folder)[:, : found.shape[1]], atol=1.01e-4)


def test_ply_and_tif_are_the_folders_own(folder: Path) -> None:
    (folder / "height.tif").write_bytes(b"raster")
    export(folder, folder / "copy.ply")
    export(folder, folder / "copy.tif")
    assert (folder / "copy.ply").read_bytes() == (folder / "cloud.ply").read_bytes()
    assert (folder / "copy.tif").read_bytes() == b"raster"


def test_what_cant_be_exported(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"\.las \.laz"):
        export(folder, folder / "points.xyz")
    with pytest.raises(InputError, match="no such file; name a folder"):
        export(folder / "nowhere", folder / "points.las")
    with pytest.raises(InputError, match="no such file"):
        export(folder, folder / "copy.tif")
    assert run(["export", str(folder), str(folder / "contour.csv")]) == 4
    assert not (folder / "contour.csv").exists()
    assert not list(tmp_path.glob("*.part"))


@pytest.mark.parametrize(("package", "kind"), [("laspy", "laz"), ("pypcd4", "pcd"), ("pye57", "e57")])
def test_a_missing_extra_is_named(
    folder: Path, package: str, kind: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    before = sorted(folder.iterdir())
    assert run(["export", str(folder), str(folder / f"points.{kind}")]) == 2
    error = capsys.readouterr().err
    assert error == f"barsight: {package} is not installed; run: pip install 'barsight[export]'\n"
    assert sorted(folder.iterdir()) == before
    assert run(["export", str(folder), str(folder / "points.csv")]) == 0
