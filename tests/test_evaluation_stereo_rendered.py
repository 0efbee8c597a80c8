"""The renderer against geometry, the bar fits against the rendered truth, and the two benchmarks on it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from barsight.benchmarks.stereo.bar_edges import edge_diameter, find_outlines, tangent_planes
from barsight.benchmarks.stereo.bar_fit import BarFit, BarGuess, fit_bar
from barsight.benchmarks.stereo.bar_outline import _FINE_PX, _basis, _misfits
from barsight.benchmarks.stereo.bar_renderer import (
    _LAMP_HALF_WIDTH,
    BAR,
    FLOOR,
    Rendered,
    RenderedBar,
    _light_left,
    render_pair,
)
from barsight.benchmarks.stereo.bar_scenes import PosedScene, bar_over_floor, tilted_floor
from barsight.benchmarks.stereo.cramer_rao_bound import noise_limit_px
from barsight.benchmarks.stereo.steps import steps_picture
from barsight.benchmarks.stereo.subpixel import (
    bench_subpixel,
    fraction_bias,
    inner_pixels,
    pixel_errors,
    subpixel_table,
)
from barsight.benchmarks.stereo.target_size import bench_target_size, measure_bar, target_size_table
from barsight.core.errors import Failed
from barsight.core.json_values import write_json
from barsight.core.records.disparity import Disparity, DisparityRange
from barsight.core.records.pairs import RectifiedPair
from barsight.stereo.image_pair import pair_from_images
from barsight.stereo.sgbm import Sgbm, SgbmSettings


def _without_noise(posed: PosedScene) -> PosedScene:
    return replace(posed, scene=replace(posed.scene, read_noise=0.0, shot_variance=0.0))


@pytest.fixture(scope="module")
def floor() -> tuple[PosedScene, Rendered]:
    posed = _without_noise(tilted_floor(np.random.default_rng(1), 6.0, 15.0))
    return posed, render_pair(posed.scene, seed=1)


@pytest.fixture(scope="module")
def bar() -> tuple[PosedScene, Rendered]:
    posed = _without_noise(bar_over_floor(np.random.default_rng(2), 2.5, gloss=0.0, raised_m=0.3))
    return posed, render_pair(posed.scene, seed=2)


def _bar_of(posed: PosedScene) -> RenderedBar:
    assert posed.scene.bar is not None
    return posed.scene.bar


def _exact(rendered: Rendered, sigma_px: float = 0.05) -> Disparity:
    truth = rendered.truth_px.astype(np.float32)
    return Disparity(truth, np.full_like(truth, sigma_px))


def _left_minus_warped_right(rendered: Rendered) -> np.ndarray:
    rows, columns = np.mgrid[: rendered.truth_px.shape[0], : rendered.truth_px.shape[1]].astype(np.float32)
    there = (columns - rendered.truth_px).astype(np.float32)
    right = rendered.pair.right.astype(np.float32)
    return rendered.pair.left - cv2.remap(right, there, rows, cv2.INTER_CUBIC)


def test_the_floors_disparity_is_that_of_its_plane(floor: tuple[PosedScene, Rendered]) -> None:
    posed, rendered = floor
    camera, normal = posed.scene.camera, posed.scene.normal
    for row, column in ((0, 0), (100, 300), (383, 415)):
        ray = np.array(
            [(column - camera.cx_px) / camera.focal_px, (row - camera.cy_px) / camera.focal_px, 1.0]
        )
        depth = posed.scene.offset_m / float(normal @ ray)
        expected = camera.focal_px * camera.baseline_m / depth - camera.doffs_px
        assert rendered.truth_px[row, column] == pytest.approx(expected, abs=1e-9)
    assert (rendered.surface == FLOOR).all()
    assert rendered.truth_px.min() > posed.candidates.lowest_px
    assert rendered.truth_px.max() < posed.candidates.highest_px


def test_the_bars_points_lie_on_its_cylinder(bar: tuple[PosedScene, Rendered]) -> None:
    posed, rendered = bar
    camera, steel = posed.scene.camera, _bar_of(posed)
    rows, columns = np.nonzero(rendered.surface == BAR)
    depth = camera.focal_px * camera.baseline_m / (rendered.truth_px[rows, columns] + camera.doffs_px)
    points = np.column_stack(
        [
            depth * (columns - camera.cx_px) / camera.focal_px,
            depth * (rows - camera.cy_px) / camera.focal_px,
            depth,
        ]
    )
    away = points - steel.centre_m
    away -= np.outer(away @ steel.axis, steel.axis)
    np.testing.assert_allclose(np.linalg.norm(away, axis=1), steel.radius_m, atol=1e-9)
    assert rows.size > 10_000


@pytest.mark.parametrize("name", ["floor", "bar"])
def test_both_images_show_the_same_matt_surface(name: str, request: pytest.FixtureRequest) -> None:
    _, rendered = request.getfixturevalue(name)
    surface = BAR if name == "bar" else FLOOR
    where = inner_pixels(rendered, surface)
    difference = _left_minus_warped_right(rendered)[where]
    assert np.abs(difference.mean()) < 0.05
    assert difference.std() < 1.0


def test_gloss_differs_between_the_images() -> None:
    posed = _without_noise(bar_over_floor(np.random.default_rng(2), 2.5, gloss=60.0, raised_m=0.3))
    rendered = render_pair(posed.scene, seed=2)
    assert _left_minus_warped_right(rendered)[inner_pixels(rendered, BAR)].std() > 2.0


def test_what_the_bar_hides_from_the_right_camera_is_not_visible(bar: tuple[PosedScene, Rendered]) -> None:
    _, rendered = bar
    hidden = ~rendered.visible & (rendered.surface == FLOOR)
    columns = np.arange(hidden.shape[1])
    for row in (50, 200, 350):
        steel = np.nonzero(rendered.surface[row] == BAR)[0]
        step = rendered.truth_px[row, steel[0]] - rendered.truth_px[row, steel[0] - 3]
        beside = hidden[row] & (columns > steel[0] - 3 * step) & (columns < steel[-1])
        assert beside.sum() == pytest.approx(step, abs=3)


def test_the_same_seed_gives_the_same_images() -> None:
    posed = tilted_floor(np.random.default_rng(1), 6.0, 15.0)
    first, again, other = (render_pair(posed.scene, seed).pair.left for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()


def test_the_fit_to_a_true_map_gives_the_true_bar(bar: tuple[PosedScene, Rendered]) -> None:
    posed, rendered = bar
    steel = _bar_of(posed)
    guess = BarGuess(steel.centre_m + 0.006, steel.axis, 0.85 * steel.radius_m)
    rng = np.random.default_rng(4)
    exact = _exact(rendered)
    noisy = replace(exact, disparity_px=exact.disparity_px + rng.normal(0, 0.1, exact.sigma_px.shape))
    holes = rng.random(exact.sigma_px.shape) < 0.3
    sparse = Disparity(
        np.where(holes, np.nan, noisy.disparity_px).astype(np.float32),
        np.where(holes, np.nan, exact.sigma_px).astype(np.float32),
    )
    for disparity, tolerance in ((exact, 2e-4), (noisy, 1e-3), (sparse, 1.5e-3)):
        found = fit_bar(disparity, posed.scene.camera, guess)
        assert isinstance(found, BarFit)
        assert found.radius_m == pytest.approx(steel.radius_m, rel=tolerance)
        assert abs(float(found.axis @ steel.axis)) > np.cos(1e-3)


def test_a_fattened_map_makes_the_bar_thicker(bar: tuple[PosedScene, Rendered]) -> None:
    posed, rendered = bar
    steel = _bar_of(posed)
    fat = replace(_exact(rendered), disparity_px=cv2.dilate(_exact(rendered).disparity_px, np.ones((1, 7))))
    found = fit_bar(fat, posed.scene.camera, BarGuess(steel.centre_m, steel.axis, steel.radius_m))
    assert isinstance(found, BarFit)
    pixel_m = posed.range_m / posed.scene.camera.focal_px
    assert found.radius_m - steel.radius_m == pytest.approx(3 * pixel_m, rel=0.3)


def test_outlines_are_found_below_a_pixel_from_a_wrong_radius(bar: tuple[PosedScene, Rendered]) -> None:
    posed, rendered = bar
    steel = _bar_of(posed)
    start = BarFit(steel.centre_m, steel.axis, 1.1 * steel.radius_m)
    outlines = find_outlines(rendered.pair.left, posed.scene.camera, start)
    assert not isinstance(outlines, Failed)
    true = tangent_planes(steel.centre_m, steel.axis, steel.radius_m)
    middle = steel.centre_m / np.linalg.norm(steel.centre_m)
    away_px = (outlines.normals - true) @ middle * posed.scene.camera.focal_px
    assert np.abs(away_px).max() < 0.2
    diameter = edge_diameter(_exact(rendered), rendered.pair, start)
    assert diameter == pytest.approx(2 * steel.radius_m, rel=0.005)


def test_a_stretchs_misfit_is_that_of_weighted_least_squares() -> None:
    """The basis shifted by each guess, a variance for floor and bar, twice reweighted."""
    rng, basis = np.random.default_rng(3), _basis(30.0, 9.0)
    away, shifts = rng.uniform(-10, 10, 150), np.array([-2.0, -0.3, 0.0, 1.7])
    grid = _FINE_PX * (np.arange(len(basis)) - (len(basis) - 1) / 2)
    gray = np.where(away > 0, 150.0, 60 + away) + rng.normal(0, np.where(away > 0, 9, 3))
    misfit = np.empty(4)
    _misfits(gray, away, shifts, basis, misfit)
    for shift, found in zip(shifts, misfit, strict=True):
        design = np.stack([np.interp(away - shift, grid, part) for part in basis.T], axis=1)
        bar, variances = design[:, 2], np.ones(2)
        for _ in range(2):
            weight = bar / variances[0] + (1 - bar) / variances[1]
            normal = (design.T * weight) @ design
            normal += 1e-6 * np.trace(normal) * np.eye(5)
            rest = gray - design @ np.linalg.solve(normal, (design.T * weight) @ gray)
            variances = np.array([np.average(rest**2, weights=w) for w in (bar, 1 - bar)]) + 0.25
        wanted = np.average(np.log(variances), weights=[bar.sum(), (1 - bar).sum()])
        assert found == pytest.approx(wanted, rel=1e-6)
    assert misfit.argmin() == 2


def test_a_bars_shadow_is_as_soft_as_the_lamp_is_wide() -> None:
    """Half the light where the ray to the lamp's middle grazes the bar; behind the bar none counts."""
    rng, lit = np.random.default_rng(4), []
    lamp, axis, centre = np.array([0.3, -0.2, -0.93]), np.array([0.0, 0.8, 0.6]), np.array([0.1, 0.0, 5.0])
    shape = np.zeros((4, 3))
    shape[1, 1], shape[2], shape[3] = 0.05, centre, axis
    for point in rng.uniform(-0.4, 0.4, (400, 3)) + centre:
        across = np.cross(lamp, axis)
        passing = abs((point - centre) @ across) / np.linalg.norm(across)
        flat = lamp - (lamp @ axis) * axis
        way = -(point - centre) @ flat / (flat @ flat)
        soft = (passing - 0.05) / (_LAMP_HALF_WIDTH * way) if way > 0 else np.inf
        lit.append(np.clip(0.5 + 0.5 * soft, 0, 1))
        assert _light_left(*point, lamp, shape) == pytest.approx(lit[-1], abs=1e-9)
    assert np.mean(np.array(lit) < 0.5) > 0.02 and np.any((np.array(lit) > 0.1) & (np.array(lit) < 0.9))
    shape[1, 1] = 0
    assert _light_left(*centre, lamp, shape) == 1


