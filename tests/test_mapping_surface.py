"""The finished surface: windows over tile borders, filled gaps, the cloud."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from barsight.core.pose import Pose
from barsight.core.records.heights import HeightSource
from barsight.mapping.election.surface_election import SurfaceElection
from barsight.mapping.fusion import fuse_view
from barsight.mapping.observation import CellObservations
from barsight.mapping.settings import MapSettings
from barsight.mapping.surface.height_selection import ViewFrusta
from barsight.mapping.surface.hole_filling import bridge_gaps
from barsight.mapping.surface.surface import Layers, fill_gaps, read_tile
from barsight.mapping.tiles import TileStore
from mapping_views import FAR_CAMERA, block, fused, high_above, view


def height_at(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A height that tells every cell from its neighbours."""
    return 1 + 0.001 * (x % 50) + 0.0001 * (y % 40)


@pytest.mark.parametrize(
    ("column", "row", "columns", "rows"),
    [(-300, -280, 620, 600), (-10, -10, 20, 20), (250, 250, 12, 12), (-256, 0, 256, 1), (100, 100, 1, 1)],
)
def test_windows_over_tile_borders(tmp_path: Path, column: int, row: int, columns: int, rows: int) -> None:
    x, y = block(560, 540, -280, -270)
    surface = fused([view(x, y, height_at(x, y))], tmp_path)
    assert (surface.columns, surface.rows, surface.shape) == ((-280, 280), (-270, 270), (540, 560))
    assert surface.seen == x.size
    layers = surface.window(column, row, columns, rows)
    x, y = block(columns, rows, column, row)
    inside = (x >= -280) & (x < 280) & (y >= -270) & (y < 270)
    np.testing.assert_allclose(layers.z_m[inside], height_at(x, y)[inside], atol=1e-6)
    assert np.isnan(layers.z_m[~inside]).all()
    np.testing.assert_array_equal(layers.source, np.where(inside, HeightSource.VISION, HeightSource.UNKNOWN))
    np.testing.assert_array_equal(layers.views, inside)


def test_a_folder_used_again_shows_the_new_surface(tmp_path: Path) -> None:
    x, y = block(5, 5)
    first = fused([view(x, y, 1.0)], tmp_path)
    assert first.window(0, 0, 1, 1).z_m[0, 0] == 1
    assert fused([view(x, y, 2.0)], tmp_path).window(0, 0, 1, 1).z_m[0, 0] == 2


def test_the_intensity_is_that_of_the_elected_height(tmp_path: Path) -> None:
    """Two views of a bar at 150 and 160, one stray height at 20; a filled gap has no gray level."""
    x, y = block(9, 1)
    seen = x != 4
    views = [replace(view(x[seen], y[seen], 1.0), intensity=np.full(8, g, np.float32)) for g in (150, 160)]
    stray = replace(view(x[seen], y[seen], 3.0), intensity=np.full(8, 20, np.float32))
    surface = fused([*views, stray], tmp_path, MapSettings(min_views=2))
    layers = surface.window(0, 0, 9, 1)
    np.testing.assert_allclose(layers.intensity[seen], 155)
    assert layers.source[0, 4] == HeightSource.FILLED
    assert np.isnan(layers.intensity[0, 4])


def layers_of(z: np.ndarray, sigma: float = 0.01) -> Layers:
    """NaN is unknown, all else seen."""
    seen = np.isfinite(z)
    return Layers(
        z.astype(np.float32),
        np.where(seen, sigma, np.nan).astype(np.float32),
        seen.astype(np.float32),
        np.where(seen, HeightSource.VISION, HeightSource.UNKNOWN).astype(np.uint8),
        np.where(seen, 100, np.nan).astype(np.float32),
    )


def filled_slowly(z: np.ndarray, sigma: float, reach: int) -> tuple[np.ndarray, np.ndarray]:
    """Each unknown cell looks both ways along x and y; the narrower gap wins, that along x where both tie."""
    height, spread = np.full(z.shape, np.nan), np.full(z.shape, np.nan)
    for i, j in zip(*np.nonzero(np.isnan(z)), strict=True):
        best = None
        for di, dj in ((0, 1), (1, 0)):
            ends = []
            for way in (-1, 1):
                for k in range(1, reach + 1):
                    a, b = i + way * k * di, j + way * k * dj
                    if not (0 <= a < z.shape[0] and 0 <= b < z.shape[1]):
                        break
                    if np.isfinite(z[a, b]):
                        ends.append((k, z[a, b]))
                        break
            if len(ends) == 2 and (best is None or ends[0][0] + ends[1][0] < best[0][0] + best[1][0]):
                best = ends
        if best:
            (near, before), (far, after) = best
            height[i, j] = before + (after - before) * near / (near + far)
            spread[i, j] = np.hypot(sigma, abs(after - before) / 2)
    return height, spread


