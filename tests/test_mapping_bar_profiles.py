"""Thin bars from the picture's stripes: drawn where they are, unsure where they can't be."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from barsight.mapping.surface import picture_stripes
from barsight.mapping.surface.bar_profiles import draw_bars
from barsight.mapping.surface.directional_filter import smooth_along_bars, vote_directions
from barsight.mapping.surface.picture_stripes import find_stripes

CELL_M, PIXEL_CELLS, CELLS = 0.01, 0.61, 100
INNER = slice(15, -15)


def row_of_bars(pitch_m: float, slope: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Bars along y that touch in a row of this slope, seen from above: (CELLS, CELLS) heights, the same as
    blurred matching shows them, and gray levels that fall towards the borders between bars.
    """
    x = (np.arange(CELLS * 20) - CELLS * 10) * CELL_M / 20
    number = np.arange(-30, 31)[:, None]
    off, radius_m = x - number * pitch_m, pitch_m * np.hypot(1, slope) / 2
    inside = np.abs(off) < radius_m * 1.001
    tops = np.where(inside, slope * number * pitch_m + np.sqrt(np.maximum(radius_m**2 - off**2, 0)), -np.inf)
    z, owner = tops.max(axis=0), tops.argmax(axis=0)
    shown = gaussian_filter1d(z, 1.5 * PIXEL_CELLS * 20, mode="nearest")
    borders = x[1:][np.diff(owner) != 0]
    gray = 100 - 60 * np.exp(-0.5 * (np.abs(x[:, None] - borders).min(axis=1) / 0.006) ** 2)
    truth, blurred, levels = (np.tile(a[::20].astype(np.float32), (CELLS, 1)) for a in (z, shown, gray))
    return truth, blurred, levels