def test_maps_without_floor_or_bar_fail_with_a_reason(bar: tuple[PosedScene, Rendered]) -> None:
    posed, rendered = bar
    steel = _bar_of(posed)
    guess = BarGuess(steel.centre_m, steel.axis, steel.radius_m)
    exact = _exact(rendered)
    empty = Disparity(np.full_like(exact.sigma_px, np.nan), np.full_like(exact.sigma_px, np.nan))
    no_floor = fit_bar(empty, posed.scene.camera, guess)
    assert isinstance(no_floor, Failed) and no_floor.code == "no-floor"
    on_bar = cv2.dilate((rendered.surface == BAR).astype(np.uint8), np.ones((61, 61), np.uint8)) > 0
    bare = replace(exact, disparity_px=np.where(on_bar, np.nan, exact.disparity_px).astype(np.float32))
    no_bar = fit_bar(bare, posed.scene.camera, guess)
    assert isinstance(no_bar, Failed) and no_bar.code == "no-bar"
    outside = BarFit(steel.centre_m + np.array([5, 0, 0]), steel.axis, steel.radius_m)
    no_outline = edge_diameter(exact, rendered.pair, outside)
    assert isinstance(no_outline, Failed) and no_outline.code == "no-outline"
    assert np.isnan(measure_bar(empty, rendered.pair, guess)).all()


