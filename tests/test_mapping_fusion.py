"""Fusion of views: means and variances by the book, outliers outvoted, and a sigma that covers."""

from pathlib import Path

import numpy as np
import pytest

from barsight.core.errors import ConfigError
from barsight.core.records.heights import HeightSource
from barsight.mapping.fusion import PRIOR_VIEWS
from barsight.mapping.settings import MapSettings
from barsight.mapping.tiles import SLOTS, TILE_CELLS, VIEWS, TileStore, Z
from mapping_views import block, fused, view

PATCH_X, PATCH_Y = block(21, 21, -10, -10)
"""A patch of like cells about the one looked at: a lonely cell is no surface."""


def at_origin(heights: list[tuple[float, float]], folder: Path, **settings: float) -> tuple[float, ...]:
    """(z, sigma, views) of one cell from (height, sigma) views."""
    surface = fused(
        (view(PATCH_X, PATCH_Y, z, sigma) for z, sigma in heights),
        folder,
        MapSettings(**{"min_views": 1, **settings}),
    )
    layers = surface.window(0, 0, 1, 1)
    return float(layers.z_m[0, 0]), float(layers.sigma_m[0, 0]), int(layers.views[0, 0])


def test_views_that_agree_give_the_weighted_mean(tmp_path: Path) -> None:
    heights = [(1.00, 0.01), (1.02, 0.02), (0.99, 0.01)]
    z, sigma, views = at_origin(heights, tmp_path)
    values, weights = np.array([h for h, _ in heights]), np.array([s**-2 for _, s in heights])
    mean = np.average(values, weights=weights)
    squares = (weights * (values - mean) ** 2).sum()
    scatter = (PRIOR_VIEWS + squares) / (PRIOR_VIEWS + 2)
    assert z == pytest.approx(mean, abs=1e-6)
    assert sigma == pytest.approx(np.sqrt(scatter / weights.sum()), rel=1e-4)
    assert views == 3


def test_the_shared_part_doesnt_average_out(tmp_path: Path) -> None:
    views = [view(PATCH_X, PATCH_Y, 1.0, 0.01, shared_m=0.03) for _ in range(100)]
    sigma = fused(views, tmp_path).window(0, 0, 1, 1).sigma_m[0, 0]
    noise = 0.01**2 / 100 * PRIOR_VIEWS / (PRIOR_VIEWS + 99)
    assert sigma == pytest.approx(np.sqrt(noise + 0.03**2), rel=1e-4)


@pytest.mark.parametrize("place", [0, 2, 5])
@pytest.mark.parametrize("wild", [5.0, -3.0])
def test_an_outlier_is_outvoted(tmp_path: Path, place: int, wild: float) -> None:
    heights = [(1.0, 0.01)] * 5
    heights.insert(place, (wild, 0.01))
    z, _, views = at_origin(heights, tmp_path, min_views=2)
    assert z == pytest.approx(1.0)
    assert views == 5


def test_many_different_outliers_dont_fill_the_cell(tmp_path: Path) -> None:
    """More wrong heights than a cell holds; the surface still finds room among them."""
    heights = [(2.0 + k, 0.01) for k in range(6)]
    for k in range(4):
        heights.insert(2 * k, (1.0, 0.01))
    z, _, views = at_origin(heights, tmp_path, min_views=2)
    assert z == pytest.approx(1.0)
    assert views >= 3


def test_the_highest_supported_height_wins(tmp_path: Path) -> None:
    """A bar over a floor that is seen past it more often, but not a height with too few views."""
    floor, bar = [(0.0, 0.01)] * 10, [(1.0, 0.01)]
    assert at_origin(floor + bar * 4, tmp_path / "a", own_ratio=0.25, along_ratio=1.0)[0] == pytest.approx(
        1.0
    )
    assert at_origin(floor + bar * 3, tmp_path / "b", own_ratio=0.25, along_ratio=1.0)[0] == pytest.approx(
        0.0
    )


def test_too_few_views_are_unknown(tmp_path: Path) -> None:
    surface = fused([view(PATCH_X, PATCH_Y, 1.0)], tmp_path, MapSettings(min_views=2))
    layers = surface.window(0, 0, 1, 1)
    assert np.isnan(layers.z_m).all()
    assert np.isnan(layers.sigma_m).all()
    assert layers.source[0, 0] == HeightSource.UNKNOWN
    assert surface.seen == 0
    assert surface.shape == (0, 0)


