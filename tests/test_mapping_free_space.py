"""Free space: bounds are never below what stands, and lines of sight prove an unseen gully free."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from barsight.mapping.free_space import (
    LEVEL_M,
    NO_END,
    OVER_END_M,
    FreeSpace,
    bound_heights,
    level_heights,
    sweep_rays,
)
from barsight.mapping.observation import CellObservations

CELL_M = 0.01
X = np.arange(-100, 200)
BLOCK, GULLY = (X >= 40) & (X < 60), (X >= 60) & (X < 80)
HEIGHT = np.where(BLOCK, 0.6, np.where((X >= 20) & (X < 40), 0.3, np.where(GULLY, 0.0, 0.25)))
"""A section that is the same at each y: 0.3 m high, then a block of 0.6 m, a gully, and 0.25 m again."""


def seen_from(eye_x_m: float, eye_z_m: float = 7.0) -> CellObservations:
    """The section's cells that the eye sees, by marching along each line of sight."""
    seen = []
    for x, z in zip(X, HEIGHT, strict=True):
        for height in np.arange(z + 0.002, 0.7, 0.002):
            at = x * CELL_M + (height - z) / (eye_z_m - z) * (eye_x_m - x * CELL_M)
            cell = int(np.floor(at / CELL_M + 0.5)) - X[0]
            if 0 <= cell < X.size and cell != x - X[0] and HEIGHT[cell] >= height:
                break
        else:
            seen.append(x)
    x = np.repeat(np.array(seen, np.int32), 40)
    y = np.tile(np.arange(40, dtype=np.int32), len(seen))
    z = HEIGHT[x - X[0]].astype(np.float32)
    nothing = np.zeros(x.size, np.float32)
    return CellObservations(x, y, np.ones(x.size, bool), z, nothing, nothing, nothing)


def carved(*eyes_x_m: float) -> np.ndarray:
    free = FreeSpace(CELL_M)
    for x in eyes_x_m:
        free.carve(seen_from(x), np.array([[x, 0.2, 7.0]]))
    return free.window(int(X[0]), 10, X.size, 20)


def test_bounds_are_never_below_what_stands() -> None:
    bounds = carved(-1.0, -0.6, 1.0, 2.0, 2.4)
    assert (bounds >= HEIGHT[None]).all()
    assert np.isfinite(bounds).mean() > 0.5


def test_a_gully_that_nobody_saw_is_proven_free_by_what_was_seen_beyond() -> None:
    eyes = (-2.5, -2.2)
    bottom = (X >= 70) & (X < 74)
    assert not np.isin(X[bottom], seen_from(eyes[0]).x).any()
    assert (carved(*eyes)[:, bottom] < HEIGHT.max()).all()


def test_one_view_proves_nothing() -> None:
    assert np.isinf(carved(-1.0)).all()


def test_matches_that_mix_front_and_back_at_an_edge_prove_nothing() -> None:
    free, rng = FreeSpace(CELL_M), np.random.default_rng(3)
    for eye_x_m in (-1.0, -0.6, 2.0, 2.4):
        cells = seen_from(eye_x_m)
        edge = np.isin(cells.x, [40, 41, 58, 59]) & (rng.random(cells.x.size) < 0.5)
        z_m = np.where(edge, np.float32(0.1), cells.z_m)
        free.carve(replace(cells, z_m=z_m), np.array([[eye_x_m, 0.2, 7.0]]))
    assert (free.window(int(X[0]), 10, X.size, 20) >= HEIGHT[None]).all()


@pytest.mark.parametrize("eye_cells", [(30.0, 41.0), (-25.0, 12.0), (90.0, 100.0), (1.2, 30.0), (-1.2, 40.0)])
def test_bounds_are_those_of_single_lines_of_sight(eye_cells: tuple[float, float]) -> None:
    rng, shape, eye_z_m = np.random.default_rng(2), (80, 70), 6.0
    ends = np.full(shape, NO_END)
    ends[tuple(rng.integers(0, 70, (2, 40)))] = rng.uniform(0, 1, 40).astype(np.float32)
    bound = np.full(shape, np.inf, np.float32)
    eye = np.array([*(CELL_M * np.array(eye_cells)), eye_z_m])
    sweep_rays(ends, np.zeros(shape, np.uint8), eye, CELL_M, bound)
    lowest, middle = np.full(shape, np.inf), np.full(shape, np.inf)
    for row, column in np.argwhere(np.isfinite(ends)):
        for aside in np.ndindex(5, 5):
            start = (column, row) + 0.24 * (np.array(aside) - 2)
            to_eye = np.array(eye_cells) - start
            t = np.arange(0, 1, 0.1 / np.hypot(*to_eye))
            at_x, at_y = np.floor(start + t[:, None] * to_eye + 0.5).astype(int).T
            inside = (at_y >= 0) & (at_y < shape[0]) & (at_x >= 0) & (at_x < shape[1])
            inside &= (at_y != row) | (at_x != column)
            height = ends[row, column] + t * (eye_z_m - ends[row, column]) + OVER_END_M
            np.minimum.at(lowest, (at_y[inside], at_x[inside]), height[inside])
            if aside == (2, 2):
                np.minimum.at(middle, (at_y[inside], at_x[inside]), height[inside])
    # A line enters a cell lower than it leaves it, by its slope (m per cell).
    both = np.isfinite(bound) & np.isfinite(middle)
    slope = (eye_z_m - 0.5) / np.hypot(*(np.argwhere(both) - eye_cells[::-1]).T)
    assert both.sum() > 0.7 * np.isfinite(middle).sum() > 300
    assert (bound >= lowest).all()
    assert np.median((bound[both] - middle[both]) / slope) < 1.5