def test_locking_shows_as_its_own_height_and_sigma_is_counted(floor: tuple[PosedScene, Rendered]) -> None:
    _, rendered = floor
    rng = np.random.default_rng(7)
    wave = 0.1 * np.sin(2 * np.pi * rendered.truth_px)
    noise = rng.normal(0, 0.05, wave.shape)
    found = Disparity(
        (rendered.truth_px + wave + noise + 0.02).astype(np.float32), np.full(wave.shape, 0.05, np.float32)
    )
    where = inner_pixels(rendered, FLOOR)
    bias = fraction_bias([pixel_errors(found, rendered.truth_px, where)])
    # The mean of a sine over the tenths next to its crests is 0.1 * (0.96...0.98).
    assert bias.peak_to_peak_px == pytest.approx(0.192, abs=0.01)
    assert bias.median_bias_px == pytest.approx(0.02, abs=0.005)
    assert bias.coverage_pct == 100 and bias.gross_pct == 0
    honest = replace(found, disparity_px=(rendered.truth_px + noise).astype(np.float32))
    calibrated = fraction_bias([pixel_errors(honest, rendered.truth_px, where)])
    assert calibrated.peak_to_peak_px < 0.005
    assert calibrated.within1_pct == pytest.approx(68.3, abs=1)
    assert calibrated.within2_pct == pytest.approx(95.4, abs=1)


