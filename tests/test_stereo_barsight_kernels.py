"""The kernels of our own stereo against slow, obvious references."""

from __future__ import annotations

import cv2
import numba
import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from barsight.core.errors import ConfigError
from barsight.stereo.direct.confidence import (
    Doubts,
    add_edge_sigma,
    disparity_bend,
    edge_risk,
    judge_matches,
    start_disagreement,
)
from barsight.stereo.direct.consistency import (
    agrees_with,
    drop_invalid,
    hits_valid,
    is_consistent,
    remove_islands,
)
from barsight.stereo.direct.curvature import curvature_row
from barsight.stereo.direct.depth_edges import (
    _BESIDE_PX,
    _DISTANCE_PX,
    _GRAY,
    _RADIUS_PX,
    mark_jumps,
    sharpen_edges,
)
from barsight.stereo.direct.disparity_update import (
    blend_fits,
    complete_step,
    fit_variance,
    raise_noise,
    update_disparity,
)
from barsight.stereo.direct.kernels.box_sums import (
    allocate_columns,
    mirror_index,
    roll_product,
    roll_square,
    roll_sum,
    slide_window,
    window_means,
)
from barsight.stereo.direct.kernels.cubic_spline import row_coefficients, row_slope, value_and_slope
from barsight.stereo.direct.kernels.pyramid import double_disparity, halve, upsample_update
from barsight.stereo.direct.occlusion_filling import fill_occlusions_by_planes, fill_row_holes
from barsight.stereo.direct.photometric_residuals import (
    noise_power,
    photometric_residual,
    robust_weights,
    step_gain,
)
from barsight.stereo.direct.plane_fits import SupportShape, fit_planes
from barsight.stereo.direct.plane_sums import (
    Evidence,
    SupportPairs,
    fit_lanes,
    place_pairs,
)
from barsight.stereo.direct.semiglobal.cost import BESIDE_COST, describe_pixels, reverse_rows, row_costs
from barsight.stereo.direct.semiglobal.matching import SemiGlobalSettings, match_semiglobal
from barsight.stereo.direct.semiglobal.paths import Penalties, allocate_paths, extend_row, p2_table
from barsight.stereo.direct.support_regions import (
    MARGIN,
    TILE_COLUMNS,
    TILE_ROWS,
    allocate_frame,
    axis_means,
    biweight,
    biweight_of_both,
    blend_rows,
    fitted_rows,
    inside,
    is_along_column,
    share_rows,
    tile_axes,
)

HEIGHT, WIDTH = 40, 70