def drawn(
    shown: np.ndarray, gray: np.ndarray, pixel_cells: float = PIXEL_CELLS
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    z, direction = smooth_along_bars(shown, np.ones_like(shown), 0.015, 12)
    direction = vote_directions(direction)
    stripes = find_stripes(z, gray, direction, CELL_M)
    return draw_bars(z, direction, stripes, np.full(z.shape, pixel_cells, np.float32), CELL_M)


@pytest.mark.parametrize(
    ("pitch_m", "slope"), [(0.042, 0.0), (0.03464, 0.577), (0.03464, -0.577), (0.05, 0.1)]
)
def test_bars_are_drawn_round_and_their_sigma_holds(pitch_m: float, slope: float) -> None:
    truth, shown, gray = row_of_bars(pitch_m, slope)
    rng = np.random.default_rng(5)
    noisy = (shown + rng.normal(0, 0.002, shown.shape)).astype(np.float32)
    z, sigma, hidden = (
        a[INNER, INNER] for a in drawn(noisy, gray + rng.normal(0, 3, gray.shape).astype(np.float32))
    )
    known, truth = np.isfinite(z), truth[INNER, INNER]
    error, before = np.abs(z - truth)[known], np.abs(shown[INNER, INNER] - truth)[known]
    assert known.mean() > 0.9
    assert np.median(error) < 0.0012
    assert np.mean(error) < 0.5 * np.mean(before)
    assert (z - truth)[known].mean() == pytest.approx(0, abs=0.0008)
    assert np.mean(error <= 1.96 * np.hypot(sigma[known], 0.001)) > 0.9
    # What isn't drawn says how far it is off.
    assert np.mean(before <= 1.96 * np.hypot(hidden[known], 0.002)) > 0.88


def test_a_plate_without_stripes_stays_as_it_is() -> None:
    rng = np.random.default_rng(2)
    plate = rng.normal(0, 0.002, (CELLS, CELLS)).astype(np.float32)
    z, _, hidden = drawn(plate, np.float32(90) + rng.normal(0, 3, plate.shape).astype(np.float32))
    assert np.isnan(z).all()
    assert not hidden.any()


def test_stripes_on_a_plate_are_no_bars_where_the_heights_would_show_them() -> None:
    """With small pixels the heights show bars of 40 mm: stripes without them are paint."""
    _, _, gray = row_of_bars(0.04, 0.0)
    z, *_ = drawn(np.zeros_like(gray), gray, pixel_cells=0.41)
    assert np.isnan(z[INNER, INNER]).all()


def test_bars_in_no_row_are_unsure() -> None:
    """Every second bar lies 14 mm deeper: none is drawn, and sigma says what the heights may hide."""
    _, shown, gray = row_of_bars(0.04, 0.0)
    x = np.arange(CELLS) * CELL_M
    uneven = shown + (0.007 * np.sin(2 * np.pi * x / 0.08)).astype(np.float32)
    z, _, unsure = drawn(uneven.astype(np.float32), gray)
    crests = np.zeros(CELLS, bool)
    crests[10:90:4] = True
    hidden = unsure[INNER][:, crests & (x > 0.15) & (x < 0.85)]
    assert np.isnan(z[INNER][:, crests & (x > 0.15) & (x < 0.85)]).all()
    assert (hidden > 0.112 * 0.03 * 0.6).all()


def test_a_wave_is_found_as_by_plain_least_squares() -> None:
    rng = np.random.default_rng(9)
    x = np.arange(-6, 7.0)
    weight = rng.uniform(0.3, 1, x.size)
    level = np.cos(2 * np.pi * (x - 0.7) / 4.1) * 20 + rng.normal(0, 1, x.size)
    level -= np.average(level, weights=weight)
    pitches = picture_stripes._PITCHES
    phase = 2 * np.pi * x[:, None] / pitches
    sums = np.empty((7, pitches.size), np.float32)
    level32, weight32, cosine, sine = (
        a.astype(np.float32) for a in (level, weight, np.cos(phase), np.sin(phase))
    )
    picture_stripes._sum_waves(level32, weight32, cosine, sine, sums)
    power = np.float32((weight * level**2).sum())
    figures = np.float32(weight.sum()), np.float32(100), power
    pitch, crest = picture_stripes._best_wave(sums, *figures, pitches)
    explained, places = [], []
    for p in pitches:
        design = np.column_stack([np.ones_like(x), np.cos(2 * np.pi * x / p), np.sin(2 * np.pi * x / p)])
        root = np.sqrt(weight)[:, None]
        fit = np.linalg.lstsq(design * root, level * root[:, 0], rcond=None)[0]
        rest = level - design @ fit
        explained.append(1 - (weight * rest**2).sum() / power)
        places.append(np.arctan2(fit[2], fit[1]) / (2 * np.pi) * p)
    best = int(np.argmax(explained))
    assert pitch == pytest.approx(pitches[best])
    assert crest == pytest.approx(places[best], abs=1e-3)


def test_directions_are_voted() -> None:
    rng = np.random.default_rng(4)
    direction = rng.integers(0, 16, (60, 60)).astype(np.int8)
    direction[:, :30][rng.random((60, 30)) < 0.4] = 3
    direction[20:25, 40:45] = -1
    voted = vote_directions(direction)
    assert np.array_equal(voted < 0, direction < 0)
    for i, j in ((0, 0), (30, 10), (30, 31), (18, 41), (59, 59)):
        near = direction[max(i - 4, 0) : i + 5, max(j - 4, 0) : j + 5]
        assert voted[i, j] == np.argmax(np.bincount(near[near >= 0], minlength=16))
    assert (voted[5:-5, 5:25] == 3).all()


def test_a_node_has_the_same_stripes_whatever_its_neighbours_read() -> None:
    """Neighbours share the means along a bar, each in its own direction; one node alone reads them anew."""
    rng = np.random.default_rng(9)
    _, z, gray = row_of_bars(0.042, 0.0)
    gray[rng.random(gray.shape) < 0.1] = np.nan
    z[rng.random(z.shape) < 0.02] += np.float32(0.1)
    direction = rng.choice([0, 8, 9], z.shape).astype(np.int8)
    both = find_stripes(z, gray, direction, CELL_M)
    assert 0.1 < (both.pitch > 0).mean() < 0.9
    for row, column in rng.integers(4, 46, (30, 2)):
        alone = np.full_like(direction, -1)
        alone[2 * row, 2 * column] = direction[2 * row, 2 * column]
        stripes = find_stripes(z, gray, alone, CELL_M)
        assert stripes.pitch[row, column] == both.pitch[row, column]
        assert stripes.crest[row, column] == both.crest[row, column]


def test_means_along_a_bar_end_at_steps_and_count_what_is_known() -> None:
    z, gray = np.zeros((20, 20), np.float32), np.arange(400, dtype=np.float32).reshape(20, 20) + 1
    z[10, 14:] = 1
    gray[10, 6] = np.nan
    window = picture_stripes._window()
    mean, share = picture_stripes._mean_along(z, gray, 10, 9, 0, 0.1, window)
    places = [3, 4, 5, 7, 8, 9, 10, 11, 12, 13]
    assert mean == pytest.approx(np.mean([201 + place for place in places]))
    assert share == pytest.approx(10 / 13)
    z[10, 9] = np.nan
    mean, share = picture_stripes._mean_along(z, gray, 10, 9, 0, 0.1, window)
    assert mean == 0
    assert share == 0
