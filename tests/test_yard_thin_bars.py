"""Thin bars across a load: photos drawn from geometry, with streaks along the bars, straps and dunnage."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from barsight.bundle_pictures.crossing_edges import with_edge
from barsight.core.errors import ConfigError
from barsight.yard.bundles.layers import check_uncovered
from barsight.yard.lift_settings import LiftSettings
from barsight.yard.magnet.footprint import Placement
from barsight.yard.placement.thin_bars import beside_checks, may_reach, thin_bar_checks
from barsight.yard.thin_lines import (
    BESIDE_RATIO,
    MAX_STRENGTH,
    SURE_STRENGTH,
    WIDE_M,
    ThinLine,
    _line_strengths,
    find_thin_lines,
    with_thin_lines,
)
from barsight.yard.types import Bundle, Doubt, DoubtKind, HeightMap
from lift_yards import MAGNET, SETTINGS, codes, judged, laid, map_of, record

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


def strongest(heights: HeightMap, bundle: Bundle) -> ThinLine | None:
    lines = find_thin_lines(heights, bundle)
    return None if lines is None else lines[0]


@pytest.mark.parametrize(("bar_m", "slope"), [(0.016, 0.0), (0.016, 0.3), (0.02, -0.8), (0.025, 0.05)])
def test_a_thin_bar_across_the_load_is_found_where_it_lies(bar_m: float, slope: float) -> None:
    for seed in range(2):
        line = strongest(photo(seed, bar_m, slope), LOAD[0])
        assert line is not None and line.strength > MAX_STRENGTH
        assert abs(line.along_m + 0.6) < 0.025
        assert line.askew_deg == pytest.approx(math.degrees(math.atan(slope)), abs=4.0)


@pytest.mark.parametrize(("bar_m", "told"), [(0.0, False), (0.02, True)])
def test_a_bar_across_a_narrow_load_is_found_on_a_bright_floor(bar_m: float, *, told: bool) -> None:
    narrow = replace(laid(0.0), bars=7, diameter_m=0.03)
    heights, bundle = map_of([narrow]), record(narrow)
    x, fine = heights.x_m, 4
    profile = 50 + 110 * np.cos(np.pi * x / 0.03) ** 4
    y = heights.y0_m + heights.cell_m * ((np.arange(heights.shape[0] * fine) + 0.5) / fine - 0.5)
    for seed in range(3):
        rng = np.random.default_rng(seed)
        mottle = ndimage.gaussian_filter1d(rng.normal(0, 1, (y.size, x.size)), 1.5 * fine, axis=0)
        gray = np.where(np.abs(x) < bundle.width_m / 2, profile, 84.0)
        gray = gray * np.exp(0.05 * mottle / mottle.std())
        gray[np.ix_(np.abs(y + 0.2) < bar_m / 2, np.abs(x) < 0.6)] = profile.mean()
        pixels = 0.5 * PIXEL_M / heights.cell_m
        cells = ndimage.gaussian_filter(gray, (pixels * fine, pixels)).reshape(-1, fine, x.size).mean(axis=1)
        noisy = np.rint(cells + rng.normal(0, 0.7, cells.shape)).clip(1, 255).astype(np.uint8)
        line = strongest(replace(heights, tops=noisy), bundle)
        assert line is not None and (line.excess_ratio > 1) is told


def test_straps_dunnage_and_a_bar_that_lies_along_are_no_bar_across() -> None:
    for seed in range(2):
        for heights in (photo(seed), photo(seed, 0.02, along=True)):
            for bundle in (LOAD[0], record(STOCK[1], 1)):
                line = strongest(heights, bundle)
                assert line is not None and line.strength < MAX_STRENGTH


def test_a_bar_that_ends_on_the_load_is_found() -> None:
    line = strongest(photo(5, 0.02, to_m=0.1), LOAD[0])
    assert line is not None and line.strength > MAX_STRENGTH


def test_a_lift_onto_a_thin_bar_is_vetoed_and_one_onto_straps_is_not() -> None:
    assert codes(judged(STOCK, heights=photo(0))) == set()
    lift = judged(STOCK, heights=photo(0, 0.02, 0.1))
    assert codes(lift) == {"thin-bar"}
    failed, beside = (check for check in lift.checks if check.result == "failed")
    assert failed.value is not None and failed.bound == MAX_STRENGTH * math.sqrt(LOAD[0].width_m / WIDE_M)
    assert "crosses the load -0.6" in failed.reason and "crosses bundle 1 -0.56" in beside.reason


def test_all_lines_across_are_found_the_strongest_first() -> None:
    one, other = photo(0, 0.02), photo(0, 0.016, at_m=1.9)
    assert one.tops is not None and other.tops is not None
    rows = one.y_m > 0.6
    one.tops[rows] = other.tops[rows]
    lines = find_thin_lines(one, LOAD[0])
    assert lines is not None
    over = [line for line in lines if line.strength > MAX_STRENGTH]
    assert sorted(round(line.along_m, 1) for line in over) == [-0.6, 1.9]
    strengths = [line.strength for line in lines]
    assert strengths == sorted(strengths, reverse=True)


@pytest.mark.parametrize("ratio", [1.5, 2.0, 2.5])
@pytest.mark.parametrize("half_m", [0.2, 0.8])
def test_a_thin_bar_where_the_sun_shines_on_the_load_is_found(half_m: float, ratio: float) -> None:
    heights = photo(0, 0.02, 0.05)
    assert heights.tops is not None
    sunny = np.abs(heights.y_m + 0.6) < half_m
    lit = np.where(sunny[:, None], ratio * heights.tops, heights.tops)
    line = strongest(replace(heights, tops=lit.clip(1, 255).astype(np.uint8)), LOAD[0])
    assert line is not None and line.strength > SURE_STRENGTH and abs(line.along_m + 0.6) < 0.025


@pytest.mark.parametrize("half_m", [0.2, 9.0])
@pytest.mark.parametrize("ratio", [1.5, 3.3, 4.0, 5.0, 8.0])
def test_no_thin_bar_is_ruled_out_where_the_photo_is_saturated(half_m: float, ratio: float) -> None:
    heights = photo(0, 0.02, 0.05)
    assert heights.tops is not None
    bright = np.abs(heights.y_m + 0.6) < half_m
    tops = np.where(bright[:, None], ratio * heights.tops, heights.tops).clip(1, 255).astype(np.uint8)
    assert codes(judged(STOCK, heights=replace(heights, tops=tops))) == {"thin-bar"}
    assert ratio > 3 or strongest(replace(heights, tops=tops), LOAD[0]) is not None


@pytest.mark.parametrize(("gap_m", "vetoed"), [(0.2, True), (0.5, False)])
def test_a_bar_across_a_neighbour_that_may_reach_under_the_magnet_forbids(gap_m: float, vetoed: bool) -> None:
    place, half = Placement(0.0, 0.0, 0.0), MAGNET.size_m[0] / 2
    neighbour = record(laid(half + gap_m + HALF_M + 0.05), 7)
    line = ThinLine(12.0, -0.6, 0.0)
    (check,) = beside_checks(place, MAGNET, ((neighbour, (line,)),))
    assert (check.result == "failed") == vetoed
    if vetoed:
        assert "bundle 7 -0.60 m along it" in check.reason
    # Beyond the magnet's end it does no harm, nor does what isn't sure to be a line.
    for harmless in (replace(line, along_m=3.4), replace(line, strength=MAX_STRENGTH - 0.1)):
        (check,) = beside_checks(place, MAGNET, ((neighbour, (harmless,)),))
        assert check.result == "passed"


def test_a_neighbour_is_left_out_only_where_no_line_across_it_comes_under_the_magnet() -> None:
    rng, place, found = np.random.default_rng(4), Placement(0.1, -0.2, 0.02), []
    for _ in range(400):
        one = record(
            laid(
                float(rng.uniform(-1.5, 1.5)),
                y_m=float(rng.uniform(-8, 8)),
                yaw_deg=float(rng.uniform(-90, 90)),
            )
        )
        lines = [
            ThinLine(12.0, float(along), float(askew))
            for along in np.linspace(-0.5, 0.5, 29) * one.length_m
            for askew in (-50.0, -20.0, 0.0, 20.0, 50.0)
        ]
        (check,) = beside_checks(place, MAGNET, ((one, tuple(lines)),))
        found.append((check.result == "failed", may_reach(one, place, MAGNET, one.top_z_m)))
        assert not may_reach(one, place, MAGNET, one.top_z_m + 0.31)
        assert may_reach(one, place, MAGNET, one.top_z_m + 0.29) == found[-1][1]
    assert (True, False) not in found and {(True, True), (False, False)} <= set(found)


def test_a_neighbour_that_no_photo_shows_leaves_open_what_sticks_out_of_it() -> None:
    heights = photo(0)
    assert heights.tops is not None
    heights.tops[:, abs(heights.x_m - STOCK[1].x_m) < HALF_M] = 0
    lift = judged(STOCK, heights=heights)
    assert codes(lift) == {"thin-bar"}
    assert any("bundle 1 beside the load" in veto.reason for veto in lift.vetoes)
    far = replace(STOCK[1], x_m=MAGNET.size_m[0] + HALF_M + 0.8)
    (check,) = beside_checks(Placement(0.0, 0.0, 0.0), MAGNET, ((record(far, 1), None),))
    assert check.result == "passed"


def test_a_lift_beside_a_neighbour_with_a_bar_over_its_flank_is_vetoed() -> None:
    heights = photo(0, 0.02, to_m=0.7)
    assert heights.tops is not None
    clear = photo(0)
    assert clear.tops is not None
    on_load = abs(heights.x_m) < HALF_M + 0.02
    heights.tops[:, on_load] = clear.tops[:, on_load]
    assert codes(judged(STOCK, heights=heights)) == {"thin-bar"}


@pytest.mark.parametrize(("away_m", "vetoed"), [(0.45, True), (2.0, False)])
def test_a_lift_beside_a_neighbour_with_an_edge_over_its_flank_is_vetoed(away_m: float, vetoed: bool) -> None:
    """A dark bar has edges, and no bright line in the photo."""
    stock = [STOCK[0], replace(STOCK[1], x_m=away_m)]
    neighbour = with_edge(record(stock[1], 1), 0.4)
    lift = judged(stock, (record(stock[0]), neighbour), heights=photo(0))
    assert codes(lift) == ({"thin-bar"} if vetoed else set())
    assert not vetoed or "on bundle 1, an edge runs over its flank +0.40 m" in lift.vetoes[0].reason


def test_without_a_photo_nobody_knows() -> None:
    heights = map_of(STOCK)
    assert find_thin_lines(heights, LOAD[0]) is None
    (unknown,) = thin_bar_checks(heights, None, LOAD, PIXEL_M, SETTINGS)
    assert (unknown.code, unknown.result) == ("thin-bar", "unknown")
    # A map that no pictures made is taken as it is.
    assert thin_bar_checks(heights, None, LOAD, None, SETTINGS) == []
    seen = photo(0)
    assert seen.tops is not None
    seen.tops[np.abs(seen.y_m) < 1.0] = 0
    assert strongest(seen, LOAD[0]) is None


def test_pictures_too_coarse_to_show_a_bar_forbid() -> None:
    heights = photo(0)
    line = strongest(heights, LOAD[0])
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


@pytest.mark.parametrize(("bar_m", "sure"), [(0.0, None), (0.008, False), (0.025, True)])
def test_a_strong_line_covers_a_bundle_and_a_faint_one_is_a_doubt(bar_m: float, sure: bool | None) -> None:
    """Lifts are forbidden for both: only what `on_top` says differs."""
    heights = photo(1, bar_m, 0.05)
    line, bundle = strongest(heights, LOAD[0]), with_thin_lines(LOAD[0], heights)
    assert line is not None and (line.strength > SURE_STRENGTH) == bool(sure)
    assert (line.strength > MAX_STRENGTH) == (sure is not None) == bool(bundle.cover_doubts)
    on_top, _ = check_uncovered(bundle, [bundle], layer=0)
    assert on_top is (None if sure else True) and bundle.is_free == (sure is None)


@pytest.mark.parametrize(
    ("kind", "layer", "on_top"),
    [(DoubtKind.HIDDEN_FLANK, 0, True), (DoubtKind.HIDDEN_FLANK, 1, None), (DoubtKind.UNSEEN_FLANK, 0, None)],
)
def test_a_hidden_flank_leaves_open_what_lies_on_a_bundle_but_on_the_floor(
    kind: DoubtKind, layer: int, on_top: bool | None
) -> None:
    doubt = Doubt(kind, kind.value)
    bundle = replace(LOAD[0], reasons=(doubt,), cover_doubts=(doubt,))
    assert check_uncovered(bundle, [bundle], layer)[0] is on_top
    assert not bundle.is_free
