"""Lines of sight and the election's kernels against slow ones written plainly."""

from __future__ import annotations

import numpy as np
import pytest

from barsight.core.pose import Pose
from barsight.core.records.pairs import RectifiedCamera
from barsight.mapping.surface.block_visibility import (
    BLOCK,
    SOMEWHERE,
    clear_height,
    highest_about,
    supported_span,
)
from barsight.mapping.surface.height_selection import (
    _ALIKE_CELLS,
    _ALONG,
    _BORDER_PX,
    ViewFrusta,
    _elected,
    _support,
)
from barsight.mapping.surface.visibility import (
    _CUT_CELLS,
    _CUT_MARGIN_CELLS,
    _OVERHANG_CELLS,
    has_enough_views,
    is_pictured,
    is_unoccluded,
    may_be_occluded,
    point_density,
)
from barsight.mapping.tiles import CENTRAL, FIELDS, SLOTS, TILE_CELLS, VIEWS, Z

CELL_M = 0.02
CAMERA = RectifiedCamera(
    focal_px=600.0, cx_px=320.0, cy_px=240.0, baseline_m=0.4, doffs_px=3.0, width=640, height=480
)
EYES_M = np.array([[x, y, 6.0] for x in (1.0, 2.6, 4.2) for y in (2.0, 3.5)])
SIDE = 3 * TILE_CELLS


def frusta() -> ViewFrusta:
    down = np.diag([1.0, -1.0, -1.0])
    return ViewFrusta.of([Pose("yard", "rect0", down, eye) for eye in EYES_M], CAMERA)


def holders(point: np.ndarray) -> np.ndarray:
    """List the views that have the point in both pictures, the border left off."""
    held = []
    for eye in EYES_M:
        x, y, z = point[0] - eye[0], eye[1] - point[1], eye[2] - point[2]
        left, row = 600 * x / z + 320, 600 * y / z + 240
        right = left - 600 * 0.4 / z + 3
        inside = [_BORDER_PX <= u <= 639 - _BORDER_PX for u in (left, right)]
        held.append(all(inside) and _BORDER_PX <= row <= 479 - _BORDER_PX)
    return np.array(held)


@pytest.fixture(scope="module")
def hills() -> np.ndarray:
    """Heights of nine tiles: the floor and boxes of up to 2 m."""
    rng = np.random.default_rng(6)
    around = np.zeros((SIDE, SIDE), np.float32)
    for _ in range(250):
        i, j = rng.integers(0, SIDE - 40, 2)
        around[i : i + rng.integers(4, 40), j : j + rng.integers(4, 40)] = rng.uniform(0.1, 2)
    around[:40, :40] = -1e6
    return around


def free_slowly(point: np.ndarray, row: int, column: int, eye: np.ndarray, around: np.ndarray) -> bool:
    """Cell by cell along the line, to the tiles' end; a line above the ceiling stays there."""
    way = eye - point
    length = np.abs(way[:2]).max() / CELL_M
    for n in range(2, int(length)):
        x, y, z = way / (CELL_M, CELL_M, 1) * n / length
        i, j = int(np.rint(row + TILE_CELLS + y)), int(np.rint(column + TILE_CELLS + x))
        if not (0 <= i < SIDE and 0 <= j < SIDE):
            return True
        if around[i, j] > point[2] + z + CELL_M:
            return False
    return True


def test_a_line_of_sight_is_free_where_no_cell_rises_over_it(hills: np.ndarray) -> None:
    rng = np.random.default_rng(0)
    roof, ceiling, found = highest_about(hills), float(hills.max()), []
    for k in range(600):
        row, column = (int(n) for n in rng.integers(0, TILE_CELLS, 2))
        z = hills[row + TILE_CELLS, column + TILE_CELLS] if k % 3 else rng.uniform(-0.5, 2.5)
        point = np.array([column * CELL_M, row * CELL_M, z])
        eye = point + np.array([0, 0, 5]) if k == 0 else EYES_M[k % 6] - (0, 0, 4 * (k % 2))
        way = tuple(float(part) for part in eye - point)
        found.append(is_unoccluded(float(z), row, column, way, hills, roof, ceiling, CELL_M))
        assert found[-1] == free_slowly(point, row, column, eye, hills)
    assert 0.2 < np.mean(found) < 0.9


