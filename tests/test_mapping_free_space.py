"""Free space: bounds are never below what stands, and lines of sight prove an unseen gully free."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from barsight.mapping.free_space import (
    COARSE_CELLS,
    LEVEL_CELLS,
    LEVEL_M,
    OVER_END_M,
    REACH_M,
    FreeSpace,
    _level,
    bound_heights,
    carve_rays,
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


def test_the_kernel_agrees_with_a_slow_reference() -> None:
    rng = np.random.default_rng(2)
    x, y = rng.integers(20, 60, (2, 50)).astype(np.int32)
    z = rng.uniform(0, 1, 50).astype(np.float32)
    eye, cell_m = np.array([0.3, 1.4, 6.0]), CELL_M * COARSE_CELLS
    bound = np.full((80, 80), np.inf, np.float32)
    carve_rays(x, y, z, eye, cell_m, bound)
    slow = np.full((80, 80), np.inf)
    for k in range(50):
        start = np.array([x[k] * cell_m, y[k] * cell_m])
        run = (eye[:2] - start) / (eye[2] - z[k])
        step = cell_m / np.hypot(*run)
        for i in range(1, int(REACH_M / step)):
            column, row = np.floor((start + run * i * step) / cell_m + 0.5).astype(int)
            if not (0 <= row < 80 and 0 <= column < 80):
                break
            slow[row, column] = min(slow[row, column], z[k] + (i + 1) * step + OVER_END_M)
    np.testing.assert_allclose(bound, slow, rtol=1e-6)
    assert np.isfinite(slow).sum() > 300


@pytest.mark.parametrize("corner", [(-300, -300), (250, 130)])
def test_tiles_join_without_a_seam(corner: tuple[int, int]) -> None:
    cells = seen_from(0.0)
    whole, moved = FreeSpace(CELL_M), FreeSpace(CELL_M)
    even = (corner[0] // 2 * 2, corner[1] // 2 * 2)
    shifted = CellObservations(
        cells.x + np.int32(even[0]), cells.y + np.int32(even[1]), cells.central, cells.z_m, cells.variance_m2,
        cells.shared_m, cells.intensity,
    )  # fmt: skip
    for _ in range(2):
        whole.carve(cells, np.array([[0.0, 0.2, 7.0]]))
        moved.carve(shifted, np.array([[CELL_M * even[0], 0.2 + CELL_M * even[1], 7.0]]))
    here = whole.window(int(X[0]), 0, X.size, 40)
    there = moved.window(int(X[0]) + even[0], even[1], X.size, 40)
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


def test_one_height_in_four_is_level_as_a_slow_reference_has_it() -> None:
    rng, side = np.random.default_rng(6), 30
    x, y = rng.integers(-side, side, (2, 900)).astype(np.int32)
    z = (0.2 * (x // 6 % 2) + rng.uniform(0, 0.04, x.size)).astype(np.float32)
    none = np.zeros(x.size, np.float32)
    level_x, level_y, level_z = _level(CellObservations(x, y, none > 0, z, none, none, none))
    slow = []
    for k in range(x.size):
        near = (abs(x - x[k]) <= LEVEL_CELLS // 2) & (abs(y - y[k]) <= LEVEL_CELLS // 2)
        if x[k] % COARSE_CELLS == y[k] % COARSE_CELLS == 0 and abs(z[near] - z[k]).max() < LEVEL_M:
            slow.append((x[k] // COARSE_CELLS, y[k] // COARSE_CELLS, z[k]))
    assert slow == list(zip(level_x, level_y, level_z, strict=True))
    even = (x % COARSE_CELLS == 0) & (y % COARSE_CELLS == 0)
    assert 20 < len(slow) < even.sum() - 20
