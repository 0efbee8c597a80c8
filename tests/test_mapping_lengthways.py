"""Heights along bars: against slow references, less noise, less blur, steps as they were."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from barsight.mapping.surface.bar_directions import choose_directions, elect_directions
from barsight.mapping.surface.directional_filter import (
    blur_sigma,
    deblur_across,
    smooth_along_bars,
    step_sigma,
    valley_mask,
)

CELL_M, GATE_M, REACH = 0.01, 0.015, 26
BLUR_CELLS = 0.7


def bars(turn_deg: float, diameter_m: float = 0.09, cells: int = 120) -> np.ndarray:
    """Bars side by side, turned from the y axis: (cells, cells) heights."""
    x, y = np.meshgrid(np.arange(cells) * CELL_M, np.arange(cells) * CELL_M)
    across = x * np.cos(np.radians(turn_deg)) + y * np.sin(np.radians(turn_deg))
    off = (across % diameter_m) - diameter_m / 2
    return np.sqrt((diameter_m / 2) ** 2 - off**2)


def squares_and_members(z: np.ndarray, i: int, j: int, turn: float, reach: int) -> tuple[float, list]:
    """Sum the squares along a direction, and list the cells within the gate."""
    squares, members = 0.0, []
    for n in range(-reach, reach + 1, 2):
        a, b = i + int(np.rint(n * np.sin(turn))), j + int(np.rint(n * np.cos(turn)))
        inside = 0 <= a < z.shape[0] and 0 <= b < z.shape[1]
        if inside and abs(z[a, b] - z[i, j]) <= GATE_M:
            members.append((a, b))
            squares += (z[a, b] - z[i, j]) ** 2
        else:
            squares += GATE_M**2
    return squares, members


def averaged_slowly(z: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Average along the directions that blocks of 8 cells elect with their neighbours."""
    known = list(zip(*np.nonzero(weight > 0), strict=True))
    step = np.pi / 80
    chosen = {
        cell: 5 * int(np.argmin([squares_and_members(z, *cell, d * np.pi / 16, 12)[0] for d in range(16)]))
        for cell in known
    }
    votes = np.zeros((*(-(-n // 8) for n in z.shape), 80))
    for i, j in known:
        if i % 2 == j % 2 == 0:
            ways = [(chosen[i, j] + turn) % 80 for turn in (0, -1, 1, -2, 2)]
            best = int(np.argmin([squares_and_members(z, i, j, way * step, 16)[0] for way in ways]))
            votes[i // 8, j // 8, ways[best]] += 1
    out = z.copy()
    for i, j in known:
        a, b = i // 8, j // 8
        around = votes[max(a - 1, 0) : a + 2, max(b - 1, 0) : b + 2].sum(axis=(0, 1))
        block, own = int(np.argmax(around)), chosen[i, j]
        apart = min(abs(block - own), 80 - abs(block - own))
        squares = [squares_and_members(z, i, j, way * step, 16)[0] for way in (block, own)]
        is_good = apart <= 2 or (apart <= 8 and squares[0] <= 2 * squares[1])
        way = block if around.any() and is_good else own
        cells = tuple(np.transpose(squares_and_members(z, i, j, way * step, REACH)[1]))
        out[i, j] = np.average(z[cells], weights=weight[cells])
    return out


def test_the_kernels_agree_with_the_slow_reference() -> None:
    rng = np.random.default_rng(3)
    z = (bars(7.0, cells=37) + rng.normal(0, 0.003, (37, 37))).astype(np.float32)
    weight = rng.uniform(1, 5, z.shape)
    weight[rng.random(z.shape) < 0.1] = 0
    z[weight == 0] = np.nan
    found, direction = smooth_along_bars(z, weight.astype(np.float32), GATE_M, REACH)
    assert np.array_equal(direction < 0, weight == 0)
    np.testing.assert_allclose(found, averaged_slowly(z, weight), atol=1e-6)


@pytest.mark.parametrize("turn_deg", [0.0, 1.0, 5.6, 20.0, 90.0])
def test_noise_falls_and_bars_keep_their_shape(turn_deg: float) -> None:
    """5.6 degrees lies in the middle between two of the directions that single cells choose."""
    truth = bars(turn_deg)
    rng = np.random.default_rng(1)
    noisy = (truth + rng.normal(0, 0.002, truth.shape)).astype(np.float32)
    error = smooth_along_bars(noisy, np.ones_like(noisy), GATE_M, REACH)[0] - truth
    inner = error[29:-29, 29:-29]
    crest = truth[29:-29, 29:-29] > 0.03
    assert np.std(inner[crest]) < 0.00095
    assert abs(np.mean(inner[crest])) < 0.0003


@pytest.mark.parametrize(("askew_deg", "most_m"), [(8, 0.0022), (15, 0.0026), (30, 0.001)])
def test_a_rod_that_lies_nearly_along_the_bars_stays_nearly_as_high(askew_deg: float, most_m: float) -> None:
    """It would hold a magnet's face off; with every cell in its block's direction it is 3.5 mm too low at 15
    degrees.
    """
    rng, (y, x) = np.random.default_rng(0), np.mgrid[:120, :120]
    turn = np.radians(90 - askew_deg)
    rod = np.abs((y - 60) * np.cos(turn) - (x - 60) * np.sin(turn)) < 1.5
    truth = np.where(rod, 0.018, 0.004 * np.cos(2 * np.pi * x / 6))
    noisy = (truth + rng.normal(0, 0.002, truth.shape)).astype(np.float32)
    error = (smooth_along_bars(noisy, np.ones_like(noisy), GATE_M, REACH)[0] - truth)[30:-30]
    assert abs(error[rod[30:-30]].mean()) < most_m


@pytest.mark.parametrize("turn_deg", [7.0, 62.0])
def test_blocks_elect_a_finer_direction_than_cells_choose(turn_deg: float) -> None:
    z = (bars(turn_deg) + np.random.default_rng(3).normal(0, 0.002, (120, 120))).astype(np.float32)
    z[:, :8] = np.nan
    chosen = choose_directions(z, np.isfinite(z), GATE_M, REACH)
    elected = elect_directions(z, chosen, GATE_M, REACH)
    assert (elected[:, :8] == -1).all() and (chosen[:, :8] == -1).all()
    inner = slice(30, -30), slice(30, -30)
    # Bars turned from the y axis run at 90 degrees and more from the rows.
    off = [
        np.abs((part[inner] * step - 90 - turn_deg + 90) % 180 - 90)
        for part, step in ((chosen, 180 / 16), (elected, 180 / 80))
    ]
    assert np.median(off[1]) < 1.2 < np.median(off[0])


def test_a_step_stays_a_step() -> None:
    z = np.zeros((40, 40), np.float32)
    z[:, 20:] = 0.05
    averaged, direction = smooth_along_bars(z, np.ones_like(z), GATE_M, REACH)
    np.testing.assert_allclose(deblur_across(averaged, direction, BLUR_CELLS + 0 * z), z, atol=1e-7)


def sharpened_slowly(z: np.ndarray, direction: np.ndarray, blur_cells: np.ndarray) -> np.ndarray:
    out = z.copy()
    for i in range(1, z.shape[0] - 1):
        for j in range(1, z.shape[1] - 1):
            if direction[i, j] >= 0:
                turn = np.pi / 2 + direction[i, j] * np.pi / 16
                di, dj = round(np.sin(turn)), round(np.cos(turn))
                beside = np.array([z[i - di, j - dj], z[i + di, j + dj]])
                if np.all(np.abs(beside - z[i, j]) <= 0.03):
                    share = min(blur_cells[i, j], 1.5) ** 2
                    out[i, j] += share * (z[i, j] - beside.mean()) / (di**2 + dj**2)
    return out


def test_sharpening_agrees_with_the_slow_reference() -> None:
    rng = np.random.default_rng(5)
    z = (bars(20.0, cells=40) + rng.normal(0, 0.01, (40, 40))).astype(np.float32)
    z[rng.random(z.shape) < 0.1] = np.nan
    direction = np.where(np.isfinite(z), rng.integers(0, 16, z.shape), -1).astype(np.int8)
    blur = rng.uniform(0, 2, z.shape).astype(np.float32)
    np.testing.assert_allclose(
        deblur_across(z, direction, blur), sharpened_slowly(z, direction, blur), atol=1e-6
    )


@pytest.mark.parametrize("turn_deg", [0.0, 30.0, 90.0])
@pytest.mark.parametrize("diameter_m", [0.04, 0.09])
def test_sharpening_undoes_part_of_a_windows_blur(turn_deg: float, diameter_m: float) -> None:
    truth = bars(turn_deg, diameter_m)
    blurred = gaussian_filter(truth, BLUR_CELLS).astype(np.float32)
    averaged, direction = smooth_along_bars(blurred, np.ones_like(blurred), GATE_M, REACH)
    inner = (slice(15, -15),) * 2
    sharp = deblur_across(averaged, direction, BLUR_CELLS + 0 * blurred)
    before, after = averaged - truth, sharp - truth
    left = 0.8 if turn_deg % 90 == 0 else 0.9
    assert np.std(after[inner]) < left * np.std(before[inner])
    assert abs(np.mean(after[inner])) < 0.0005
    sigma = blur_sigma(sharp - averaged, valley_mask(sharp, direction))
    assert np.mean((np.abs(after) <= 1.96 * sigma)[inner]) > 0.8


@pytest.mark.parametrize("step_m", [0.1, 0.4])
def test_sigma_beside_a_step_holds_what_matching_stretches(step_m: float) -> None:
    """A step that the map shows a pixel too far out, as a ramp; nothing is said further off."""
    pixel_cells, truth = 1.5, np.where(np.arange(60) < 30, step_m, 0.0) + np.zeros((60, 1))
    stretched = np.roll(truth, 1, axis=1)
    stretched[:, 0] = step_m
    shown = gaussian_filter(stretched, (0, 0.7)).astype(np.float32)
    sigma = np.hypot(0.003, step_sigma(shown, pixel_cells))
    assert (np.abs(shown - truth) <= 1.96 * sigma).mean() > 0.98
    off = np.abs(np.arange(60) - 30) > 8
    assert not step_sigma(shown, pixel_cells)[:, off].any()
    assert not step_sigma(np.full((9, 9), np.nan, np.float32), pixel_cells).any()


def valleys_slowly(z: np.ndarray, direction: np.ndarray) -> np.ndarray:
    out = np.zeros(z.shape, bool)
    for i, j in zip(*np.nonzero(direction >= 0), strict=True):
        turn = direction[i, j] * np.pi / 16
        sides = []
        for side in (-1, 1):
            way = [
                (i + side * round(n * np.cos(turn)), j - side * round(n * np.sin(turn))) for n in range(1, 7)
            ]
            off = [z[a, b] - z[i, j] if 0 <= a < z.shape[0] and 0 <= b < z.shape[1] else 1.0 for a, b in way]
            step = next((n for n, o in enumerate(off) if abs(o) > 0.03), 6)
            sides.append(any(o > 0 for o in off[:step]))
        out[i, j] = all(sides)
    return out


def test_valleys_agree_with_the_slow_reference() -> None:
    rng = np.random.default_rng(9)
    z = (bars(20.0, cells=40) + rng.normal(0, 0.005, (40, 40))).astype(np.float32)
    z[rng.random(z.shape) < 0.1] = np.nan
    direction = np.where(np.isfinite(z), rng.integers(0, 16, z.shape), -1).astype(np.int8)
    np.testing.assert_array_equal(valley_mask(z, direction), valleys_slowly(z, direction))


@pytest.mark.parametrize("diameter_m", [0.04, 0.06])
def test_valleys_lie_between_crests(diameter_m: float) -> None:
    """Bars along one of the 16 directions: all but crests lie lower than something on either side of them; a
    plane doesn't."""
    z = bars(0.0, diameter_m).astype(np.float32)
    direction = np.full(z.shape, 8, np.int8)
    depth = z.max() - z
    found = valley_mask(z, direction)[:, 15:-15]
    assert not found[depth[:, 15:-15] < 1e-6].any()
    assert found[(depth[:, 15:-15] > 0.004) & (depth[:, 15:-15] < 0.02)].all()
    slope = np.broadcast_to(np.arange(40, dtype=np.float32) * 0.005, (40, 40))
    assert not valley_mask(slope, np.full((40, 40), 8, np.int8)).any()


def test_what_blur_leaves_is_twice_the_rms_moved_and_more_in_valleys() -> None:
    """Against a plain loop; cells that couldn't be moved don't count, and far from bars nothing is left."""
    rng = np.random.default_rng(7)
    moved = rng.normal(0, 0.002, (40, 60)).astype(np.float32)
    moved[:, 40:] = 0
    moved[rng.random(moved.shape) < 0.2] = np.nan
    valley = rng.random(moved.shape) < 0.5
    found = blur_sigma(moved, valley)
    for i, j in ((20, 20), (20, 21), (6, 30), (30, 41), (20, 50)):
        near = moved[i - 5 : i + 6, j - 5 : j + 6]
        near = near[np.isfinite(near) & (near != 0)]
        expected = (4.5 if valley[i, j] else 2) * np.sqrt(np.mean(near**2)) if near.size else 0.0
        assert found[i, j] == pytest.approx(expected, rel=1e-4, abs=1e-9)
