"""Each kernel of the peers against a slow, obvious reference in NumPy."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse
import scipy.sparse.csgraph

from barsight.core.records.disparity import DisparityRange
from barsight.stereo.baselines.bilateral_filter import bilateral_update
from barsight.stereo.baselines.census_transform import HEIGHT_PX, WIDTH_PX, WORST, census_codes, census_cost
from barsight.stereo.baselines.cross_aggregation import cross_filter, cross_regions
from barsight.stereo.baselines.csca import _Scale, _tie, scale_weights
from barsight.stereo.baselines.gradient_cost import GradientCostSettings, cost_images, gradient_cost
from barsight.stereo.baselines.guided_filter import colour_guided_filter, guided_filter
from barsight.stereo.baselines.left_right_check import (
    fill_from_background,
    left_right_agreement,
    weighted_median,
)
from barsight.stereo.baselines.nonlocal_aggregation import refine_nonlocal
from barsight.stereo.baselines.region_voting import region_vote
from barsight.stereo.baselines.spanning_tree import spanning_tree, tree_filter
from barsight.stereo.baselines.winner_takes_all import no_winners, subpixel_winners, sweep, take_slices


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(3)


def _textured(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    return rng.integers(0, 256, (height, width)).astype(np.uint8)


def test_gradient_cost_is_the_truncated_sum(rng: np.random.Generator) -> None:
    left, right = (_textured(rng, 5, 13).astype(np.float32) / 16 for _ in range(2))
    left_valid, right_valid = (rng.random((5, 13)) > 0.1 for _ in range(2))
    settings = GradientCostSettings()
    images = cost_images(left, right, left_valid, right_valid)
    slices = np.empty((20, 5, 13), dtype=np.float32)
    gradient_cost(images, -4, settings, slices)
    gradients = [np.zeros((5, 13)) for _ in range(2)]
    for gradient, image in zip(gradients, (left, right), strict=True):
        gradient[:, 1:-1] = image[:, 2:].astype(float) - image[:, :-2]
    for index in range(20):
        for y in range(5):
            for x in range(13):
                there = x - (index - 4)
                if 0 <= there < 13 and left_valid[y, x] and right_valid[y, there]:
                    gray = min(abs(float(left[y, x]) - float(right[y, there])), 7)
                    steep = min(abs(gradients[0][y, x] - gradients[1][y, there]), 2)
                    expected = 0.11 * gray + 0.89 * steep
                else:
                    expected = settings.worst
                assert slices[index, y, x] == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize("radius", [1, 3, 8])
def test_guided_filter_is_the_mean_of_local_linear_models(rng: np.random.Generator, radius: int) -> None:
    guide = rng.uniform(0, 255, (17, 23))
    cost = rng.uniform(0, 3, (2, 17, 23)).astype(np.float32)
    epsilon = 40.0
    rows, columns = np.mgrid[:17, :23]

    def windows(values: np.ndarray) -> np.ndarray:
        near = (abs(rows.reshape(-1, 1) - rows.ravel()) <= radius) & (
            abs(columns.reshape(-1, 1) - columns.ravel()) <= radius
        )
        return (near @ values.ravel() / near.sum(1)).reshape(values.shape)

    found = guided_filter(guide.astype(np.float32), radius, epsilon)(cost.copy())
    for one, result in zip(cost.astype(float), found, strict=True):
        mean, mean_cost = windows(guide), windows(one)
        slope = (windows(guide * one) - mean * mean_cost) / (windows(guide * guide) - mean**2 + epsilon)
        expected = windows(slope) * guide + windows(mean_cost - slope * mean)
        np.testing.assert_allclose(result, expected, atol=2e-4)


def test_a_colour_guide_of_three_like_channels_is_a_gray_one(rng: np.random.Generator) -> None:
    """Three channels alike share one slope, so that each is held by a third of the regulariser."""
    guide = rng.uniform(0, 255, (40, 50)).astype(np.float32)
    cost = rng.uniform(0, 3, (2, 40, 50)).astype(np.float32)
    found = colour_guided_filter(np.dstack([guide] * 3), 3, 120.0)(cost.copy())
    expected = guided_filter(guide, 3, 40.0)(cost.copy())
    inner = (slice(None), slice(6, -6), slice(6, -6))  # beyond the border OpenCV mirrors, we cut windows off
    np.testing.assert_allclose(found[inner], expected[inner], atol=1e-3)


def test_spanning_tree_is_minimal_and_its_filter_sums_over_all_paths(rng: np.random.Generator) -> None:
    guide = rng.integers(0, 30, (9, 11)).astype(np.uint8)
    size = guide.size
    index = np.arange(size).reshape(guide.shape)
    pairs = [(index[:, :-1], index[:, 1:]), (index[:-1], index[1:])]
    first = np.concatenate([one.ravel() for one, _ in pairs])
    second = np.concatenate([other.ravel() for _, other in pairs])
    weights = np.abs(guide.ravel()[first].astype(float) - guide.ravel()[second])
    graph = scipy.sparse.csr_matrix((weights + 1, (first, second)), shape=(size, size))
    lightest = scipy.sparse.csgraph.minimum_spanning_tree(graph).sum() - (size - 1)
    tree = spanning_tree(guide)
    assert tree.weight.sum(dtype=int) == lightest
    assert sorted(tree.node) == list(range(size))
    place = np.empty(size, dtype=int)
    place[tree.node] = np.arange(size)
    assert (place[tree.parent[1:]] < np.arange(1, size)).all()
    edges = scipy.sparse.csr_matrix(
        (tree.weight[1:] + 1e-9, (tree.node[1:], tree.parent[1:])), shape=(size, size)
    )
    distance = scipy.sparse.csgraph.dijkstra(edges, directed=False)
    slices = rng.random((11, 9, 11)).astype(np.float32)
    expected = (np.exp(-distance / 7) @ slices.reshape(11, -1).T).T.reshape(slices.shape)
    np.testing.assert_allclose(tree_filter(tree, 7.0)(slices.copy()), expected, rtol=1e-5)


def test_census_distance_is_the_number_of_differing_bits(rng: np.random.Generator) -> None:
    left, right = _textured(rng, 12, 20), _textured(rng, 12, 20)
    valid = rng.random((12, 20)) > 0.1
    everywhere = np.ones_like(valid)
    kernel = np.outer([1, 2, 1], [1, 2, 1]) / 16

    def bits(image: np.ndarray, y: int, x: int) -> np.ndarray:
        padded = np.pad(image.astype(float), 5, mode="edge")
        reference = (padded[y + 4 : y + 7, x + 4 : x + 7] * kernel).sum()
        top, start = y + 5 - HEIGHT_PX // 2, x + 5 - WIDTH_PX // 2
        window = np.delete(
            padded[top : top + HEIGHT_PX, start : start + WIDTH_PX].ravel(), HEIGHT_PX * WIDTH_PX // 2
        )
        return np.concatenate([window > reference + 9.1, window < reference - 9.1])

    slices = np.empty((7, 12, 20), dtype=np.float32)
    census_cost(census_codes(left, 9.1), census_codes(right, 9.1), valid, everywhere, -2, slices)
    for index in range(7):
        for y in range(0, 12, 3):
            for x in range(20):
                there = x - (index - 2)
                usable = 0 <= there < 20 and valid[y, x]
                expected = (bits(left, y, x) != bits(right, y, there)).sum() if usable else WORST / 2
                assert slices[index, y, x] == expected


def test_noise_within_the_tolerance_leaves_a_flat_code_empty() -> None:
    image = np.full((20, 20), 100, dtype=np.uint8)
    image[::3, ::2] += 1
    assert not census_codes(image, 1.5).any()
    assert census_codes(image, 0.0).any()


def test_cross_regions_and_their_mean_are_those_of_the_definition(rng: np.random.Generator) -> None:
    guide = np.repeat(np.repeat(rng.integers(0, 4, (4, 5)) * 8, 4, 0), 4, 1).astype(np.uint8)
    guide += rng.integers(0, 5, guide.shape).astype(np.uint8)
    height, width = guide.shape
    regions = cross_regions(guide, 6, 3, 9, 4)
    steps = ((0, -1), (0, 1), (-1, 0), (1, 0))
    for arm, (step_y, step_x) in enumerate(steps):
        for y in range(height):
            for x in range(width):
                reached, before = 0, int(guide[y, x])
                while reached < 6:
                    y2, x2 = y + (reached + 1) * step_y, x + (reached + 1) * step_x
                    if not (0 <= y2 < height and 0 <= x2 < width):
                        break
                    now = int(guide[y2, x2])
                    limit = 9 if reached < 3 else 4
                    if reached > 0 and (abs(now - int(guide[y, x])) > limit or abs(now - before) > 9):
                        break
                    reached, before = reached + 1, now
                assert regions.arms[arm, y, x] == reached
    cost = rng.random((1, height, width)).astype(np.float32)
    left, right, up, down = regions.arms.astype(int)
    once = np.empty((height, width))
    twice = np.empty((height, width))
    for y in range(height):
        for x in range(width):
            region = [
                (row, column)
                for row in range(y - up[y, x], y + down[y, x] + 1)
                for column in range(x - left[row, x], x + right[row, x] + 1)
            ]
            once[y, x] = np.mean([cost[0, row, column] for row, column in region])
    for y in range(height):
        for x in range(width):
            region = [
                (row, column)
                for column in range(x - left[y, x], x + right[y, x] + 1)
                for row in range(y - up[y, column], y + down[y, column] + 1)
            ]
            twice[y, x] = np.mean([once[row, column] for row, column in region])
    np.testing.assert_allclose(cross_filter(regions, 1)(cost.copy())[0], once, atol=1e-5)
    np.testing.assert_allclose(cross_filter(regions, 2)(cost.copy())[0], twice, atol=1e-5)


def test_winners_of_slices_in_blocks_are_those_of_the_whole_volume(rng: np.random.Generator) -> None:
    volume = rng.random((37, 6, 9)).astype(np.float32)
    candidates = DisparityRange(-3, 34)

    def fill(lowest_px: int, slices: np.ndarray) -> None:
        slices[:] = volume[lowest_px + 3 : lowest_px + 3 + len(slices)]

    winners = sweep((6, 9), candidates, fill)
    best = volume.argmin(0)
    np.testing.assert_array_equal(winners.candidate_px, best - 3)
    between = subpixel_winners(winners)
    for y in range(6):
        for x in range(9):
            d = best[y, x]
            expected = float(d)
            if 0 < d < 36:
                low, here, high = volume[d - 1 : d + 2, y, x].astype(float)
                expected -= (high - low) / (2 * (high + low - 2 * here))
            assert between[y, x] == pytest.approx(expected - 3, abs=1e-4)


def test_the_parabola_finds_a_parabolas_minimum() -> None:
    winners = no_winners(1, 50)
    truth = np.linspace(3, 7, 50)
    volume = ((np.arange(11)[:, None] - truth) ** 2).astype(np.float32)[:, None, :]
    take_slices(winners, np.ascontiguousarray(volume), 0)
    np.testing.assert_allclose(subpixel_winners(winners)[0], truth, atol=1e-5)


def test_left_right_agreement_and_filling_by_hand() -> None:
    left = np.array([[2, 2, 2, 3, 2, 2, 5, 2]], dtype=np.int32)
    right = np.array([[2, 2, 2, 2, 2, 2, 2, 2]], dtype=np.int32)
    strict = np.array([[False, False, True, False, True, True, False, True]])
    np.testing.assert_array_equal(left_right_agreement(left, right), strict)
    loose = strict.copy()
    loose[0, 3] = True
    np.testing.assert_array_equal(left_right_agreement(left, right, tolerance_px=1), loose)
    values = np.array([[9, 4, 9, 9, 6, 9]], dtype=np.int32)
    usable = np.array([[False, True, False, False, True, False]])
    np.testing.assert_array_equal(fill_from_background(values, usable), [[4, 4, 4, 4, 6, 6]])
    np.testing.assert_array_equal(fill_from_background(values, np.zeros_like(usable)), values)


def test_weighted_median_against_sorting(rng: np.random.Generator) -> None:
    values = rng.integers(-5, 20, (9, 12)).astype(np.int32)
    guide = _textured(rng, 9, 12)
    where = rng.random((9, 12)) > 0.5
    found = weighted_median(values, guide, where, 3, 2.0, 60.0)
    np.testing.assert_array_equal(found[~where], values[~where])
    for y, x in zip(*np.nonzero(where), strict=True):
        rows, columns = slice(max(0, y - 3), y + 4), slice(max(0, x - 3), x + 4)
        part = values[rows, columns].ravel()
        grid_y, grid_x = np.mgrid[rows, columns][:, : guide[rows, columns].shape[0], :]
        grid_y = np.arange(max(0, y - 3), min(9, y + 4))[:, None] + 0 * guide[rows, columns]
        grid_x = np.arange(max(0, x - 3), min(12, x + 4))[None, :] + 0 * guide[rows, columns]
        gray = guide[rows, columns].astype(float) - float(guide[y, x])
        weight = np.exp(-((grid_y - y) ** 2 + (grid_x - x) ** 2) / 4 - (gray / 60) ** 2).ravel()
        order = np.argsort(part, kind="stable")
        running = weight[order].cumsum()
        assert found[y, x] == part[order][np.searchsorted(running, running[-1] / 2 - 1e-6)]


def test_region_vote_counts_the_reliable_only(rng: np.random.Generator) -> None:
    guide = np.full((12, 12), 50, dtype=np.uint8)
    guide[:, 6:] = 150
    values = np.full((12, 12), 7, dtype=np.int32)
    values[:, 6:] = 20
    reliable = np.ones((12, 12), dtype=bool)
    values[3:6, 2:4] = 99
    reliable[3:6, 2:4] = False
    regions = cross_regions(guide, 5, 5, 10, 10)
    voted, joined = region_vote(values, reliable, regions, 10, 0.5, 1)
    assert (voted[3:6, 2:4] == 7).all() and joined.all()
    same, still = region_vote(values, reliable, regions, 1000, 0.5, 2)
    np.testing.assert_array_equal(same, values)
    np.testing.assert_array_equal(still, reliable)


def test_scale_weights_solve_the_tridiagonal_system() -> None:
    np.testing.assert_allclose(scale_weights(5, 0.0), [1, 0, 0, 0, 0])
    weights = scale_weights(5, 0.3)
    assert weights.sum() == pytest.approx(1)
    system = np.diag([1.3, 1.6, 1.6, 1.6, 1.3]) - 0.3 * (np.eye(5, k=1) + np.eye(5, k=-1))
    np.testing.assert_allclose(system @ weights, [1, 0, 0, 0, 0], atol=1e-12)


def test_scales_are_tied_by_halving_place_and_candidate(rng: np.random.Generator) -> None:
    coarse_candidates = DisparityRange(1, 6)
    coarse = rng.random((5, 3, 4)).astype(np.float32)
    everywhere = np.ones((3, 4), dtype=bool)
    images = cost_images(np.zeros((3, 4), np.float32), np.zeros((3, 4), np.float32), everywhere, everywhere)
    slices = rng.random((8, 5, 7)).astype(np.float32)
    tied = slices.copy()
    _tie(tied, 0.6, 2, _Scale(images, images.left, coarse_candidates, coarse))
    for index in range(8):
        for y in range(5):
            for x in range(7):
                halves = [(2 + index) // 2 - 1, (2 + index + 1) // 2 - 1]
                above = coarse[halves, y // 2, x // 2].mean()
                assert tied[index, y, x] == pytest.approx(0.6 * slices[index, y, x] + above, abs=1e-6)


def test_nonlocal_refinement_is_the_weighted_median_over_the_tree(rng: np.random.Generator) -> None:
    guide = rng.integers(0, 40, (8, 10)).astype(np.uint8)
    values = rng.integers(2, 30, (8, 10)).astype(np.int32)
    matched = rng.random((8, 10)) > 0.3
    tree = spanning_tree(guide)
    found = refine_nonlocal(values, matched, tree, DisparityRange(0, 40), 9.0)
    edges = scipy.sparse.csr_matrix(
        (tree.weight[1:] + 1e-9, (tree.node[1:], tree.parent[1:])), shape=(80, 80)
    )
    support = np.exp(-scipy.sparse.csgraph.dijkstra(edges, directed=False) / 9)
    distance = np.abs(np.arange(40)[:, None] - values.ravel()) * matched.ravel()
    costs = distance @ support
    best = costs.min(0)
    chosen = np.take_along_axis(costs, found.reshape(1, -1).astype(int), 0)[0]
    np.testing.assert_allclose(chosen, best, rtol=1e-5)


@pytest.mark.parametrize("limit", [2.0, 6.4, 24.0, 48.0])
def test_bilateral_update_is_the_filtered_cost_space(rng: np.random.Generator, limit: float) -> None:
    candidates = DisparityRange(3, 51)
    shape = (16, 26)
    values = np.full(shape, 20.3) + np.linspace(0, 2, shape[1]) + rng.normal(0, 0.3, shape)
    values[:, 13:] += 15
    values[10:, :4] = 3.2
    values[rng.random(shape) < 0.1] = np.nan
    values[:6, :7] = np.nan
    values = values.astype(np.float32)
    guide = rng.integers(100, 130, shape).astype(np.uint8)
    guide[:, 13:] += 30
    found = bilateral_update(values, guide, candidates, limit, 3, 2.0, 10.0)
    expected = _filtered_cost_space(values, guide, candidates, limit)
    np.testing.assert_array_equal(np.isnan(found), np.isnan(expected))
    np.testing.assert_allclose(found, expected, atol=2e-4)


def _filtered_cost_space(
    values: np.ndarray, guide: np.ndarray, candidates: DisparityRange, limit: float
) -> np.ndarray:
    """Figure 2 the naive way: the whole cost space of Eq. 5, each slice filtered, Eq. 4 on the winner."""
    height, width = values.shape
    whole = np.arange(candidates.lowest_px, candidates.highest_px)
    known = np.isfinite(values)
    space = np.where(known, np.minimum(limit, (whole[:, None, None] - values.astype(float)) ** 2), limit)
    result = np.full(values.shape, np.nan)
    for y in range(height):
        for x in range(width):
            rows, columns = slice(max(0, y - 3), y + 4), slice(max(0, x - 3), x + 4)
            if not known[rows, columns].any():
                continue
            grid_y, grid_x = np.mgrid[:height, :width]
            far = ((grid_y - y) ** 2 + (grid_x - x) ** 2)[rows, columns]
            gray = guide[rows, columns].astype(float) - float(guide[y, x])
            weight = np.exp(-0.5 * far / 4 - 0.5 * (gray / 10) ** 2)
            cost = (space[:, rows, columns] * weight).sum((1, 2)) / weight.sum()
            best = int(cost.argmin())
            result[y, x] = whole[best]
            if 0 < best < len(whole) - 1:
                low, here, high = cost[best - 1 : best + 2]
                result[y, x] -= (high - low) / (2 * (high + low - 2 * here))
    return result
