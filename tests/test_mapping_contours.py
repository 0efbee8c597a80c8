"""Contours: exact on a plane, edges kept, the unknown kept unknown, samples where the laser has its own."""

from pathlib import Path

import numpy as np
import pytest

from barsight.core.records.heights import Contour, HeightSource
from barsight.core.records.sensor_samples import LaserProfile
from barsight.mapping.settings import MapSettings
from barsight.mapping.surface.contours import cut_contour, cut_contours, smooth_contour
from barsight.mapping.surface.surface import Surface
from mapping_views import block, fused, view

CELL_M = 0.01


def plane(x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
    return 1.0 + 0.3 * x_m - 0.2 * y_m


@pytest.fixture
def sloping(tmp_path: Path) -> Surface:
    x, y = block(120, 80, -60, -40)
    return fused([view(x, y, plane(x * CELL_M, y * CELL_M), shared_m=0.005)], tmp_path)


@pytest.mark.parametrize("y_m", [0.0, 0.123, -0.377, 0.385])
@pytest.mark.parametrize("phase_m", [0.0, 0.0037, -17.2949])
def test_a_plane_is_met_exactly(sloping: Surface, y_m: float, phase_m: float) -> None:
    contour = cut_contour(sloping, 3, y_m, phase_m)
    assert contour.profile == 3
    known = np.isfinite(contour.z_m)
    inside = (contour.x_m > -0.595) & (contour.x_m < 0.585)
    assert known[inside].all()
    np.testing.assert_allclose(np.diff(contour.x_m), 0.01, atol=1e-9)
    steps = (contour.x_m - phase_m) / 0.01
    np.testing.assert_allclose(steps, steps.round(), atol=1e-6)
    np.testing.assert_array_equal(contour.y_m, y_m)
    # Between the outermost cells' centres; outside them there is nothing to interpolate with.
    between = known & (contour.x_m >= -0.6) & (contour.x_m <= 0.59)
    assert between.sum() >= 118
    np.testing.assert_allclose(contour.z_m[between], plane(contour.x_m[between], y_m), atol=2e-6)
    np.testing.assert_allclose(contour.sigma_m[known], np.hypot(0.01, 0.005), rtol=1e-4)
    assert (contour.source[known] == HeightSource.VISION).all()


def test_an_edge_stays_an_edge(tmp_path: Path) -> None:
    """A step of 40 mm between two cells: every sample has one side's height, that of the nearest cell."""
    x, y = block(40, 10)
    surface = fused([view(x, y, np.where(x < 20, 1.0, 1.04))], tmp_path)
    contour = cut_contour(surface, 0, 0.053, 0.003)
    np.testing.assert_allclose(contour.z_m[:19], 1.0, atol=1e-6)
    known = np.isfinite(contour.z_m)
    expected = np.where(contour.x_m < 0.195, 1.0, 1.04)
    np.testing.assert_allclose(contour.z_m[known], expected[known], atol=1e-6)


def test_the_unknown_stays_unknown(tmp_path: Path) -> None:
    x, y = block(60, 10)
    hole = (x >= 20) & (x < 40)
    surface = fused([view(x[~hole], y[~hole], 1.0)], tmp_path, MapSettings(min_views=1, fill_m=0.03))
    contour = cut_contour(surface, 0, 0.05)
    inside = (contour.x_m > 0.196) & (contour.x_m < 0.394)
    assert inside.sum() == 20
    assert np.isnan(contour.z_m[inside]).all()
    assert np.isnan(contour.sigma_m[inside]).all()
    assert (contour.source[inside] == HeightSource.UNKNOWN).all()
    np.testing.assert_allclose(contour.z_m[~inside][:-1], 1.0)
    away = cut_contour(surface, 0, 5.0)
    assert np.isnan(away.z_m).all()


def test_filled_places_say_so(tmp_path: Path) -> None:
    x, y = block(60, 10)
    gap = (x >= 30) & (x < 32)
    surface = fused([view(x[~gap], y[~gap], 1.0)], tmp_path)
    contour = cut_contour(surface, 0, 0.05)
    filled = contour.source == HeightSource.FILLED
    np.testing.assert_allclose(contour.x_m[filled], [0.30, 0.31], atol=1e-9)
    np.testing.assert_allclose(contour.z_m[filled], 1.0, atol=1e-6)


def laser(profile: int, y_m: float, first_x_m: float) -> LaserProfile:
    x = first_x_m + 0.01 * np.arange(30)
    return LaserProfile(profile, x, np.full(30, y_m), np.zeros(30), 0.001)


def test_where_contours_are_cut(sloping: Surface) -> None:
    profiles = (laser(0, 0.1, -0.2043), laser(7, -0.2, 0.0))
    at_laser = cut_contours(sloping, profiles, ())
    assert [(c.profile, c.y_m[0]) for c in at_laser] == [(0, 0.1), (7, -0.2)]
    for contour, profile in zip(at_laser, profiles, strict=True):
        nearest = np.abs(contour.x_m[:, None] - profile.x_m).min(axis=0)
        np.testing.assert_allclose(nearest, 0, atol=1e-9)
        assert len(contour.x_m) >= 119
    asked = cut_contours(sloping, profiles, (0.05, 0.06))
    assert [(c.profile, c.y_m[0]) for c in asked] == [(8, 0.05), (9, 0.06)]
    (middle,) = cut_contours(sloping, (), ())
    assert middle.y_m[0] == pytest.approx(-0.005)


def test_an_empty_surface_has_empty_contours(tmp_path: Path) -> None:
    surface = fused([], tmp_path)
    contour = cut_contour(surface, 0, 0.0)
    assert np.isnan(contour.z_m).all()


@pytest.mark.parametrize("cell_m", [0.02, 0.05])
def test_coarser_cells(tmp_path: Path, cell_m: float) -> None:
    """Samples every 10 mm whatever the cell's side."""
    x, y = block(60, 20)
    surface = fused([view(x, y, plane(x * cell_m, y * cell_m))], tmp_path, cell_m=cell_m)
    contour = cut_contour(surface, 0, 0.17)
    between = (contour.x_m >= 0) & (contour.x_m <= 59 * cell_m)
    assert between.sum() == round(59 * cell_m / 0.01) + 1
    np.testing.assert_allclose(contour.z_m[between], plane(contour.x_m[between], 0.17), atol=1e-5)


def test_the_papers_contour_fills_gaps_and_says_so(tmp_path: Path) -> None:
    """A plane with a hole of 20 cells and one spike: the plane again, the hole flagged and unsure."""
    x, y = block(80, 10)
    hole = (x >= 30) & (x < 50)
    z = plane(x * CELL_M, y * CELL_M) + np.where(x == 10, 0.02, 0.0)
    surface = fused([view(x[~hole], y[~hole], z[~hole])], tmp_path, MapSettings(min_views=1, fill_m=0))
    raw = cut_contour(surface, 0, 0.05)
    contour = smooth_contour(raw)
    np.testing.assert_allclose(contour.z_m[3:-3], plane(contour.x_m[3:-3], 0.05), atol=0.003)
    filled = np.isnan(raw.z_m) & (raw.x_m < 0.6)
    assert filled.sum() == 20
    assert (contour.source[filled] == HeightSource.FILLED).all()
    np.testing.assert_array_equal(contour.source[~filled], raw.source[~filled])
    assert contour.sigma_m[filled].min() > 0.5 * 0.3 * 0.19
    lonely = Contour(0, raw.x_m, raw.y_m, np.full_like(raw.z_m, np.nan), raw.sigma_m, raw.source)
    assert smooth_contour(lonely) is lonely
