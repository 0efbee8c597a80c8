"""Looking up the map at places of the yard, beside plain references."""

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from barsight.yard.map_lookup import (
    CellGrid,
    are_blocked,
    cell_spans,
    highest_seen,
    is_blocked,
    lookup_heights,
    sample_levels,
)
from test_yard_resting_plane import some_map, was_seen


def test_heights_are_looked_up_in_the_nearest_seen_cell() -> None:
    heights = some_map()
    rng = np.random.default_rng(3)
    x, y = rng.uniform(-0.4, 0.4, 500), rng.uniform(-0.9, 0.9, 500)
    column, row = (np.floor((a - a0) / 0.01 + 0.5).astype(int) for a, a0 in ((x, -0.3), (y, -0.75)))
    inside = (column >= 0) & (row >= 0) & (column < 60) & (row < 150)
    column, row = np.where(inside, column, 0), np.where(inside, row, 0)
    seen = inside & was_seen(heights)[row, column]
    np.testing.assert_array_equal(
        lookup_heights(heights, x, y), np.where(seen, heights.z_m[row, column].astype(float), np.nan)
    )
    assert 0.2 < seen.mean() < 0.8


def test_levels_are_interpolated_between_four_seen_cells() -> None:
    """As SciPy does it, to OpenCV's 1/32 of a cell; unknown beside what wasn't seen and off the map."""
    heights = some_map()
    rng = np.random.default_rng(4)
    levels = rng.integers(1, 256, heights.shape).astype(np.uint8)
    levels[rng.random(heights.shape) < 0.05] = 0
    x, y = rng.uniform(-0.4, 0.4, (20, 25)), rng.uniform(-0.9, 0.9, (20, 25))
    column, row = (x - heights.x0_m) / heights.cell_m, (y - heights.y0_m) / heights.cell_m
    plain = map_coordinates(
        np.where(levels > 0, levels, np.nan).astype(float), (row, column), order=1, cval=np.nan
    )
    found = sample_levels(heights, levels, x, y)
    within = np.minimum(abs(column - np.rint(column)), abs(row - np.rint(row))) > 1 / 32
    np.testing.assert_array_equal(np.isfinite(found[within]), np.isfinite(plain[within]))
    np.testing.assert_allclose(found[within], plain[within], atol=255 / 32)
    assert np.isnan(sample_levels(heights, levels, x + 5, y)).all()
    assert 0.2 < np.isfinite(found).mean() < 0.8


@pytest.mark.parametrize("cell_m", [0.003, 0.005, 0.008, 0.01, 0.015, 0.02])
def test_steps_of_10_mm_leave_out_no_cell(cell_m: float) -> None:
    places = 1e4 - 0.3 + 0.01 * np.arange(60)
    spans = cell_spans(places, 1e4 - 0.5, cell_m, 0.01)
    assert (spans[:, 0] <= spans[:, 1]).all() and (spans[:, 1] < spans[:, 2]).all()
    assert (abs(1e4 - 0.5 + cell_m * spans[:, 1] - places) <= cell_m / 2 + 1e-6).all()
    assert (spans[1:, 0] <= spans[:-1, 2]).all()
    if cell_m <= 0.005:
        np.testing.assert_array_equal(spans[1:, 0], spans[:-1, 2])


def test_the_highest_seen_cell_of_a_span_counts() -> None:
    heights = some_map()
    z = np.where(was_seen(heights), heights.z_m, -np.inf)
    for low, top, left, right in ((-2, 3, 4, 9), (10, 12, 57, 70), (20, 21, 30, 31), (200, 210, 0, 5)):
        highest = z[max(low, 0) : top, left:right].max(initial=-np.inf)
        found = highest_seen(heights.z_m, heights.source, low, top, left, right)
        assert found == highest or (np.isnan(found) and highest == -np.inf)


def plainly_blocked(grid: CellGrid, place: np.ndarray, eye: np.ndarray, over_m: float) -> bool:
    """Look up all places of a line of sight at once."""
    steps = max(int(np.ceil(np.hypot(*(eye - place)[:2]) / grid.cell_m)), 1)
    line = place + np.arange(steps)[:, None] / steps * (eye - place)
    column, row = (
        np.floor((line[:, k] - first) / grid.cell_m + 0.5).astype(int)
        for k, first in enumerate((grid.x0_m, grid.y0_m))
    )
    rows, columns = grid.z_m.shape
    inside = (row >= 0) & (column >= 0) & (row < rows) & (column < columns)
    return bool((grid.z_m[row[inside], column[inside]] > line[inside, 2] + over_m).any())


@pytest.mark.parametrize("over_m", [0.0, 0.02])
def test_a_line_of_sight_is_blocked_by_what_rises_over_it(over_m: float) -> None:
    """From places in and beside the map, to eyes above, beside and straight over it."""
    grid = CellGrid.of(some_map())
    rng = np.random.default_rng(5)
    places = rng.uniform((-0.4, -0.9, np.nanmin(grid.z_m)), (0.4, 0.9, grid.highest_m), (400, 3))
    for eye in (np.array([1.5, -0.7, 0.6]), np.array([0.0, 0.0, 8.0]), places[7] + (0.0, 0.0, 5.0)):
        found = are_blocked(grid, places, eye, over_m)
        assert found.tolist() == [plainly_blocked(grid, place, eye, over_m) for place in places]
        assert 0.05 < found.mean() < 0.95
    assert is_blocked(grid, tuple(places[0]), eye, over_m) == plainly_blocked(grid, places[0], eye, over_m)
    nothing = grid._replace(z_m=np.full_like(grid.z_m, np.nan), highest_m=-np.inf)
    assert not are_blocked(nothing, places, eye, over_m).any()