def test_the_order_of_consistent_views_doesnt_matter(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    x, y = block(40, 30)
    truth = rng.uniform(0, 2, x.shape)
    views = [view(x, y, truth + rng.normal(0, s / 3, x.shape), s) for s in rng.uniform(0.005, 0.02, 8)]
    one = fused(views, tmp_path / "a").window(0, 0, 40, 30)
    other = fused([views[k] for k in rng.permutation(8)], tmp_path / "b").window(0, 0, 40, 30)
    np.testing.assert_array_equal(one.views, 8)
    np.testing.assert_array_equal(other.views, 8)
    np.testing.assert_allclose(one.z_m, other.z_m, atol=2e-6)
    np.testing.assert_allclose(one.sigma_m, other.sigma_m, rtol=1e-3)


def voted_slowly(heights: list[tuple[float, float]], settings: MapSettings) -> tuple[float, int]:
    """One cell's votes and election, as the module's first lines say it: (z, views)."""
    kept: list[list[float]] = []
    for z, sigma in heights:
        near = [
            k
            for k in kept
            if abs(k[0] - z) <= max(settings.gate_sigma * np.sqrt(sigma**2 + 1 / k[1]), settings.min_gate_m)
        ]
        if near:
            nearest = min(near, key=lambda k: abs(k[0] - z))
            weight = nearest[1] + sigma**-2
            nearest[:] = [(nearest[0] * nearest[1] + z / sigma**2) / weight, weight, nearest[2] + 1]
        elif len(kept) < SLOTS:
            kept.append([z, sigma**-2, 1])
        else:
            weakest = min(kept, key=lambda k: k[2])
            if weakest[2] == 1:
                weakest[:] = [z, sigma**-2, 1]
    return max(kept)[0], int(max(kept)[2])


def test_the_kernels_agree_with_the_slow_reference(tmp_path: Path) -> None:
    rng = np.random.default_rng(9)
    settings = MapSettings(min_views=1, own_ratio=0.01, fill_m=0)
    x, y = block(200, 5)
    level = rng.choice(
        [0.0, 0.4, 0.8, 1.2, 1.6, 2.0, 2.4], (12, 5, 200), p=[0.3, 0.3, 0.1, 0.1, 0.1, 0.05, 0.05]
    )
    z = (level + rng.uniform(-0.01, 0.01, level.shape)).astype(np.float32)
    sigmas = rng.uniform(0.01, 0.03, 12)
    layers = fused((view(x, y, one, s) for one, s in zip(z, sigmas, strict=True)), tmp_path, settings).window(
        0, 0, 200, 5
    )
    for i in range(5):
        for j in range(200):
            heights = list(zip(z[:, i, j].tolist(), sigmas.tolist(), strict=True))
            expected = voted_slowly(heights, settings)
            assert layers.z_m[i, j] == pytest.approx(expected[0], abs=1e-5)
            assert layers.views[i, j] == expected[1]


@pytest.mark.parametrize("count", [2, 4, 12])
@pytest.mark.parametrize("shared_m", [0.0, 0.004])
def test_the_stated_sigma_covers(tmp_path: Path, count: int, shared_m: float) -> None:
    """95 % of the heights lie within 1.96 sigma of the truth. Each cell draws its own shared error here, so
    that many of them are tried.
    """
    rng = np.random.default_rng(count)
    x, y = block(100, 100)
    truth = rng.uniform(0, 1, x.shape)
    common = rng.normal(0, shared_m, x.shape) if shared_m else 0.0
    sigmas = rng.uniform(0.006, 0.02, count)
    views = [view(x, y, truth + common + rng.normal(0, s, x.shape), s, shared_m) for s in sigmas]
    layers = fused(views, tmp_path, MapSettings(min_views=2)).window(0, 0, 100, 100)
    known = np.isfinite(layers.z_m)
    assert known.mean() > 0.97
    covered = np.abs(layers.z_m - truth) <= 1.96 * layers.sigma_m
    assert 0.92 <= covered[known].mean() <= 0.98


def test_views_that_scatter_more_than_they_state_widen_the_sigma(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    x, y = block(60, 60)
    views = [view(x, y, rng.normal(1, 0.02, x.shape), 0.01) for _ in range(20)]
    layers = fused(views, tmp_path, MapSettings(gate_sigma=10)).window(0, 0, 60, 60)
    assert np.median(layers.sigma_m) == pytest.approx(0.02 / np.sqrt(20), rel=0.15)


def test_tiles_on_disk_are_the_tiles_in_memory(tmp_path: Path) -> None:
    rng = np.random.default_rng(6)
    views = []
    for k in range(6):
        x, y = block(700, 20, column=-400 + 60 * k, row=250)
        views.append(view(x, y, 1 + rng.normal(0, 0.01, x.shape)))
    whole = fused(views, tmp_path / "a")
    spilled = fused(views, tmp_path / "b", resident=1)
    assert len(whole.tiles) > 6
    assert (whole.tiles, whole.columns, whole.rows, whole.seen) == (
        spilled.tiles,
        spilled.columns,
        spilled.rows,
        spilled.seen,
    )
    for name in ("z_m", "sigma_m", "views", "source"):
        one, other = (getattr(s.window(-450, 230, 1200, 60), name) for s in (whole, spilled))
        np.testing.assert_array_equal(one, other)
    for one, other in zip(whole.cloud(), spilled.cloud(), strict=True):
        np.testing.assert_array_equal(one.xyz_m, other.xyz_m)
        np.testing.assert_array_equal(one.sigma_z_m, other.sigma_z_m)


def test_a_store_holds_no_more_than_it_may(tmp_path: Path) -> None:
    store = TileStore(tmp_path, resident=2)
    for k in range(5):
        tile = store.take((k, 0))
        assert tile.shape[:2] == (TILE_CELLS, TILE_CELLS)
        tile[3, 4, 0, Z], tile[3, 4, 0, VIEWS] = k, 1
        assert len(list(tmp_path.rglob("*.npy"))) == max(k - 1, 0)
    assert store.keys() == [(k, 0) for k in range(5)]
    assert [float(store.take((k, 0))[3, 4, 0, Z]) for k in range(5)] == [0, 1, 2, 3, 4]
    store.clear()
    assert store.keys() == [] and not list(tmp_path.rglob("*.npy"))
    assert not store.take((1, 0)).any()


@pytest.mark.parametrize(
    "setting",
    [
        {"cell_m": 0.0},
        {"min_views": 0},
        {"resident_tiles": 1},
        {"top_ratio": 0.0},
        {"fill_m": -1.0},
        {"along_m": -1.0},
    ],
)
def test_settings_out_of_range_are_refused(setting: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match=next(iter(setting))):
        MapSettings(**setting)
