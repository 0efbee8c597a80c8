"""The numeric core under changes whose effect is known exactly: units, turns, mirrors, order, noise."""

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from barsight.core.linalg.robust import mad_sigma
from barsight.core.pose import Pose
from barsight.core.records.disparity import Disparity, StereoPoints
from barsight.core.records.heights import HeightSource
from barsight.core.records.pairs import RectifiedPair
from barsight.mapping.observation import CellObservations
from barsight.mapping.settings import MapSettings
from barsight.mapping.surface.surface import Layers
from barsight.registration.rigid import Alignment, align_rigid
from barsight.stereo.triangulation import triangulate_disparity
from mapping_views import block, fused, view
from synthetic_scenes import slanted_pair

SEEDS = st.integers(0, 2**32 - 1)
FRAMES = ("yard", "world")
FEW = settings(max_examples=15, deadline=None)
FEWER = settings(max_examples=5, deadline=None)
"""For maps."""
SIDE = 24
"""Cells of a drawn yard, along x and along y."""


def drawn_points(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points, the same moved and noisy, and the covariances of their differences."""
    draw = np.random.default_rng(seed)
    source = draw.uniform(-5, 5, (12, 3))
    shape = draw.normal(0, 0.01, (12, 3, 3))
    covariance = shape @ shape.transpose(0, 2, 1) + 1e-6 * np.eye(3)
    pose = Pose(*FRAMES, Rotation.random(random_state=seed).as_matrix(), draw.uniform(-50, 50, 3))
    return source, pose.apply(source) + draw.normal(0, 0.01, (12, 3)), covariance


def aligned(source: np.ndarray, target: np.ndarray, covariance: np.ndarray) -> Alignment:
    found = align_rigid(source, target, FRAMES, covariance)
    assert isinstance(found, Alignment)
    return found


@FEW
@given(SEEDS, st.floats(1e-3, 1e3))
def test_an_alignment_follows_units_order_and_noise(seed: int, unit: float) -> None:
    source, target, covariance = drawn_points(seed)
    found = aligned(source, target, covariance)
    pose = found.target_from_source
    other = aligned(unit * source, unit * target, unit**2 * covariance)
    scaled = np.diag([1, 1, 1, unit, unit, unit])
    np.testing.assert_allclose(other.target_from_source.rotation, pose.rotation, atol=1e-9)
    np.testing.assert_allclose(other.target_from_source.translation, unit * pose.translation, rtol=1e-7)
    np.testing.assert_allclose(other.covariance, scaled @ found.covariance @ scaled, rtol=1e-5, atol=1e-15)
    np.testing.assert_allclose(other.chi2, found.chi2, rtol=1e-6)
    order = np.random.default_rng(seed).permutation(len(source))
    other = aligned(source[order], target[order], covariance[order])
    np.testing.assert_allclose(other.target_from_source.translation, pose.translation, atol=1e-10)
    np.testing.assert_allclose(other.covariance, found.covariance, rtol=1e-7, atol=1e-15)
    other = aligned(source, target, 4 * covariance)
    np.testing.assert_allclose(other.target_from_source.translation, pose.translation, atol=1e-10)
    np.testing.assert_allclose(other.covariance, 4 * found.covariance, rtol=1e-7, atol=1e-15)
    np.testing.assert_allclose(other.chi2, found.chi2 / 4, rtol=1e-7)


@FEW
@given(SEEDS)
def test_an_alignment_follows_a_turned_yard(seed: int) -> None:
    source, target, covariance = drawn_points(seed)
    turn = Pose(
        "turned", "yard", Rotation.random(random_state=seed + 1 & 0xFFFF).as_matrix(), np.full(3, 7.0)
    )
    found = aligned(source, target, covariance)
    R = turn.rotation
    other = aligned(source, turn.apply(target), R @ covariance @ R.T)
    expected = turn @ found.target_from_source
    np.testing.assert_allclose(other.target_from_source.rotation, expected.rotation, atol=1e-9)
    np.testing.assert_allclose(other.target_from_source.translation, expected.translation, atol=1e-8)
    np.testing.assert_allclose(other.residuals_m, found.residuals_m @ R.T, atol=1e-10)


def drawn_views(seed: int, count: int = 6) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """x, y (cells) and z of a yard of steps, seen by some views with noise and gaps, no outliers."""
    draw = np.random.default_rng(seed)
    x, y = (a.ravel() for a in np.meshgrid(np.arange(SIDE), np.arange(SIDE)))
    steps = np.repeat(np.repeat(draw.uniform(0, 1, (3, 3)), SIDE // 3, 0), SIDE // 3, 1).ravel()
    found = []
    for _ in range(count):
        kept = draw.random(x.size) < 0.9
        found.append((x[kept], y[kept], (steps + draw.normal(0, 0.003, x.size))[kept]))
    return found


def mapped(views: list[CellObservations], corner: tuple[int, int] = (0, 0)) -> Layers:
    with tempfile.TemporaryDirectory() as folder:
        return fused(views, Path(folder), MapSettings(min_views=2)).window(*corner, SIDE, SIDE)


def same_map(found: Layers, expected: Layers, turned: object = slice(None)) -> None:
    """Equal after `expected` is turned, to the rounding of float32 sums."""
    assert (found.source == expected.source[turned]).all()  # type: ignore[index]
    for name in ("z_m", "sigma_m", "views"):
        np.testing.assert_allclose(
            getattr(found, name), getattr(expected, name)[turned], rtol=2e-5, atol=1e-6
        )


@FEWER
@given(SEEDS, st.randoms(use_true_random=False))
def test_a_map_is_the_same_whatever_the_order_of_its_frames(seed: int, order: object) -> None:
    views = [view(*one) for one in drawn_views(seed)]
    expected = mapped(views)
    assert (expected.source == HeightSource.VISION).mean() > 0.9
    order.shuffle(views)  # type: ignore[attr-defined]
    same_map(mapped(views), expected)


@FEWER
@given(SEEDS)
def test_a_map_turns_and_mirrors_with_its_yard(seed: int) -> None:
    views = drawn_views(seed)
    expected = mapped([view(*one) for one in views])
    mirrored = mapped([view(x, SIDE - 1 - y, z) for x, y, z in views])
    same_map(mirrored, expected, np.s_[::-1])
    moved = mapped([view(x + 300, y - 700, z) for x, y, z in views], (300, -700))
    same_map(moved, expected)
    turned = mapped([view(SIDE - 1 - y, x, z) for x, y, z in views])
    # Of directions that are alike the first is taken, and a turn changes which is the first: of the 576
    # cells one on 92 and two on one of the seeds 400 to 2536 and 6000 to 8128.
    for name in ("z_m", "sigma_m", "views", "source"):
        alike = np.isclose(getattr(turned, name), np.rot90(getattr(expected, name), -1), rtol=2e-5, atol=1e-6)
        assert np.count_nonzero(~alike) <= 2, name


@FEWER
@given(SEEDS, st.floats(0.1, 5.0))
def test_a_map_follows_the_height_of_its_floor(seed: int, lift_m: float) -> None:
    views = drawn_views(seed)
    expected = mapped([view(*one) for one in views])
    same_map(
        mapped([view(x, y, z + lift_m) for x, y, z in views]),
        replace(expected, z_m=expected.z_m + np.float32(lift_m)),
    )


@FEWER
@given(st.floats(0.0, 2.0), st.floats(0.5, 2.0))
def test_a_map_of_views_that_agree_is_as_unsure_as_they_are(z_m: float, noise: float) -> None:
    x, y = block(SIDE, SIDE)
    expected = mapped([view(x, y, np.array(z_m), 0.01) for _ in range(4)])
    found = mapped([view(x, y, np.array(z_m), 0.01 * noise) for _ in range(4)])
    same_map(found, replace(expected, sigma_m=np.float32(noise) * expected.sigma_m))


def triangulated(pair: RectifiedPair, d: np.ndarray, sigma: float, shared_px: float = 0.2) -> StereoPoints:
    found = Disparity(d.astype(np.float32), np.full(d.shape, sigma, np.float32), 0.0)
    return triangulate_disparity(pair, found, shared_px)


@FEW
@given(st.floats(0.25, 4.0), st.floats(0.5, 8.0))
def test_points_follow_baseline_and_noise(factor: float, noise: float) -> None:
    pair, truth = slanted_pair()
    found = triangulated(pair, truth, 0.1)
    wider = replace(pair, camera=replace(pair.camera, baseline_m=factor * pair.camera.baseline_m))
    other = triangulated(wider, truth, 0.1)
    np.testing.assert_allclose(other.xyz_m, factor * found.xyz_m, rtol=1e-5)
    np.testing.assert_allclose(other.range_sigma_m, factor * found.range_sigma_m, rtol=1e-4)
    np.testing.assert_allclose(other.shared_sigma_m, factor * found.shared_sigma_m, rtol=1e-4)
    other = triangulated(pair, truth, 0.1 * noise, 0.2 * noise)
    np.testing.assert_array_equal(other.xyz_m, found.xyz_m)
    np.testing.assert_allclose(other.range_sigma_m, noise * found.range_sigma_m, rtol=1e-4)
    np.testing.assert_allclose(other.shared_sigma_m, noise * found.shared_sigma_m, rtol=1e-4)


@FEW
@given(SEEDS, st.floats(1e-3, 1e3), st.floats(-1e3, 1e3))
def test_a_robust_sigma_follows_units_and_order(seed: int, unit: float, shift: float) -> None:
    draw = np.random.default_rng(seed)
    values = draw.standard_cauchy(101)
    np.testing.assert_allclose(mad_sigma(unit * values), unit * mad_sigma(values), rtol=1e-9)
    assert mad_sigma(draw.permutation(values)) == mad_sigma(values)