def test_a_method_that_finds_nothing_is_reported_as_nothing(floor: tuple[PosedScene, Rendered]) -> None:
    _, rendered = floor
    nothing = np.full(rendered.truth_px.shape, np.nan, dtype=np.float32)
    bias = fraction_bias(
        [pixel_errors(Disparity(nothing, nothing), rendered.truth_px, inner_pixels(rendered, FLOOR))]
    )
    assert bias.coverage_pct == 0 and np.isnan(bias.peak_to_peak_px)


def _nothing(pair: RectifiedPair, candidates: DisparityRange) -> Disparity:
    empty = np.full(pair.left.shape, np.nan, dtype=np.float32)
    return Disparity(empty, empty)


def test_bench_subpixel_runs_and_shows_sgbms_locking(tmp_path: Path) -> None:
    bench = bench_subpixel({"sgbm": Sgbm(SgbmSettings()), "nothing": _nothing}, scenes=1)
    sgbm, nothing = bench.methods
    assert set(sgbm.kinds) == {"tilted plane", "matt bar", "glossy bar"}
    plane = sgbm.kinds["tilted plane"]
    assert 0.1 < plane.peak_to_peak_px < 0.6 and plane.median_error_px < 0.3 and plane.coverage_pct > 95
    assert nothing.kinds["matt bar"].coverage_pct == 0
    assert subpixel_table(bench).row_count == 6
    write_json(tmp_path / "out.json", bench)
    stored = json.loads((tmp_path / "out.json").read_text())
    assert len(stored["methods"][0]["kinds"]["tilted plane"]["bias_px"]) == 10
    assert stored["methods"][1]["kinds"]["matt bar"]["peak_to_peak_px"] is None


@pytest.mark.slow
def test_bench_target_size_measures_a_bar(tmp_path: Path) -> None:
    bench = bench_target_size({"sgbm": Sgbm(SgbmSettings()), "nothing": _nothing}, poses=2, ranges_mm=(2500,))
    sgbm, nothing = (result.ranges[0] for result in bench.methods)
    assert sgbm.size.failed == 0 and sgbm.size.mean_abs_pct < 1
    assert sgbm.map.mean_pct > 3  # Block matching makes things fatter.
    assert nothing.size.failed == 2 and np.isnan(nothing.size.mean_pct)
    assert target_size_table(bench).row_count == 1
    write_json(tmp_path / "out.json", bench)
    stored = json.loads((tmp_path / "out.json").read_text())
    assert stored["methods"][1]["ranges"][0]["size"]["mean_pct"] is None
    assert stored["diameter_mm"] == 90


def test_the_noise_limit_is_that_of_a_sine() -> None:
    """The mean squared slope of a sine of amplitude A and frequency w is (A w)^2 / 2."""
    rng = np.random.default_rng(0)
    clean = 120 + 30 * np.sin(0.3 * np.arange(400))
    images = [np.rint(clean + rng.normal(0, 2, (300, 400))).clip(0, 255).astype(np.uint8) for _ in range(2)]
    where = np.zeros((300, 400), dtype=bool)
    where[30:-30, 30:-30] = True
    limit = noise_limit_px(pair_from_images(images[0], images[1]), where)
    slope = (30 * np.sin(0.3)) ** 2 / 2
    assert limit == pytest.approx(np.sqrt(2 * 2.0**2 / (4 * np.pi * 16 * 1.5 * slope)), rel=0.1)


def test_the_picture_of_the_steps_shows_less_error_after_refinement() -> None:
    picture = steps_picture()
    height, width = picture.shape[0] // 2, picture.shape[1] // 3
    start, refined = (picture[height:, k * width : (k + 1) * width] for k in (0, 1))
    middle = cv2.applyColorMap(np.full((1, 1), 128, np.uint8), cv2.COLORMAP_VIRIDIS)[0, 0].astype(int)
    far = [np.abs(panel.astype(int) - middle).sum(axis=2).mean() for panel in (start, refined)]
    assert far[1] < 0.9 * far[0]
