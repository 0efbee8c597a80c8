"""Triangulation: points back to their pixels, and errors as large as the stated sigma."""

import numpy as np
import pytest

from barsight.core.records.disparity import Disparity
from barsight.core.records.pairs import RectifiedPair
from barsight.stereo.triangulation import refine_grid, triangulate_disparity
from synthetic_scenes import slanted_pair


def disparity(values: np.ndarray, sigma: float = 0.3, bias: float = 0.0) -> Disparity:
    known = np.where(np.isfinite(values), sigma, np.nan)
    return Disparity(values.astype(np.float32), known.astype(np.float32), bias)


@pytest.fixture(scope="module")
def scene() -> tuple[RectifiedPair, np.ndarray]:
    return slanted_pair(doffs_px=4.5)


def pixels_of(points: np.ndarray, pair: RectifiedPair) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    camera = pair.camera
    x, y, z = points.astype(np.float64).T
    u, v = camera.focal_px * x / z + camera.cx_px, camera.focal_px * y / z + camera.cy_px
    return u, v, camera.focal_px * camera.baseline_m / z - camera.doffs_px


@pytest.mark.parametrize("per_pixel", [1, 2, 3])
def test_points_project_back(scene: tuple[RectifiedPair, np.ndarray], per_pixel: int) -> None:
    """Sub-pixel points lie on the same plane, evenly within their pixels."""
    pair, truth = scene
    points = triangulate_disparity(pair, disparity(truth), 0.1, per_pixel=per_pixel)
    assert len(points.xyz_m) == truth.size * per_pixel**2
    u, v, d = pixels_of(points.xyz_m, pair)
    steps = [(np.arange(n * per_pixel) + 0.5) / per_pixel - 0.5 for n in (240, 160)]
    expected_u, expected_v = (a.ravel() for a in np.meshgrid(*steps))
    np.testing.assert_allclose(u, expected_u, atol=1e-3)
    np.testing.assert_allclose(v, expected_v, atol=1e-3)
    inner = (u > 0) & (u < 239) & (v > 0) & (v < 159)
    plane = 20.3 + 0.02 * u + 0.01 * v
    np.testing.assert_allclose(d[inner], plane[inner], atol=1e-3)
    np.testing.assert_array_equal(
        points.intensity, pair.left[v.round().astype(int).clip(0, 159), u.round().astype(int).clip(0, 239)]
    )


def test_stated_sigma_is_the_errors_along_the_ray(scene: tuple[RectifiedPair, np.ndarray]) -> None:
    pair, truth = scene
    rng = np.random.default_rng(5)
    sigma, bias, shared = 0.25, 0.15, 0.08
    exact = triangulate_disparity(pair, disparity(truth, sigma, bias), shared)
    noise_px = np.sqrt(sigma**2 - bias**2)
    noisy = triangulate_disparity(
        pair, disparity(truth + rng.normal(0, noise_px, truth.shape), sigma, bias), shared
    )
    moved = np.linalg.norm(noisy.xyz_m, axis=1) - np.linalg.norm(exact.xyz_m, axis=1)
    assert np.std(moved / exact.range_sigma_m) == pytest.approx(1, abs=0.02)
    for common in (bias, shared):
        shifted = triangulate_disparity(pair, disparity(truth + common), shared)
        moved = np.linalg.norm(shifted.xyz_m, axis=1) - np.linalg.norm(exact.xyz_m, axis=1)
        expected = common / np.hypot(bias, shared)
        np.testing.assert_allclose(np.abs(moved) / exact.shared_sigma_m, expected, rtol=0.03)


def test_noise_and_shared_part_are_apart(scene: tuple[RectifiedPair, np.ndarray]) -> None:
    """Each input widens its own part only."""
    pair, truth = scene
    base = triangulate_disparity(pair, disparity(truth, 0.3, 0.1), 0.05)
    surer = triangulate_disparity(pair, disparity(truth, 0.2, 0.1), 0.05)
    worse_calibrated = triangulate_disparity(pair, disparity(truth, 0.3, 0.1), 0.2)
    assert (surer.range_sigma_m < base.range_sigma_m).all()
    np.testing.assert_array_equal(surer.shared_sigma_m, base.shared_sigma_m)
    np.testing.assert_array_equal(worse_calibrated.range_sigma_m, base.range_sigma_m)
    ratio = np.hypot(0.2, 0.1) / np.hypot(0.05, 0.1)
    np.testing.assert_allclose(worse_calibrated.shared_sigma_m / base.shared_sigma_m, ratio, rtol=1e-4)


def test_what_is_left_out(scene: tuple[RectifiedPair, np.ndarray]) -> None:
    pair, truth = scene
    values = truth.copy()
    values[:10] = np.nan
    values[10:20] = -4.5
    values[20:30] = -6.0
    points = triangulate_disparity(pair, disparity(values), 0.1)
    assert len(points.xyz_m) == truth.size - 30 * 240
    depth = 200 / (truth + 4.5)
    assert (
        len(triangulate_disparity(pair, disparity(truth), 0.1, max_depth_m=7.0).xyz_m) == (depth <= 7).sum()
    )
    within = depth**2 / 200 * 0.3 <= 0.07
    assert 0 < within.sum() < within.size
    assert len(triangulate_disparity(pair, disparity(truth), 0.1, max_sigma_m=0.07).xyz_m) == within.sum()
    nothing = triangulate_disparity(pair, disparity(np.full_like(truth, np.nan)), 0.1, per_pixel=2)
    assert nothing.xyz_m.shape == (0, 3)


@pytest.mark.parametrize("jump", [1.5, 3.0, 40.0])
@pytest.mark.parametrize("per_pixel", [2, 3, 4])
def test_refined_grids_keep_jumps(jump: float, per_pixel: int) -> None:
    """Beside a jump there are only the two surfaces' disparities, none in between."""
    coarse = np.full((8, 10), 20.0, np.float32)
    coarse[:, 5:] += jump
    fine = refine_grid(coarse, per_pixel)
    np.testing.assert_array_equal(fine, coarse.repeat(per_pixel, 0).repeat(per_pixel, 1))


def test_refined_grids_keep_gaps_and_slopes() -> None:
    u, v = np.meshgrid(np.arange(10, dtype=np.float32), np.arange(8, dtype=np.float32))
    slope = 20 + 0.4 * u - 0.2 * v
    holed = slope.copy()
    holed[3, 4] = np.nan
    fine = refine_grid(holed, 3)
    np.testing.assert_array_equal(np.isnan(fine), np.isnan(holed).repeat(3, 0).repeat(3, 1))
    x = (np.arange(30, dtype=np.float32) + 0.5) / 3 - 0.5
    expected = 20 + 0.4 * x[None, 3:-3] - 0.2 * x[3:21, None]
    np.testing.assert_allclose(refine_grid(slope, 3)[3:21, 3:-3], expected, atol=1e-5)
    assert refine_grid(slope, 1) is slope