def test_a_plane_lets_no_wall_through() -> None:
    ends = np.full((60, 60), np.float32(0.2))
    ends[:, 40:] = NO_END
    ends[20:22, :] = NO_END
    bound = np.full(ends.shape, np.inf, np.float32)
    sweep_rays(ends, np.zeros(ends.shape, np.uint8), np.array([6.0, 0.3, 7.0]), CELL_M, bound)
    # From +X, the eye sees the ends at the left through the cells to the right of them.
    assert np.isfinite(bound[5:15, 20:60]).all()
    assert (bound[5:15, 1:38] < 0.2 + OVER_END_M + 0.06).all()
    assert (bound[:, 45] > 0.2 + 0.05).all()


@pytest.mark.parametrize("corner", [(-300, -300), (250, 130)])
def test_tiles_join_without_a_seam(corner: tuple[int, int]) -> None:
    cells = seen_from(0.0)
    whole, moved = FreeSpace(CELL_M), FreeSpace(CELL_M)
    shifted = CellObservations(
        cells.x + np.int32(corner[0]), cells.y + np.int32(corner[1]), cells.central, cells.z_m,
        cells.variance_m2, cells.shared_m, cells.intensity,
    )  # fmt: skip
    for _ in range(2):
        whole.carve(cells, np.array([[0.003, 0.201, 7.0]]))
        moved.carve(shifted, np.array([[0.003 + CELL_M * corner[0], 0.201 + CELL_M * corner[1], 7.0]]))
    here = whole.window(int(X[0]), 0, X.size, 40)
    there = moved.window(int(X[0]) + corner[0], corner[1], X.size, 40)
    np.testing.assert_allclose(here, there, atol=1e-4)


def test_heights_of_a_cell_are_bounded_by_its_highest_and_its_lowest() -> None:
    rng = np.random.default_rng(4)
    row, column = rng.integers(0, 9, (2, 200)).astype(np.int32)
    z = rng.normal(0, 1, 200).astype(np.float32)
    highest, lowest = np.full((9, 9), -np.inf, np.float32), np.full((9, 9), np.inf, np.float32)
    bound_heights(column, row, z, (0, 0), highest, lowest)
    for i, j in np.ndindex(9, 9):
        of_cell = z[(row == i) & (column == j)]
        assert highest[i, j] == max(of_cell, default=-np.inf)
        assert lowest[i, j] == min(of_cell, default=np.inf)


@pytest.mark.parametrize(("cell_m", "reach"), [(0.005, 4), (0.008, 3), (0.01, 2), (0.02, 2)])
def test_level_heights_agree_with_a_slow_reference(cell_m: float, reach: int) -> None:
    rng, side = np.random.default_rng(6), 30
    x, y = rng.integers(-side, side, (2, 900)).astype(np.int32)
    z = (0.2 * (x // (3 * reach) % 2) + rng.uniform(0, 0.04, x.size)).astype(np.float32)
    none = np.zeros(x.size, np.float32)
    cells = CellObservations(x, y, none > 0, z, none, none, none)
    level, holes = level_heights(cells, (-side, -side), (2 * side, 2 * side), cell_m)
    slow = np.full_like(level, NO_END)
    for k in range(x.size):
        near = (abs(x - x[k]) <= reach) & (abs(y - y[k]) <= reach)
        if abs(z[near] - z[k]).max() < LEVEL_M:
            slow[y[k] + side, x[k] + side] = max(slow[y[k] + side, x[k] + side], z[k])
    np.testing.assert_array_equal(level, slow)
    assert 100 < np.isfinite(slow).sum() < len({*zip(x, y, strict=True)}) - 100
    seen = np.zeros(level.shape, bool)
    seen[y + side, x + side] = True
    assert not holes[seen].any() and holes[~ndimage.binary_dilation(seen, np.ones((3, 3)))].all()


def test_the_background_matched_beside_a_post_proves_nothing() -> None:
    """A post at x = 40 hides a strip of the floor from an eye at +X; the background is matched over a half of
    the strip's width.
    """
    shape, eye = (61, 81), np.array([3.0, 0.30, 7.0])
    ends, holes = np.zeros(shape, np.float32), np.zeros(shape, np.uint8)
    ends[26:35, 10:41], holes[26:35, 10:41] = NO_END, 1
    ends[28:31, 10:41], holes[28:31, 10:41] = 0.0, 0
    bound = np.full(shape, np.inf, np.float32)
    sweep_rays(ends, holes, eye, CELL_M, bound)
    assert bound[30, 38] > 0.7
    assert bound[15, 38] < 0.15 and bound[30, 50] < 0.15


@pytest.mark.parametrize("cell_m", [0.005, 0.008, 0.01])
def test_the_background_matched_on_the_rim_of_a_block_proves_nothing_whatever_the_cells_are(
    cell_m: float,
) -> None:
    """A block of 0.6 m from x = 0.4 on; on its near rim, 20 mm wide, the floor is matched."""
    count = round(0.6 / cell_m)
    x, y = (axis.ravel().astype(np.int32) for axis in np.meshgrid(np.arange(count), np.arange(count)))
    none, free = np.zeros(x.size, np.float32), FreeSpace(cell_m)
    z_m = np.where(x >= round(0.42 / cell_m), np.float32(0.6), np.float32(0))
    for eye_x_m in (-3.0, -3.4):
        cells = CellObservations(x, y, none == 0, z_m, none, none, none)
        free.carve(cells, np.array([[eye_x_m, 0.3, 7.0]]))
    assert (free.window(0, 0, count, count)[:, round(0.4 / cell_m) :] >= 0.6).all()