def _noise(seed: int, spread: float = 1.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return (spread * rng.standard_normal((HEIGHT, WIDTH))).astype(np.float32)


def _frame(image: np.ndarray) -> np.ndarray:
    frame = allocate_frame(image.shape)
    inside(frame, image.shape)[:] = image
    return frame


def _mean(image: np.ndarray, side: int = 21) -> np.ndarray:
    return cv2.boxFilter(image, -1, (side, side))


def _axes(x: float, y: float) -> np.ndarray:
    shape = (-(-HEIGHT // TILE_ROWS), -(-WIDTH // TILE_COLUMNS), 2)
    return np.broadcast_to(np.array([x, y], dtype=np.float32), shape).copy()


def test_spline_goes_through_the_samples_and_has_their_slope() -> None:
    image = cv2.GaussianBlur(_noise(1, 40), (0, 0), 1.0)
    coefficients = row_coefficients(image)
    value, _ = value_and_slope(coefficients, np.zeros_like(image))
    np.testing.assert_allclose(value, image, atol=1e-4)
    shift = np.full_like(image, 3.3)
    value, slope = value_and_slope(coefficients, shift)
    inner = slice(14, -10)
    for row in (0, 17, HEIGHT - 1):
        curve = CubicSpline(np.arange(WIDTH), image[row].astype(np.float64))
        at = np.arange(WIDTH)[inner] - 3.3
        np.testing.assert_allclose(value[row, inner], curve(at), atol=1e-3)
        np.testing.assert_allclose(slope[row, inner], curve(at, 1), atol=1e-3)
    np.testing.assert_allclose(row_slope(image), value_and_slope(coefficients, 0 * image)[1], atol=1e-4)


def test_spline_of_a_blurred_image_blurs_first() -> None:
    image = (100 + _noise(1, 40)).clip(0, 255).astype(np.uint8)
    blurred = cv2.GaussianBlur(image.astype(np.float32), (0, 0), 0.7)
    np.testing.assert_allclose(row_coefficients(image, 0.7), row_coefficients(blurred), atol=1e-3)


def test_spline_reads_the_end_column_beyond_the_ends() -> None:
    image = _noise(2, 10)
    value, _ = value_and_slope(row_coefficients(image), np.full_like(image, 1000.0))
    np.testing.assert_allclose(value, np.repeat(image[:, :1], WIDTH, axis=1), atol=1e-4)


def test_axis_follows_stripes_and_is_the_column_on_noise() -> None:
    rows, columns = np.mgrid[0:96, 0:128].astype(np.float32)
    lean = np.radians(20)
    stripes = 100 + 40 * np.sin((columns * np.cos(lean) + rows * np.sin(lean)) * 0.7)
    axes = tile_axes(stripes.astype(np.float32))
    along = np.array([-np.sin(lean), np.cos(lean)])
    assert np.abs(axes[1:-1, 1:-1] @ along).min() > 0.998
    rng = np.random.default_rng(0)
    flat = tile_axes(cv2.GaussianBlur(rng.normal(100, 20, (96, 128)).astype(np.float32), (0, 0), 1.5))
    assert (np.abs(flat[..., 1]) == 1).mean() > 0.8


@pytest.mark.parametrize("direction", [(0.0, 1.0), (0.6, 0.8), (1.0, 0.0)])
def test_axis_means_are_weighted_means_along_the_axis(direction: tuple[float, float]) -> None:
    first, second, weight, alike = _noise(3), _noise(4), np.abs(_noise(5)), _noise(15, 0.5)
    found = np.empty_like(first), np.empty_like(first)
    frames = [_frame(image) for image in (first, second, weight, alike)]
    axis_means(*frames, _axes(*direction), 3.0, found)
    for y, x in ((0, 0), (13, 31), (39, 69), (20, 40)):
        total = sums = 0.0
        for step in range(-7, 8):
            row, column = y + round(step * direction[1]), x + round(step * direction[0])
            if 0 <= row < HEIGHT and 0 <= column < WIDTH:
                same = max(1 - (alike[row, column] - alike[y, x]) ** 2, 0) ** 2
                share = np.exp(-0.5 * (step / 3.0) ** 2) * same * weight[row, column]
                total += share
                sums += share * np.array([first[row, column], second[row, column]])
        np.testing.assert_allclose([found[0][y, x], found[1][y, x]], sums / total, rtol=2e-4, atol=1e-5)


def _planes(
    disparity: np.ndarray, weight: np.ndarray, pull: np.ndarray, shape: SupportShape, same_px: float,
    axis: tuple[float, float] = (0, 1), gray: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    frames = [_frame(image) for image in (disparity, weight, pull, 0 * pull if gray is None else gray)]
    room = tuple(allocate_frame(disparity.shape) for _ in range(3))
    return fit_planes(Evidence(*frames), _axes(*axis), [shape], same_px, room, disparity.shape)[0]


def test_planes_are_weighted_least_squares_on_the_support() -> None:
    disparity, weight, pull = _noise(6, 0.2), 0.2 + np.abs(_noise(7)), _noise(8, 0.1)
    shape, same, gray = SupportShape(4.0, 1.5), 1.0, _noise(9, 0.3)
    fitted, information = _planes(disparity, weight, pull, shape, same, gray=gray)
    for y, x in ((0, 0), (12, 20), (39, 69), (24, 33)):
        rows, values = [], []
        for down in range(-8, 9):
            for right in range(-3, 4):
                # The axis (0, 1) runs down; across it is -x.
                row, column = y + down, x - right
                if not (0 <= row < HEIGHT and 0 <= column < WIDTH):
                    continue
                gap = float(disparity[row, column] - disparity[y, x])
                tone = float(gray[row, column] - gray[y, column])
                kept = max(1 - (gap / same) ** 2 - min(tone**2, 0.78), 0) ** 2
                kept *= np.exp(-0.5 * (down / 4) ** 2 - 0.5 * (right / 1.5) ** 2)
                w = kept * weight[row, column]
                rows.append((w, down, right))
                values.append(w * gap + kept * pull[row, column])
        w, down, right = np.array(rows).T
        basis = np.column_stack([np.ones_like(w), down, right])
        normal = basis.T @ (w[:, None] * basis)
        held = 0.02 * (normal[1, 1] + normal[2, 2]) + 1e-3
        normal[[1, 2], [1, 2]] += held
        value = np.linalg.solve(normal, basis.T @ np.array(values))[0]
        assert fitted[y, x] == pytest.approx(disparity[y, x] + value, abs=2e-4)
        assert information[y, x] == pytest.approx(1 / np.linalg.inv(normal)[0, 0], rel=2e-3)


def _support(points: list[tuple[int, int]], on_axis: int) -> SupportPairs:
    a, c = np.array(points).T
    share = 0.9 ** np.abs(a) * 0.8 ** np.abs(c)
    factors = share[:, None] * np.stack([np.ones_like(a), a, c, a * a, a * c, c * c], axis=1)
    return SupportPairs(a, c, factors.astype(np.float32), on_axis)


def test_pairs_are_rotated_to_the_axis() -> None:
    offsets = np.empty((2, 3), dtype=np.int64)
    place_pairs(np.array([0.6, 0.8], np.float32), _support([(5, 2), (-5, 2), (10, 0)], 1), 1000, offsets)
    # Along the axis is (3, 4) for 5 px, across it (-1.6, 1.2) for 2 px.
    np.testing.assert_array_equal(offsets[0], [5 * 1000 + 1, -3 * 1000 - 5, 8 * 1000 + 6])
    np.testing.assert_array_equal(offsets[1], [1 * 1000 - 2, 1 * 1000 - 2, 0])


def test_planes_of_a_row_are_those_of_their_points_one_by_one() -> None:
    disparity, weight, pull, gray = (_noise(seed, 0.3) for seed in (20, 21, 22, 23))
    frames = [_frame(image) for image in (disparity, 0.1 + np.abs(weight), pull, gray)]
    framed_width, flat = frames[0].shape[1], Evidence(*(frame.reshape(-1) for frame in frames))
    points = [(-3, -2), (0, -2), (3, -2), (-3, -1), (0, -1), (3, -1), (-3, 0)]
    pairs, offsets = _support(points, 1), np.empty((2, len(points)), dtype=np.int64)
    place_pairs(np.array([0, 1], dtype=np.float32), pairs, framed_width, offsets)
    row, certain = np.empty(30, dtype=np.float32), np.empty(30, dtype=np.float32)
    middle = (20 + MARGIN) * framed_width + 5 + MARGIN
    fit_lanes(flat, middle, offsets, pairs, row, certain)
    for x in (0, 17, 29):
        normal, right, here = np.zeros((3, 3)), np.zeros(3), flat.disparity[middle + x]
        for a, c in [(0, 0), *points, *((-a, -c) for a, c in points)]:
            at = middle + x + a * framed_width - c
            gap, tone = flat.disparity[at] - here, flat.gray[at] - flat.gray[middle + x - c]
            share = 0.9 ** abs(a) * 0.8 ** abs(c) * max(1 - gap**2 - min(tone**2, 0.78), 0) ** 2
            basis = np.array([1, a, c])
            normal += share * flat.weight[at] * np.outer(basis, basis)
            right += share * (flat.weight[at] * gap + flat.pull[at]) * basis
        normal[[1, 2], [1, 2]] += 0.02 * (normal[1, 1] + normal[2, 2]) + 1e-3
        assert row[x] == pytest.approx(here + np.linalg.solve(normal, right)[0], abs=2e-5)
        assert certain[x] == pytest.approx(1 / np.linalg.inv(normal)[0, 0], rel=1e-4)


def test_a_row_goes_to_the_fitted_ones_that_are_like_it() -> None:
    leaning = np.array([[0.1, 0.995], [0.3, 0.954]], dtype=np.float32)
    assert [is_along_column(axis) for axis in leaning] == [True, False]
    assert [fitted_rows(y, 11) for y in (0, 5, 9, 10)] == [(0, 4), (4, 8), (8, 10), (8, 10)]
    image = np.zeros((HEIGHT, WIDTH), dtype=np.float32)
    image[8, 0], image[4, 1], image[[4, 8], 2] = 3, 3, 0.4
    frame, shares = _frame(image), np.empty(32, dtype=np.float32)
    assert share_rows(frame, 5, 0, HEIGHT, np.float32(0.5), shares)
    np.testing.assert_allclose(shares[:4], [0, 1, 0.25, 0.25])
    row = np.empty(4, dtype=np.float32)
    blend_rows(np.full_like(row, 1), np.full_like(row, 2), shares[:4], row)
    np.testing.assert_allclose(row, [1, 2, 1.25, 1.25])
    image[5, 30] = 3
    assert not share_rows(_frame(image), 5, 0, HEIGHT, np.float32(0.5), shares)


def test_rows_between_fitted_ones_share_them_where_they_are_one_surface() -> None:
    disparity, weight, pull = _noise(6, 0.02), 0.2 + np.abs(_noise(7)), _noise(8, 0.1)
    disparity[18, :34] += 5
    disparity[21:, 40:] += 5
    shape = SupportShape(4.0, 1.5)
    fitted, _ = _planes(disparity, weight, pull, shape, 1.0)
    for y, above, below in ((1, 0, 4), (6, 4, 8), (35, 32, 36), (38, 36, 39)):
        share = (y - above) / (below - above)
        between = (1 - share) * fitted[above] + share * fitted[below]
        np.testing.assert_allclose(fitted[y], between, atol=1e-5)
    # Below the step another surface goes on: each of its rows takes the nearest on its own side.
    np.testing.assert_array_equal(fitted[22, 64:], fitted[24, 64:])
    # What is like neither row is fitted for itself, as every row is where the axis is no column's.
    assert np.abs(fitted[18, :32] - disparity[18, :32]).max() < 1
    leaning, _ = _planes(disparity, weight, pull, shape, 1.0, (0.6, 0.8))
    middle = 0.5 * (leaning[4] + leaning[8])
    assert np.abs(leaning[6] - middle).max() > 0.01


def test_planes_keep_a_plane_in_steps_and_stop_at_a_jump() -> None:
    rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH].astype(np.float32)
    plane = 20 + 0.03 * columns - 0.01 * rows
    plane[:, 35:] += 6
    ones, zeros = np.ones_like(plane), np.zeros_like(plane)
    for step in (1, 3, 5):
        fitted, _ = _planes(plane, ones, zeros, SupportShape(8.0, 1.5, step), 1.0)
        np.testing.assert_allclose(fitted, plane, atol=0.03)


def test_planes_stop_at_the_outline_of_something_low() -> None:
    """A beam 0.4 px nearer, and brighter, than the floor does not pull the floor beside it."""
    disparity, gray = np.zeros((HEIGHT, WIDTH), np.float32), np.zeros((HEIGHT, WIDTH), np.float32)
    disparity[16:24], gray[16:24] = 0.4, 2.0
    weight, zeros = np.ones_like(gray), np.zeros_like(gray)
    weight[16:24] = 20  # The beam has more texture.
    for step in (1, 5):
        shape = SupportShape(8.0, 1.5, step)
        # An axis that is no column's, so that each row is fitted; across it, a support is a row or two high.
        clear = np.r_[:13, 19:21, 27:HEIGHT]
        blind, _ = _planes(disparity, weight, zeros, shape, 1.0, (0.3, 0.954))
        fitted, _ = _planes(disparity, weight, zeros, shape, 1.0, (0.3, 0.954), gray)
        assert np.abs(blind - disparity)[clear].max() > 0.1
        assert np.abs(fitted - disparity)[clear].max() < 0.03


def _slow_semiglobal(left: np.ndarray, right: np.ndarray, lowest: int, count: int) -> np.ndarray:
    """Sum of eight paths over an obvious cost volume: (H, W, count)."""
    settings = SemiGlobalSettings()
    height, width = left.shape
    framed = [np.pad(image.astype(int), 2, mode="edge") for image in (left, right)]
    bits = [
        np.stack(
            [
                f[2 + dy : 2 + dy + height, 2 + dx : 2 + dx + width] > f[2:-2, 2:-2]
                for dy in range(-2, 3)
                for dx in range(-2, 3)
            ],
            axis=-1,
        )
        for f in framed
    ]
    slopes = [
        cv2.filter2D(i, cv2.CV_16S, np.array([[-1, 0, 1]], np.float32)).astype(int) for i in (left, right)
    ]
    grays = [left.astype(int), right.astype(int)]
    cost = np.full((height, width, count), -1)
    for x in range(width):
        for k in range(count):
            there = x - lowest - k
            if 0 <= there < width:
                hamming = (bits[0][:, x] != bits[1][:, there]).sum(axis=-1)
                steep = np.minimum(np.abs(slopes[0][:, x] - slopes[1][:, there]), 20)
                bright = np.minimum(np.abs(grays[0][:, x] - grays[1][:, there]), 20)
                cost[:, x, k] = hamming + (steep + bright) // 2
        inside = np.flatnonzero(cost[0, x] >= 0)
        if inside.size == 0:
            cost[:, x] = 60
        else:
            cost[:, x, : inside[0]] = cost[:, x, inside[0], None]
            cost[:, x, inside[-1] + 1 :] = cost[:, x, inside[-1], None]
    total = np.zeros_like(cost)
    for dy, dx in ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)):
        path = np.zeros_like(cost)
        for y in range(height) if dy >= 0 else range(height - 1, -1, -1):
            for x in range(width) if dx >= 0 else range(width - 1, -1, -1):
                row, column = y - dy, x - dx
                if not (0 <= row < height and 0 <= column < width):
                    path[y, x] = cost[y, x]
                    continue
                before = path[row, column]
                contrast = abs(grays[0][y, x] - grays[0][row, column])
                jump = max(settings.p2 * 8 // (8 + contrast), settings.min_p2)
                near = np.minimum(np.append(before[1:], 10**6), np.append(10**6, before[:-1]))
                best = np.minimum(np.minimum(before, near + settings.p1), before.min() + jump)
                path[y, x] = cost[y, x] + best - before.min()
        total += path
    return total


@pytest.mark.parametrize("lowest", [0, -4, 3])
def test_semiglobal_is_the_minimum_of_the_eight_paths(lowest: int) -> None:
    rng = np.random.default_rng(9)
    wide = cv2.GaussianBlur(rng.normal(120, 90, (14, 60)), (0, 0), 1.0).clip(0, 255).astype(np.uint8)
    left, right = wide[:, 5:37].copy(), wide[:, 9:41].copy()
    found = match_semiglobal(left, right, lowest, 12, SemiGlobalSettings())
    total = _slow_semiglobal(left, right, lowest, 12)
    winner = total.argmin(axis=-1)
    assert np.abs(found.left_px - lowest - winner).max() <= 0.5
    rows, columns = np.indices(winner.shape)
    for y, x in zip(rows.ravel(), columns.ravel(), strict=True):
        seen = [d for d in range(12) if 0 <= x + d + lowest < 32]
        if seen:
            best = min(seen, key=lambda d: total[y, x + d + lowest, d])
            assert found.right_px[y, x] == best + lowest


def test_costs_are_hamming_distance_and_truncated_differences() -> None:
    rng = np.random.default_rng(12)
    left, right = (rng.integers(0, 256, (6, 40)).astype(np.uint8) for _ in range(2))
    lowest, count, places = -3, 20, 32
    found = np.empty((40, places), dtype=np.uint8)
    row_costs(
        describe_pixels(left), reverse_rows(describe_pixels(right), lowest, places), 4, lowest, count, found
    )
    framed = [np.pad(image, 2, mode="edge") for image in (left, right)]
    gray, slope = (
        [image[4].astype(int) for image in (left, right)],
        [np.gradient(np.pad(image[4].astype(int), 1, mode="reflect"))[1:-1] * 2 for image in (left, right)],
    )
    for x in range(40):
        for k in range(count):
            there = x - lowest - k
            if 0 <= there < 40:
                codes = [f[4:9, at : at + 5] > f[6, at + 2] for f, at in zip(framed, (x, there), strict=True)]
                steep = min(abs(slope[0][x] - slope[1][there]), 20)
                bright = min(abs(gray[0][x] - gray[1][there]), 20)
                assert found[x, k] == (codes[0] != codes[1]).sum() + (steep + bright) // 2
    assert (found[:, count:] == BESIDE_COST).all()


@pytest.mark.parametrize("backwards", [False, True])
def test_rows_of_paths_follow_the_recursion(backwards: bool) -> None:
    rng = np.random.default_rng(13)
    width, places, small, jumps = 9, 48, 22, p2_table(150, 28)
    costs, grays = rng.integers(0, 61, (3, width, places)), rng.integers(0, 256, (3, width))
    paths, leasts = allocate_paths(width, places, small), np.empty((2, width, 3), dtype=np.uint8)
    sums = np.empty((width, places), dtype=np.uint16)
    above: dict[tuple[int, int], np.ndarray] = {}
    for y in range(3):
        extend_row(
            costs[y].astype(np.uint8), grays[y].astype(np.uint8), grays[max(y - 1, 0)].astype(np.uint8),
            Penalties(small, jumps), y == 0, (y & 1) == 1, backwards, paths, leasts, sums,
        )  # fmt: skip
        here: dict[tuple[int, int], np.ndarray] = {}
        beside: np.ndarray | None = None
        for x in range(width)[:: -1 if backwards else 1]:
            befores = [
                (above.get((way, x + way)), grays[y - 1, min(max(x + way, 0), width - 1)])
                for way in (-1, 0, 1)
            ]
            befores.append((beside, grays[y, min(max(x + (1 if backwards else -1), 0), width - 1)]))
            values = []
            for before, gray in befores:
                value = costs[y, x]
                if before is not None:
                    near = np.minimum(np.append(before[1:], 10**6), np.append(10**6, before[:-1]))
                    jump = before.min() + int(jumps[abs(grays[y, x] - gray)])
                    value = value + np.minimum(np.minimum(before, near + small), jump) - before.min()
                values.append(value)
            for way, value in zip((-1, 0, 1), values, strict=False):
                here[way, x] = value
            beside = values[3]
            assert np.array_equal(sums[x], sum(values))
        above = here


def test_rolling_sums_are_window_means() -> None:
    image, reach = _noise(24, 20), 3
    columns, mean = allocate_columns(1, WIDTH, reach)[0], np.empty(WIDTH, dtype=np.float32)
    for y in range(2 * reach + 1):
        roll_sum(columns, reach, image[y], np.zeros(WIDTH, dtype=np.float32))
    slide_window(columns, reach, mean)
    np.testing.assert_allclose(mean, _mean(image, 2 * reach + 1)[reach], rtol=1e-4, atol=1e-4)


def test_the_number_of_threads_changes_no_bit() -> None:
    rng = np.random.default_rng(17)
    left = cv2.GaussianBlur(rng.integers(0, 255, (130, 160)).astype(np.uint8), (0, 0), 1.2)
    right = np.roll(left, -6, axis=1)
    before, found = numba.get_num_threads(), []
    try:
        for threads in range(1, before + 1):
            numba.set_num_threads(threads)
            found.append(match_semiglobal(left, right, 0, 20, SemiGlobalSettings()))
    finally:
        numba.set_num_threads(before)
    if before == 1:
        pytest.skip("this machine has one core")
    for one in found[1:]:
        assert one.left_px.tobytes() == found[0].left_px.tobytes()
        assert one.right_px.tobytes() == found[0].right_px.tobytes()


def test_stripes_of_the_semiglobal_match_leave_no_mark() -> None:
    rng = np.random.default_rng(10)
    wide = cv2.GaussianBlur(rng.normal(120, 90, (300, 90)), (0, 0), 1.2).clip(0, 255).astype(np.uint8)
    left, right = wide[:, :64].copy(), wide[:, 7:71].copy()
    whole = match_semiglobal(left, right, 0, 20, SemiGlobalSettings()).left_px
    assert (np.abs(whole[:, 10:] - 7) < 0.5).mean() > 0.999


def test_left_right_check_and_islands() -> None:
    left, right = np.full((8, 20), 3, np.float32), np.full((8, 20), 3, np.float32)
    right[2, 5] = 6
    same = is_consistent(left, right, 1.0)
    assert not same[:, :3].any()
    assert not same[2, 8]
    assert same[:, 3:].sum() == 8 * 17 - 1
    valid = np.ones((8, 20), dtype=bool)
    valid[1, 0], valid[2, 5] = False, False
    landed = hits_valid(valid, left)
    assert not landed[1, :4].any() and not landed[2, 8]
    assert landed.sum() == 8 * 20 - 5
    left[4:6, 10:12] = 9
    cleaned = remove_islands(left, 10, 1.0)
    assert np.isnan(cleaned[4:6, 10:12]).all()
    assert np.isfinite(cleaned).sum() == 8 * 20 - 4


def test_weighted_median_beside_jumps_agrees_with_sorting() -> None:
    rng = np.random.default_rng(11)
    disparity = np.where(np.arange(WIDTH) < 30, 10.0, 14.0) + rng.uniform(0, 0.4, (HEIGHT, WIDTH))
    disparity = disparity.astype(np.float32)
    disparity[5:9, 20:26] = np.nan
    gray = (60 + 80 * (np.arange(WIDTH) < 32) + rng.integers(0, 8, (HEIGHT, WIDTH))).astype(np.uint8)
    sharp = sharpen_edges(disparity, gray, 1.0)
    assert np.array_equal(np.isnan(sharp), np.isnan(disparity))
    far = np.abs(np.arange(WIDTH) - 29.5) > _BESIDE_PX + 2
    assert np.array_equal(sharp[:, far], disparity[:, far], equal_nan=True)
    for y, x in ((0, 29), (7, 30), (20, 31), (39, 28)):
        rows = slice(max(0, y - _RADIUS_PX), y + _RADIUS_PX + 1)
        columns = slice(max(0, x - _RADIUS_PX), x + _RADIUS_PX + 1)
        there = disparity[rows, columns]
        row, column = np.indices(there.shape)
        distance = (row + rows.start - y) ** 2 + (column + columns.start - x) ** 2
        contrast = np.abs(gray[rows, columns].astype(float) - float(gray[y, x]))
        weight = np.exp(-distance / (2 * _DISTANCE_PX**2) - contrast / _GRAY)
        known = np.isfinite(there)
        order = np.argsort(there[known])
        passed = np.cumsum(weight[known][order])
        median = there[known][order][np.searchsorted(passed, passed[-1] / 2)]
        assert sharp[y, x] == pytest.approx(median, abs=0.03)
    assert (sharp[:, 30:32] < 12).mean() > 0.9, "the edge moves to where the image has it"


def test_filling_continues_the_plane_behind_and_leaves_the_input() -> None:
    columns = np.mgrid[0:60, 0:120][1].astype(np.float32)
    disparity = 20 + 0.05 * columns
    disparity[:, 70:] = 45
    disparity[:, 60:70] = np.nan
    disparity[:, :12] = np.nan
    before = disparity.copy()
    right = np.full_like(disparity, 30)
    filled, sigma = fill_occlusions_by_planes(
        disparity, np.full(disparity.shape, 100, np.uint8), right, 0, 60
    )
    assert np.array_equal(before, disparity, equal_nan=True)
    hidden = (slice(None), slice(60, 70))
    assert (np.abs(filled[hidden] - (20 + 0.05 * columns[hidden])) < 0.5).mean() > 0.97
    border = (slice(None), slice(0, 12))
    assert np.abs(filled[border] - (20 + 0.05 * columns[border])).max() < 0.5
    assert np.array_equal(np.isfinite(sigma), np.isnan(before))
    assert np.nanmin(sigma) >= 1


def test_filling_leaves_an_empty_map_empty() -> None:
    empty = np.full((20, 30), np.nan, np.float32)
    filled, sigma = fill_occlusions_by_planes(
        empty, np.zeros((20, 30), np.uint8), np.zeros((20, 30), np.float32), 0, 10
    )
    assert np.isnan(filled).all()
    assert np.isnan(sigma).all()


def test_bend_is_zero_on_a_plane_and_half_the_step_beside_an_edge() -> None:
    rows, columns = np.mgrid[0:20, 0:30].astype(np.float32)
    plane = 0.1 * columns + 0.2 * rows
    assert disparity_bend(plane, 0.5)[4:-4, 4:-4].max() < 1e-5
    step = np.where(columns < 15, 0, 0.6).astype(np.float32)
    assert disparity_bend(step, 0.5)[10, 13] == pytest.approx(0.3)
    assert disparity_bend(step * 100, 0.5).max() == np.float32(0.5)


def test_penalties_must_be_in_order() -> None:
    with pytest.raises(ConfigError, match="penalties"):
        SemiGlobalSettings(p1=50, p2=40)


def _curvature(disparity: np.ndarray, axes: np.ndarray) -> np.ndarray:
    curvature = np.empty_like(disparity)
    for y, row in enumerate(curvature):
        curvature_row(disparity, axes, y, row)
    return curvature


def test_curvature_is_taken_across_the_axis_and_not_over_a_jump() -> None:
    rows, columns = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    round_across_rows = 0.5 * 0.01 * (columns - 35) ** 2 + 0.3 * rows + 0.05 * columns
    inner = (slice(8, 32), slice(25, 45))
    down = _curvature(round_across_rows, _axes(0.0, 1.0))
    np.testing.assert_allclose(down[inner], 0.01, atol=1e-5)
    along = _curvature(round_across_rows, _axes(1.0, 0.0))
    np.testing.assert_allclose(along[inner], 0.0, atol=1e-5)
    stepped = np.where(columns > 35, np.float32(4), np.float32(0))
    assert not _curvature(stepped, _axes(0.0, 1.0)).any()


def test_disagreement_of_start_and_refinement_forgets_noise_and_holes() -> None:
    refined = np.full((HEIGHT, WIDTH), 5, dtype=np.float32)
    start = refined - 0.3
    start[:, ::7] = np.nan
    np.testing.assert_allclose(start_disagreement(start, refined), 0.3, atol=1e-5)
    assert np.median(start_disagreement(refined + _noise(3, 0.3), refined)) < 0.03
    assert not start_disagreement(np.full_like(refined, np.nan), refined).any()


def _with_holes(seed: int, ratio: float = 0.2) -> np.ndarray:
    disparity = 20 + _noise(seed, 3.0)
    disparity[np.random.default_rng(seed).random(disparity.shape) < ratio] = np.nan
    return disparity


def test_bends_at_the_border_are_of_the_mirrored_picture() -> None:
    disparity = 20 + _noise(40, 0.3)
    framed = np.pad(disparity, 3, mode="reflect")
    inner = slice(3, -3)
    along = np.abs(disparity - np.float32(0.5) * (framed[inner, :-6] + framed[inner, 6:]))
    down = np.abs(disparity - np.float32(0.5) * (framed[:-6, inner] + framed[6:, inner]))
    np.testing.assert_array_equal(disparity_bend(disparity, 0.5), np.maximum(along, down).clip(max=0.5))


def test_jumps_are_what_the_greatest_and_least_of_nine_say() -> None:
    disparity = _with_holes(41)
    framed = np.pad(disparity, 1, constant_values=np.nan)
    marked = mark_jumps(disparity, 4.0)
    for y, x in np.ndindex(disparity.shape):
        around = framed[y : y + 3, x : x + 3]
        known = around[np.isfinite(around)]
        assert marked[y, x] == (known.size > 0 and np.ptp(known) > 4)


def test_sigma_sums_the_squares_of_all_doubts_and_far_or_unsure_matches_are_none() -> None:
    start, refined = _with_holes(42), 20 + _noise(43, 3.0)
    variance, bend, moved = (np.abs(_noise(seed, 0.3)) for seed in (44, 45, 46))
    doubts = Doubts(*(np.float32(x) for x in (0.01, 0.3, 0.09, 2.0, 0.7)))
    found, sigma = judge_matches(start, refined, variance, bend, moved, doubts)
    wanted = np.sqrt(variance + 0.01 + 0.3 * np.maximum(bend**2 - variance, 0) + (0.09 * moved) ** 2)
    kept = np.isfinite(start) & (np.abs(refined - start) < 2) & (wanted <= 0.7)
    assert 0.05 < kept.mean() < 0.9
    np.testing.assert_array_equal(found, np.where(kept, refined, np.nan))
    np.testing.assert_allclose(sigma, np.where(kept, wanted, np.nan), rtol=1e-5)


def test_edges_add_to_sigma_and_invalid_pixels_have_none() -> None:
    before, beside, valid = _with_holes(47), np.abs(_noise(48, 0.3)), _noise(49) > -1
    sharp, sigma = before + _noise(50, 0.1), np.where(np.isfinite(before), np.float32(0.1), np.nan)
    wanted = np.where(valid, np.sqrt(sigma**2 + (sharp - before) ** 2 + (0.3 * beside) ** 2), np.nan)
    kept = np.where(valid, sharp, np.nan)
    add_edge_sigma(before, sharp, beside, 0.3, valid, sigma)
    np.testing.assert_allclose(sigma, wanted, rtol=1e-5)
    np.testing.assert_array_equal(sharp, kept)


@pytest.mark.parametrize(("shape", "rows"), [((40, 70), 2), ((39, 69), 2), ((20, 69), 1)])
def test_doubled_disparity_repeats_its_pixels(shape: tuple[int, int], rows: int) -> None:
    small = _with_holes(51)[:20, :35]
    wanted = 2 * small.repeat(rows, axis=0).repeat(2, axis=1)[: shape[0], : shape[1]]
    np.testing.assert_array_equal(double_disparity(small, shape), wanted)


def test_a_match_agrees_within_the_tolerance_inside_the_picture() -> None:
    right = np.array([2, 3, np.nan, 5], dtype=np.float32)
    asked = [(3, 2.0), (3, 2.5), (3, 3.0), (3, 4.0), (1, -1.0), (3, np.nan)]
    found = [agrees_with(right, x, np.float32(px), np.float32(1)) for x, px in asked]
    assert found == [True, True, True, False, False, False]


def test_matches_of_invalid_pixels_are_dropped() -> None:
    left_valid, right_valid, disparity = _noise(52) > -1, _noise(53) > -1, _with_holes(54)
    kept = disparity.copy()
    drop_invalid(left_valid, right_valid, kept)
    for y, x in np.argwhere(np.isfinite(disparity)):
        column = min(max(round(float(np.float32(x) - disparity[y, x])), 0), WIDTH - 1)
        assert np.isfinite(kept[y, x]) == (left_valid[y, x] and right_valid[y, column])
    assert np.isnan(kept[np.isnan(disparity)]).all()


def test_a_step_that_falls_short_is_completed_and_noisier() -> None:
    short_of, usable, moved = 1 + np.abs(_noise(55)), np.abs(_noise(56)), _noise(57, 0.1)
    power, disparity = np.abs(_noise(58)), _frame(20 + _noise(59))
    before = inside(disparity, power.shape).copy()
    noisier = power * np.minimum(short_of, 1.5 - (short_of - 1.5) / 6)
    raise_noise(short_of, power)
    np.testing.assert_allclose(power, noisier, rtol=1e-5)
    complete_step(moved, usable, short_of, disparity)
    wanted = before + (short_of - 1) * moved / (usable + 1e-6)
    np.testing.assert_allclose(inside(disparity, power.shape), wanted, rtol=1e-4)


@pytest.mark.parametrize("ratio", [0.0, 0.3, 0.31, 0.995, 1.0])
def test_rows_without_any_disparity_take_the_median_of_all(ratio: float) -> None:
    disparity = _with_holes(60, ratio)
    disparity[7] = np.nan
    known = disparity[np.isfinite(disparity)]
    assert (fill_row_holes(disparity)[7] == (np.median(known) if known.size else 0)).all()


def test_only_jumps_between_known_neighbours_are_edges() -> None:
    disparity = np.full((HEIGHT, WIDTH), 5, dtype=np.float32)
    disparity[:, 40:] = 9
    disparity[:, 20] = np.nan
    beside, other_side = edge_risk(disparity, 1.0)
    assert (beside[:, 39:41] == 1).all() and (beside[:, 18:23] < 0.01).all()
    assert (other_side[:, 38:42] == 4).all() and not other_side[:, :37].any() and not other_side[:, 43:].any()
    np.testing.assert_allclose(beside[20, 43], np.exp(-1.0), rtol=0.05)
    assert edge_risk(disparity, 1.0, other_side=False)[1] is None


def test_windows_are_what_box_filters_say() -> None:
    images, weight = np.stack([_noise(21, 20) + 100, _noise(22, 30) + 90]), _noise(23)
    sums = window_means(images, weight, 21, 10)
    for image, summed in zip(images, sums, strict=True):
        np.testing.assert_allclose(summed, _mean(weight * image)[::10, ::10], rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("rows", [HEIGHT, 300])
def test_comparison_is_what_box_filters_say(rows: int) -> None:
    rng = np.random.default_rng(21)
    left, right = (rng.normal(95, 20, (rows, WIDTH)).astype(np.float32) for _ in range(2))
    usable = (rng.random((rows, WIDTH)) > 0.2).astype(np.float32)
    share = _mean(usable) + 1e-6
    means = [_mean(usable * image) / share for image in (left, right)]
    powers = [_mean(usable * i * i) / share - m * m + 4 for i, m in zip((left, right), means, strict=True)]
    wanted = left - means[0] - np.sqrt(powers[0] / powers[1]) * (right - means[1])
    residual, trust = allocate_frame(left.shape), allocate_frame(left.shape)
    photometric_residual(left, right, usable, 21, 8.0, residual, trust)
    np.testing.assert_allclose(inside(residual, left.shape), wanted, atol=5e-3)
    np.testing.assert_allclose(inside(trust, left.shape), usable / (1 + (wanted / 8) ** 2), atol=1e-3)


def test_pulls_are_what_box_filters_say() -> None:
    residual, slope, trust = _noise(31, 5), _noise(32, 10), np.abs(_noise(33))
    means, usable = (_noise(34), _noise(35)), (_noise(36) > -0.8).astype(np.float32)
    detail, slope_detail = residual - means[0], slope - means[1]
    agreement = (_mean(trust * detail**2) + 1e-3) / (
        2 * np.sqrt(np.pi) * 10 * _mean(trust * means[0] ** 2) + 1e-3
    )
    share = np.minimum(1, 0.5 * agreement)
    wanted = trust * (slope_detail**2 + share * means[1] ** 2)
    wanted_pull = -trust * (slope_detail * detail + share * means[1] * means[0])
    weight, pull = allocate_frame(usable.shape), allocate_frame(usable.shape)
    robust_weights(_frame(residual), _frame(slope), _frame(trust), means, 21, 10.0, 0.5, weight, pull)
    np.testing.assert_allclose(inside(weight, usable.shape), wanted, rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(inside(pull, usable.shape), wanted_pull, rtol=1e-3, atol=1e-2)

    mean_weight = np.empty_like(usable)
    short_of = step_gain(weight, _frame(trust), 20.0, 21, False, pull, mean_weight)
    mean = _mean(wanted)
    longer = mean / np.maximum(mean - 20 * _mean(trust), mean / 3 + 1e-6)
    np.testing.assert_allclose(mean_weight, mean, rtol=1e-4)
    np.testing.assert_allclose(short_of, longer, rtol=1e-3)
    wanted_pull = wanted_pull * longer
    np.testing.assert_allclose(inside(pull, usable.shape), wanted_pull, rtol=1e-3, atol=2e-2)

    power = noise_power(pull, usable, _mean(usable), mean_weight, 0.1, 21)
    blocks = cv2.boxFilter(wanted_pull, -1, (3, 3), normalize=False)
    mean, seen = mean + 1e-3, _mean(usable) + 1e-6
    wanted_power = _mean(usable * blocks**2) / 9 / mean * (mean + 0.1 * seen) / mean
    np.testing.assert_allclose(power, wanted_power, rtol=2e-3)


def test_noise_power_is_not_negative_beside_strong_pulls() -> None:
    """Sliding sums leave a rest of either sign where strong pulls have gone by; no weight holds it down."""
    shape, rng = (240, 200), np.random.default_rng(3)
    pull, ones = allocate_frame(shape), np.ones(shape, np.float32)
    inside(pull, shape)[:] = rng.normal(0, 1e-2, shape)
    inside(pull, shape)[20:60, :90] = rng.normal(0, 1e6, (40, 90))
    assert noise_power(pull, ones, ones, 1e-3 * ones, 0.1, 21).min() >= 0


def test_a_step_at_half_size_is_carried_up_without_mixing_surfaces() -> None:
    y, x = np.mgrid[0:41, 0:63].astype(np.float32)
    start = np.where(x < 30, 20 + 0.05 * x + 0.03 * y, 40 - 0.04 * x).astype(np.float32)
    small = halve(start)
    assert small.shape == (21, 32)
    np.testing.assert_allclose(small[3, 5], start[6:8, 10:12].mean(), rtol=1e-6)
    moved = np.where(np.arange(32)[None, :] < 15, 0.1, -0.2).astype(np.float32) * np.ones((21, 1), np.float32)
    carried = upsample_update(0.5 * small, moved, start, 1.0)
    np.testing.assert_allclose(carried - start, np.where(x < 30, 0.2, -0.4), atol=1e-5)

    ramp = np.broadcast_to(np.arange(32, dtype=np.float32) * 0.01, (21, 32)).copy()
    rising = upsample_update(np.full_like(small, 10), ramp, np.full_like(start, 20), 1.0)
    inner = slice(1, 61)
    np.testing.assert_allclose(rising[:, inner] - 20, (0.01 * (x - 0.5))[:, inner], atol=1e-5)


def test_supports_are_blended_and_steps_settled_as_written() -> None:
    long, short = _noise(41), _noise(42, 0.5)
    information, power = (1 + np.abs(_noise(43)), 1 + np.abs(_noise(44))), 0.1 * np.abs(_noise(45))
    usable = (_noise(46) > -0.8).astype(np.float32)
    variance = [fit_variance(power, one) for one in information]
    gap = long - short
    excess = _mean(usable * (gap**2 - 0.5 * variance[1]), 9) / (_mean(usable, 9) + 1e-6)
    share = variance[1] / (variance[1] + np.maximum(excess, 0) + 1e-9)
    fitted, unsure = blend_fits((long, information[0]), (short, information[1]), power, usable)
    np.testing.assert_allclose(fitted, short + share * gap, atol=1e-4)
    mixture = share * variance[0] + (1 - share) * (variance[1] + share * gap**2)
    np.testing.assert_allclose(unsure, mixture, atol=1e-5)

    fitted, axes, start = _noise(47, 0.1), _axes(0.6, 0.8), _noise(48)
    sag = 1.5 * _mean(_curvature(fitted, axes), 11)
    move = np.clip(fitted - sag - start, -1.5, 1.5)
    wanted = unsure + 0.25 * sag**2
    disparity = _frame(start)
    update_disparity(fitted, axes, disparity, unsure)
    np.testing.assert_allclose(inside(disparity, start.shape), start + move, atol=1e-5)
    np.testing.assert_allclose(unsure, wanted, rtol=1e-4, atol=1e-5)


def test_sums_of_products_roll_on_as_windows_do() -> None:
    """A window of seven rows goes down the image: what comes in and goes leaves the sums of its rows."""
    one, other, reach = _noise(31), _noise(32), 3
    products, squares = allocate_columns(2, WIDTH, reach)
    none = np.zeros(WIDTH, dtype=np.float32)
    for y in range(HEIGHT):
        ahead, behind = (one[y], other[y]), (one[y - 7], other[y - 7]) if y >= 7 else (none, none)
        roll_product(products, reach, *ahead, *behind)
        roll_square(squares, reach, *ahead, *behind)
    inner = slice(reach, reach + WIDTH)
    np.testing.assert_allclose(products[inner], (one * other)[-7:].sum(axis=0), atol=1e-4)
    np.testing.assert_allclose(squares[inner], (one * other**2)[-7:].sum(axis=0), atol=1e-4)
    assert not products[:reach].any() and not squares[reach + WIDTH :].any()


def test_places_are_mirrored_at_the_last_pixel() -> None:
    for count in range(1, 8):
        wanted = np.pad(np.arange(count), 15, mode="reflect")
        assert [mirror_index(place, count) for place in range(-15, count + 15)] == wanted.tolist()


def test_biweight_ends_at_one() -> None:
    gaps = np.array([-2, -1, -0.5, 0, 0.25, 1, 3], dtype=np.float32)
    assert [biweight(gap) for gap in gaps] == [0, 0, 0.5625, 1, 0.87890625, 0, 0]
    zero, half = np.float32(0), np.float32(0.5)
    assert [biweight_of_both(gap, zero) for gap in gaps] == [biweight(gap) for gap in gaps]
    assert [biweight_of_both(half, tone) for tone in (half, -half, np.float32(0.9))] == [0.25, 0.25, 0]
    assert biweight_of_both(zero, np.float32(5)) == pytest.approx(0.0484, abs=1e-4)