def test_a_point_is_held_where_both_pictures_hold_it() -> None:
    rng, planes = np.random.default_rng(1), frusta().planes()
    held = []
    for point in rng.uniform((-1, -1, 0), (6, 6, 4), (300, 3)):
        held.append(holders(point))
        pictured = [is_pictured(*point, planes, view) for view in range(len(EYES_M))]
        np.testing.assert_array_equal(pictured, held[-1])
        for least in range(1, 4):
            assert has_enough_views(*point, planes, least) == (held[-1].sum() >= least)
    assert 0.1 < np.mean(held) < 0.9


def test_points_a_cell_fall_with_range_and_slant() -> None:
    eye, one_point_m = np.array([0.3, -0.2, 8.0]), 2.0
    for x, y, z in np.random.default_rng(2).uniform(-6, 6, (50, 3)):
        point = np.array([x, y, z])
        way = eye - point
        away = np.linalg.norm(way)
        wanted = min((one_point_m / away) ** 2 * way[2] / away, 1.0)
        assert point_density(tuple(way), one_point_m) == pytest.approx(wanted)


def cut_slowly(
    point: np.ndarray | tuple[float, ...], row: int, column: int, around: np.ndarray, least: int
) -> bool:
    def too_few(x: float, y: float, z: float) -> bool:
        return bool(holders(np.array([x, y, z])).sum() < least)

    if not too_few(point[0], point[1], float(around.max())):
        return False
    for di, dj in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        steps = np.arange(1, _CUT_CELLS + 1)
        line = around[row + TILE_CELLS + di * steps, column + TILE_CELLS + dj * steps].astype(float)
        high = np.flatnonzero(line > point[2] + _OVERHANG_CELLS * CELL_M)
        if high.size:
            out = max(int(steps[high[0]]) - _CUT_MARGIN_CELLS, 0) * CELL_M
            if too_few(point[0] + dj * out, point[1] + di * out, float(line[high[0]])):
                return True
    return False


def test_beneath_a_surface_that_the_pictures_cut_off_all_is_doubted(hills: np.ndarray) -> None:
    rng, planes = np.random.default_rng(3), frusta().planes()
    found = []
    for _ in range(400):
        row, column = (int(n) for n in rng.integers(0, TILE_CELLS, 2))
        point = column * CELL_M, row * CELL_M, rng.uniform(0, 1)
        found.append(may_be_occluded(point, row, column, hills, float(hills.max()), planes, CELL_M, 2.0))
        assert found[-1] == cut_slowly(point, row, column, hills, 2)
    assert 0.1 < np.mean(found) < 0.9