@pytest.mark.parametrize("reach", [1, 3])
def test_gaps_are_filled_between_two_seen_cells_only(reach: int) -> None:
    rng = np.random.default_rng(reach)
    z = np.where(rng.random((40, 50)) < 0.45, rng.uniform(0, 1, (40, 50)).astype(np.float32), np.nan)
    layers = layers_of(z)
    fill_gaps(layers, reach)
    height, spread = filled_slowly(z, 0.01, reach)
    filled = layers.source == HeightSource.FILLED
    np.testing.assert_array_equal(filled, np.isfinite(height))
    assert 100 < filled.sum() < np.isnan(z).sum()
    np.testing.assert_allclose(layers.z_m[filled], height[filled], atol=1e-6)
    np.testing.assert_allclose(layers.sigma_m[filled], spread[filled], atol=1e-6)
    seen = np.isfinite(z)
    np.testing.assert_array_equal(layers.z_m[seen], z[seen].astype(np.float32))
    assert (layers.source[seen] == HeightSource.VISION).all()
    unknown = ~seen & ~filled
    assert np.isnan(layers.z_m[unknown]).all()
    assert (layers.source[unknown] == HeightSource.UNKNOWN).all()
    assert (layers.views[~seen] == 0).all()


def test_nothing_is_extrapolated() -> None:
    z = np.full((9, 9), np.nan)
    z[3:6, 3:6] = 1.0
    layers = layers_of(z)
    fill_gaps(layers, 3)
    np.testing.assert_array_equal(layers.source == HeightSource.VISION, np.isfinite(z))
    assert (layers.source != HeightSource.FILLED).all()
    z = z.astype(np.float32)
    assert not bridge_gaps(z, np.ones_like(z), np.isfinite(z), 3).any()


def test_gaps_are_filled_across_tile_borders(tmp_path: Path) -> None:
    """A gap of 3 cells at the border of two tiles, and one of 7, which is too wide for 30 mm."""
    x, y = block(60, 10, 226, 0)
    gap = ((x >= 255) & (x < 258)) | ((x >= 270) & (x < 277))
    surface = fused(
        [view(x[~gap], y[~gap], 1 + 0.01 * x[~gap])], tmp_path, MapSettings(min_views=1, fill_m=0.03)
    )
    layers = surface.window(226, 0, 60, 10)
    narrow = (x >= 255) & (x < 258)
    assert (layers.source[narrow] == HeightSource.FILLED).all()
    np.testing.assert_allclose(layers.z_m[narrow], 1 + 0.01 * x[narrow], atol=1e-5)
    assert (layers.sigma_m[narrow] > 0.019).all()
    wide = (x >= 270) & (x < 277)
    assert (layers.source[wide] == HeightSource.UNKNOWN).all()
    assert (surface.seen, surface.filled) == ((~gap).sum(), narrow.sum())
    unfilled = fused([view(x[~gap], y[~gap], 1.0)], tmp_path / "b", MapSettings(min_views=1, fill_m=0.0))
    assert unfilled.filled == 0


def test_the_cloud_holds_every_supported_height(tmp_path: Path) -> None:
    """A floor under an overhang, both seen twice, and a single wrong height."""
    x, y = block(3, 2, -2, 255)
    views = [view(x, y, z) for z in (0.0, 0.0, 1.0, 1.0, 3.0)]
    surface = fused(views, tmp_path, MapSettings(min_views=2), cell_m=0.02)
    parts = list(surface.cloud())
    xyz = np.concatenate([part.xyz_m for part in parts])
    expected = [(0.02 * a, 0.02 * b, z) for z in (0, 1) for a, b in zip(x.ravel(), y.ravel(), strict=True)]
    order = np.lexsort(xyz.round(4).T)
    np.testing.assert_allclose(xyz[order], expected, atol=1e-6)
    assert all((part.views == 2).all() and (part.intensity == 100).all() for part in parts)
    sigma = np.concatenate([part.sigma_z_m for part in parts])
    np.testing.assert_allclose(sigma, np.sqrt(0.01**2 / 2 * 4 / 5), rtol=1e-3)
    np.testing.assert_allclose(surface.window(-2, 255, 3, 2).z_m, 1)


