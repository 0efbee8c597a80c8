"""Thin bars across a load: photos drawn from geometry, with streaks along the bars, straps and dunnage."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from barsight.core.errors import ConfigError
from barsight.yard.lift_settings import LiftSettings
from barsight.yard.lifting.thin_bars import thin_bar_checks
from barsight.yard.thin_lines import BESIDE_RATIO, MAX_STRENGTH, _line_strengths, find_thin_line
from barsight.yard.types import HeightMap
from lift_yards import SETTINGS, codes, judged, laid, map_of, record

STOCK = [laid(0.0), laid(0.45)]
HALF_M = STOCK[0].width_m / 2
LOAD = (record(STOCK[0]),)
PIXEL_M = 0.0105
STRAPS_M = (-2.6, -1.3, 0.0, 1.3, 2.6)
DUNNAGE_M = (-1.7, 0.5)


def photo(
    seed: int, bar_m: float = 0.0, slope: float = 0.0, *, at_m: float = -0.6, to_m: float = 0.7,
    along: bool = False,
) -> HeightMap:  # fmt: skip
    """Draw the yard with a photo: bars of gray 50 with highlights of 160, gaps of 25, straps of 35, beams of
    110 in the gaps, and a bar as bright as the others on average, bar_m thick, from x = -0.2 to to_m across,
    or along the first bundle's flank.
    """
    heights, rng = map_of(STOCK), np.random.default_rng(seed)
    x, fine = heights.x_m, 4
    y = heights.y0_m + heights.cell_m * ((np.arange(heights.shape[0] * fine) + 0.5) / fine - 0.5)
    mottle = ndimage.gaussian_filter1d(rng.normal(0, 1, (y.size, x.size)), 1.5 * fine, axis=0)
    gray = np.full((y.size, x.size), 25.0)
    for low in DUNNAGE_M:
        gray[(y > low) & (y < low + 0.09)] = 110.0
    profile = 50 + 110 * np.cos(np.pi * (x - STOCK[0].x_m) / 0.09) ** 4
    for one, shift in zip(STOCK, (0.0, 0.08), strict=True):
        over = np.abs(x - one.x_m) < HALF_M
        gray[:, over] = profile[over] * np.exp(0.12 * mottle[:, over] / mottle.std())
        for strap in STRAPS_M:
            gray[np.ix_(np.abs(y - strap - shift) < 0.016, over)] = 35.0
    if bar_m and along:
        gray[:, np.abs(x - STOCK[0].x_m + HALF_M + 0.02) < bar_m / 2] = profile.mean()
    elif bar_m:
        away = (y[:, None] - at_m - slope * x) / math.hypot(1, slope)
        gray[(np.abs(away) < bar_m / 2) & (x > -0.2) & (x < to_m)] = profile.mean()
    pixels = 0.5 * PIXEL_M / heights.cell_m
    cells = ndimage.gaussian_filter(gray, (pixels * fine, pixels)).reshape(-1, fine, x.size).mean(axis=1)
    noisy = np.rint(cells + rng.normal(0, 0.7, cells.shape)).clip(1, 255).astype(np.uint8)
    return replace(heights, tops=noisy)


@pytest.mark.parametrize(("bar_m", "slope"), [(0.016, 0.0), (0.016, 0.3), (0.02, -0.8), (0.025, 0.05)])
def test_a_thin_bar_across_the_load_is_found_where_it_lies(bar_m: float, slope: float) -> None:
    for seed in range(2):
        line = find_thin_line(photo(seed, bar_m, slope), LOAD[0])
        assert line is not None and line.strength > MAX_STRENGTH
        assert abs(line.along_m + 0.6) < 0.025
        assert line.askew_deg == pytest.approx(math.degrees(math.atan(slope)), abs=4.0)


def test_straps_dunnage_and_a_bar_that_lies_along_are_no_bar_across() -> None:
    for seed in range(2):
        for heights in (photo(seed), photo(seed, 0.02, along=True)):
            for bundle in (LOAD[0], record(STOCK[1], 1)):
                line = find_thin_line(heights, bundle)
                assert line is not None and line.strength < MAX_STRENGTH


def test_a_bar_that_ends_on_the_load_is_found() -> None:
    line = find_thin_line(photo(5, 0.02, to_m=0.1), LOAD[0])
    assert line is not None and line.strength > MAX_STRENGTH


def test_a_lift_onto_a_thin_bar_is_vetoed_and_one_onto_straps_is_not() -> None:
    assert codes(judged(STOCK, heights=photo(0))) == set()
    lift = judged(STOCK, heights=photo(0, 0.02, 0.1))
    assert codes(lift) == {"thin-bar"}
    (failed,) = [check for check in lift.checks if check.result == "failed"]
    assert (
        failed.value is not None and failed.bound == MAX_STRENGTH and "across the load -0.6" in failed.reason
    )


def test_without_a_photo_nobody_knows() -> None:
    heights = map_of(STOCK)
    assert find_thin_line(heights, LOAD[0]) is None
    (unknown,) = thin_bar_checks(heights, None, LOAD, PIXEL_M, SETTINGS)
    assert (unknown.code, unknown.result) == ("thin-bar", "unknown")
    # A map that no pictures made is taken as it is.
    assert thin_bar_checks(heights, None, LOAD, None, SETTINGS) == []
    seen = photo(0)
    assert seen.tops is not None
    seen.tops[np.abs(seen.y_m) < 1.0] = 0
    assert find_thin_line(seen, LOAD[0]) is None


def test_pictures_too_coarse_to_show_a_bar_forbid() -> None:
    heights = photo(0)
    line = find_thin_line(heights, LOAD[0])
    results = {
        pixel_m: thin_bar_checks(heights, line, LOAD, pixel_m, SETTINGS)[1].result
        for pixel_m in (0.005, PIXEL_M, 0.014, math.nan)
    }
    assert list(results.values()) == ["passed", "passed", "failed", "unknown"]
    coarse = LiftSettings(max_hidden_bar_m=0.03)
    assert thin_bar_checks(heights, line, LOAD, 0.014, coarse)[1].result == "passed"
    with pytest.raises(ConfigError, match="max_hidden_bar_m"):
        LiftSettings(max_hidden_bar_m=0.0)


def strength_slowly(contrast: np.ndarray, power: np.ndarray, slope: float, ends: np.ndarray, v: int) -> float:
    """Compute the strength of a line through row v of the middle column; two of `ends` lie left of it."""

    def along(image: np.ndarray, first: int, end: int) -> float:
        columns = np.arange(first, end)
        rows = v + slope * (columns - image.shape[1] // 2)
        return float(ndimage.map_coordinates(image, [rows, columns], order=1, mode="grid-constant").sum())

    own, width, found = along(contrast, ends[1], ends[2]), ends[2] - ends[1], []
    for first, end in itertools.product(ends[:2], ends[2:]):
        beside = along(contrast, first, end) - own
        counted = min(beside, BESIDE_RATIO * max(own, 0) * ((end - first) / width - 1))
        found.append((own + counted) / math.sqrt(3 * (along(power, first, end) + 2)))
    return max(found)


def test_a_lines_strength_is_its_sum_along_it() -> None:
    rng = np.random.default_rng(3)
    contrast, power = (rng.normal(size=(40, 31)).astype(np.float32) for _ in range(2))
    power, slopes, ends = power**2, np.array([-1.17, 0.0, 0.33]), np.array([2, 8, 23, 30])
    padded = (np.pad(np.ascontiguousarray(part.T), ((0, 0), (40, 40))) for part in (contrast, power))
    found = _line_strengths(*padded, 40, slopes, ends, 2, 15)
    wanted = [[strength_slowly(contrast, power, slope, ends, v) for v in range(40)] for slope in slopes]
    np.testing.assert_allclose(found, wanted, atol=2e-5)