def test_support_is_the_votes_over_those_that_can_be_expected(hills: np.ndarray) -> None:
    rng, views = np.random.default_rng(4), frusta()
    tile = np.zeros((4, 24, SLOTS, FIELDS), np.float32)
    tile[..., VIEWS], tile[..., CENTRAL] = rng.integers(0, 7, (2, *tile.shape[:3]))
    tile[..., Z] = rng.uniform(0, 2, tile.shape[:3])
    corner, ceiling = np.array([20.0, 40.0]), float(hills.max())
    parts, scene = (1, 24 // BLOCK, len(views.eyes)), (hills, highest_about(hills), ceiling)
    nothing_told = (
        np.full(parts, SOMEWHERE, np.int8), np.zeros(parts, bool), np.full((*parts, 2), np.inf),
        np.zeros(parts[:2], bool),
    )  # fmt: skip
    asked = 0, np.full((*tile.shape[:3], 3), np.nan, np.float32)
    share, expected = np.full((2, *tile.shape[:3]), -1, np.float32)
    _support(
        tile, corner, scene, views.planes(), views.eyes, nothing_told, CELL_M, 2.0, 4.0,
        (*asked, share, expected),
    )  # fmt: skip
    cut = 0
    for i, j, s in np.ndindex(share.shape):
        point = np.array([(corner[0] + j) * CELL_M, (corner[1] + i) * CELL_M, tile[i, j, s, Z]])
        able = [
            k for k in np.flatnonzero(holders(point))
            if all(free_slowly(point, i, j, eye, hills) for eye in views.eyes[k])
        ]  # fmt: skip
        covered = len(able) >= 2 and cut_slowly(point, i, j, hills, 2)
        cut += covered and tile[i, j, s, VIEWS] >= 2
        if tile[i, j, s, VIEWS] < 2 or len(able) < 2 or covered:
            assert share[i, j, s] == -1 and expected[i, j, s] == -1
            continue
        votes = sum(point_density(tuple(views.eyes[k, 0] - point), 4.0) for k in able)
        assert expected[i, j, s] == pytest.approx(votes, rel=1e-6)
        assert share[i, j, s] == pytest.approx(min(tile[i, j, s, CENTRAL] / votes, 1), rel=1e-6)
    assert 0.2 < (share >= 0).mean() < 0.8 and cut > 10


def along_slowly(z: np.ndarray, share: np.ndarray, i: int, j: int, s: int) -> float:
    most, mean = -1, 0.0
    for di, dj in ((0, 1), (1, 0), (1, 1), (1, -1)):
        cells = [(i + n * di, j + n * dj) for n in range(-_ALONG, _ALONG + 1, 3)]
        cells = [(a, b) for a, b in cells if 0 <= a < z.shape[0] and 0 <= b < z.shape[1]]
        found = []
        for a, b in cells:
            alike = (share[a, b] >= 0) & (np.abs(z[a, b] - z[i, j, s]) <= _ALIKE_CELLS * CELL_M)
            if alike.any():
                found.append(share[a, b, alike.argmax()])
        if len(found) > most:
            most, mean = len(found), sum(found) / len(cells)
    return float(mean)


def test_the_highest_height_with_support_of_its_own_or_along_a_bar_is_elected() -> None:
    rng, shape = np.random.default_rng(5), (9, 14, SLOTS)
    tile = np.zeros((*shape, FIELDS), np.float32)
    tile[..., Z] = rng.choice([0.0, 0.5, 1.0], shape) + rng.normal(0, 0.03, shape)
    tile[:, 7, 0, Z] = 2.0
    share = rng.uniform(0, 1, shape).astype(np.float32)
    share[rng.random(shape) < 0.4] = -1
    share[:, 7, 0] = 0.5
    expected = rng.uniform(1, 5, shape).astype(np.float32)
    winner = _elected(tile, share, expected, CELL_M, 2.0, 0.8, 0.4)
    for i, j in np.ndindex(shape[:2]):
        enough = [
            s for s in range(SLOTS)
            if share[i, j, s] >= 0
            and (
                share[i, j, s] >= (0.4 if expected[i, j, s] < 2 else 0.8)
                or along_slowly(tile[..., Z], share, i, j, s) >= 0.4
            )
        ]  # fmt: skip
        assert winner[i, j] == max(enough, key=lambda s: tile[i, j, s, Z], default=-1)
    assert (winner[:, 7] == 0).all() and (winner == -1).any() and len(np.unique(winner)) == SLOTS + 1


def test_over_the_clear_height_all_cells_of_a_block_see_the_eye(hills: np.ndarray) -> None:
    rng, known = np.random.default_rng(9), []
    roof, ceiling, half = highest_about(hills), float(hills.max()), (BLOCK - 1) / 2
    for k in range(300):
        row, column = (BLOCK * int(n) for n in rng.integers(0, TILE_CELLS // BLOCK, 2))
        low = rng.uniform(0, 2.2)
        high = low + rng.uniform(0, 0.5)
        middle = np.array([(column + half) * CELL_M, (row + half) * CELL_M, (low + high) / 2])
        eye = EYES_M[k % 6]
        way = tuple(float(part) for part in eye - middle)
        clear = clear_height((low, high), (row + half, column + half), way, roof, ceiling, CELL_M)
        known.append(clear <= high)
        for i, j in np.ndindex(BLOCK, BLOCK):
            for z in (max(low, clear), high) if known[-1] else ():
                point = np.array([(column + j) * CELL_M, (row + i) * CELL_M, z])
                ray = tuple(float(part) for part in eye - point)
                assert is_unoccluded(z, row + i, column + j, ray, hills, roof, ceiling, CELL_M)
    assert 0.2 < np.mean(known) < 0.9


def test_the_span_of_heights_is_that_of_the_supported_ones() -> None:
    rng = np.random.default_rng(10)
    heights = rng.uniform(-1, 2, (5, 7, SLOTS, FIELDS)).astype(np.float32)
    heights[..., VIEWS] = rng.integers(0, 6, (5, 7, SLOTS))
    for least in (2, 5):
        z = heights[..., Z][heights[..., VIEWS] >= least]
        assert supported_span(heights, least) == (z.min(), z.max())
    assert supported_span(heights, 6) == (np.inf, -np.inf)