def test_the_cloud_agrees_with_the_surface_on_bars(tmp_path: Path) -> None:
    """Bars over a floor, across a tile's border: the surface's points are the surface's cells, and what lies
    beneath has the same part for blur."""
    rng = np.random.default_rng(2)
    x, y = block(60, 60, 230, 10)
    bars = 0.5 + np.sqrt(0.02**2 - (0.01 * x % 0.04 - 0.02) ** 2)
    noisy = (z + rng.normal(0, 0.0005, x.shape) for z in (0.0, bars) for _ in range(2))
    views = [view(x, y, z, 0.0005) for z in noisy]
    surface = fused(views, tmp_path, MapSettings(min_views=2, along_m=0.1))
    layers = surface.window(230, 10, 60, 60)
    xyz, sigma = (
        np.concatenate([getattr(part, name) for part in surface.cloud()]) for name in ("xyz_m", "sigma_z_m")
    )
    column, row = np.rint(xyz[:, :2].T / 0.01).astype(int) - [[230], [10]]
    top = xyz[:, 2] > 0.3
    assert top.sum() == (~top).sum() == 3600
    np.testing.assert_array_equal(xyz[top, 2], layers.z_m[row[top], column[top]])
    np.testing.assert_array_equal(sigma[top], layers.sigma_m[row[top], column[top]])
    assert np.median(sigma[top]) > 3 * 0.0005
    beneath = np.full((60, 60), np.nan)
    beneath[row[~top], column[~top]] = sigma[~top]
    np.testing.assert_allclose(beneath, layers.sigma_m, rtol=0.1)


def test_snapshots_change_nothing_and_stay_as_they_are(tmp_path: Path) -> None:
    """Views on a way, settled or with a snapshot after each: the last surface has the bytes of one without:
    what is left behind is settled and not elected anew, and the first snapshot still shows what it showed."""
    settings = MapSettings(along_m=0.1)
    rng = np.random.default_rng(5)
    views = []
    for step in range(6):
        x, y = block(300, 90, 200 * step, 200)
        bars = 0.5 + np.sqrt(0.03**2 - (0.01 * x % 0.06 - 0.03) ** 2)
        views += [view(x, y, bars + rng.normal(0, 0.002, x.shape), 0.002) for _ in range(2)]
    ends = {}
    settled: list[set[str]] = []
    for kind in ("once", "settled", "often"):
        folder = tmp_path / kind
        folder.mkdir()
        store, poses, shown = TileStore(folder, 64), [], []
        election = SurfaceElection(store, folder, 0.01, settings)
        for one in views:
            fuse_view(store, one, settings)
            poses.append(low_above(one))
            if kind == "settled":
                election.settle(2, partial(ViewFrusta.of, poses, CAMERA))
                settled.append({path.name for path in folder.glob("election_*/finished/*")})
            if kind == "often":
                shown.append(election.snapshot(2, ViewFrusta.of(poses, CAMERA)))
        if shown:
            first = shown[1].window(0, 200, 300, 90)
            assert np.isfinite(first.z_m).mean() > 0.9
            elected = [t.stat().st_ino for t in sorted(shown[-2].folder.glob("surface_0_*"))]
            assert elected == [t.stat().st_ino for t in sorted(shown[-1].folder.glob("surface_0_*"))]
        surface = election.finish(2, ViewFrusta.of(poses, CAMERA))
        clouds = [
            np.concatenate([getattr(p, n).ravel() for n in ("xyz_m", "sigma_z_m")]) for p in surface.cloud()
        ]
        files = {path.name: path.read_bytes() for path in surface.folder.glob("*.npy")}
        ends[kind] = surface, files, np.concatenate(clouds).tobytes()
        if shown:
            read_tile.cache_clear()
            np.testing.assert_array_equal(shown[1].window(0, 200, 300, 90).z_m, first.z_m)
    assert ends["once"][1:] == ends["settled"][1:] == ends["often"][1:]
    assert settled[0] == set() and "surface_0_0.npy" in settled[-1] and "surface_4_0.npy" not in settled[-1]
    assert len(ends["once"][1]) == len(surface.tiles) > 8
    assert ends["once"][0].seen == ends["often"][0].seen > 100_000
    assert replace(ends["once"][0], folder=tmp_path) == replace(ends["often"][0], folder=tmp_path)


CAMERA = replace(FAR_CAMERA, focal_px=1000.0, cx_px=150.0, cy_px=150.0, width=300, height=300)


def low_above(one: CellObservations) -> Pose:
    """A camera 10 m above a view's middle that sees 3 m."""
    pose = high_above(one, 0.01)
    return replace(pose, translation=np.array([*pose.translation[:2], 10.5]))
