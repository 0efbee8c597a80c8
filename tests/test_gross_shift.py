"""A pass whose encoders lost their reference is found shifted; a changed or different yard isn't."""

import cv2
import numpy as np
import pytest

from barsight.registration.block_shifts import MatchedMap, block_shifts
from barsight.registration.gross_shift import CoarsePair, find_gross_shift

CELL_M = 0.02
ROWS, COLUMNS = 200, 400


def scene(seed: int, bundle_y_m: float = 1.0, rise_m: float = 0.25) -> tuple[np.ndarray, np.ndarray]:
    """Heights and gray levels of 8 x 4 m with a margin of 2 m: floor, spots, and bundles along Y."""
    rng = np.random.default_rng(seed)
    shape = ROWS + 200, COLUMNS + 200
    gray = 100 + 10 * cv2.GaussianBlur(rng.normal(0, 5, shape), (0, 0), 3)
    z = np.zeros(shape)
    for k in range(6):
        left = 110 + 60 * k + int(rng.integers(0, 20))
        first = 100 + round(bundle_y_m / CELL_M) if k == 2 else 90 + int(rng.integers(0, 60))
        bars = 0.01 * np.cos(np.arange(20) * np.pi / 2.5) * (rise_m > 0)
        z[first : first + 140, left : left + 20] = rise_m + bars
        gray[first : first + 140, left : left + 20] = 150 + cv2.GaussianBlur(
            rng.normal(0, 90, (140, 20)), (0, 0), 2
        )
    return z, gray


def seen(
    found: tuple[np.ndarray, np.ndarray], rng: np.random.Generator, off_m: tuple[float, ...] = (0, 0, 0)
) -> MatchedMap:
    """The middle of a scene as a pass sees it that is off by so much."""
    column, row = (100 - round(one / CELL_M) for one in off_m[:2])
    z, gray = (one[row : row + ROWS, column : column + COLUMNS] for one in found)
    z = z + off_m[2] + cv2.GaussianBlur(rng.normal(0, 0.01, z.shape), (0, 0), 1.5)
    z[rng.random(z.shape) < 0.01] = np.nan
    light = 0.7 + 0.0005 * np.arange(COLUMNS)
    return MatchedMap(
        z.astype(np.float32), np.full(z.shape, 0.004, np.float32),
        (light * gray + rng.normal(0, 3, z.shape)).astype(np.float32),
    )  # fmt: skip


@pytest.mark.parametrize("off_m", [(0.5, 0.0, 0.0), (-1.2, 0.3, 0.0), (0.0, 0.0, -0.2), (0.1, -0.4, 0.15)])
def test_a_pass_that_lies_grossly_off_is_found_and_matched_there(off_m: tuple[float, ...]) -> None:
    rng = np.random.default_rng(0)
    pair = seen(scene(1), rng), seen(scene(1), rng, off_m)
    begin_m = find_gross_shift([CoarsePair.of(*pair, CELL_M)], CELL_M)
    assert np.abs(begin_m + off_m).max() <= 0.03
    found = block_shifts(*pair, (0.0, 0.0), CELL_M, begin_m)
    assert len(found.place_m) >= 8 and np.abs(np.median(found.shift_m, axis=0) + off_m).max() < 0.003


@pytest.mark.parametrize(
    "later",
    [scene(1), scene(1, bundle_y_m=0.4), scene(1, rise_m=0.0), scene(2)],
    ids=["the same", "a bundle moved along itself", "all taken", "another yard"],
)
def test_what_changed_is_no_shift(later: tuple[np.ndarray, np.ndarray]) -> None:
    rng = np.random.default_rng(0)
    pair = CoarsePair.of(seen(scene(1), rng), seen(later, rng), CELL_M)
    assert not find_gross_shift([pair], CELL_M).any()


def test_a_layer_laid_on_most_of_a_yard_is_no_shift_in_height() -> None:
    """It lies as the one below does, with straps at the same places; beside it the floor stays."""
    rng = np.random.default_rng(0)
    bars = np.tile(np.cos(np.arange(COLUMNS) * np.pi / 2.5), (ROWS, 1))
    bars[:, ::16] = -2
    maps = []
    for rise_m in (0.0, 0.25):
        z, gray = 0.25 + rise_m + 0.02 * bars, 130 + 40 * bars + rng.normal(0, 10, bars.shape)
        gray[[40, 41, 150, 151]] = 30
        z[:15], z[-15:], gray[:15], gray[-15:] = 0, 0, 60, 60
        z = z + cv2.GaussianBlur(rng.normal(0, 0.01, z.shape), (0, 0), 1.5)
        maps.append(MatchedMap(*(one.astype(np.float32) for one in (z, np.full_like(z, 0.004), gray))))
    assert not find_gross_shift([CoarsePair.of(*maps, CELL_M)], CELL_M).any()


def test_nothing_in_common_is_no_shift() -> None:
    empty = np.full((ROWS, COLUMNS), np.nan, np.float32)
    nothing = MatchedMap(empty, empty, empty)
    assert not find_gross_shift([CoarsePair.of(nothing, nothing, CELL_M)], CELL_M).any()
    assert not find_gross_shift([], CELL_M).any()


def test_a_lone_bundle_that_was_moved_is_no_shift_of_a_pass() -> None:
    """The floor around it tells nothing."""
    maps = []
    rng = np.random.default_rng(3)
    looks = cv2.GaussianBlur(rng.normal(0, 90, (120, 20)), (0, 0), 2)
    for first in (30, 55):
        gray, z = rng.normal(100, 2, (ROWS, COLUMNS)), rng.normal(0, 0.004, (ROWS, COLUMNS))
        gray[first : first + 120, 200:220] += looks
        z[first : first + 120, 200:220] += 0.2
        maps.append(MatchedMap(*(one.astype(np.float32) for one in (z, np.full_like(z, 0.004), gray))))
    assert not find_gross_shift([CoarsePair.of(maps[0], maps[1], CELL_M)], CELL_M).any()
