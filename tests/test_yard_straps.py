"""Straps in drawn orthophotos: what they hold together, and when they tell nothing."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from barsight.core.records.heights import HeightSource
from barsight.simulation.worlds.packing import packed
from barsight.simulation.worlds.settling import BarPack, settle
from barsight.yard.bundles.detection import find_bundles
from barsight.yard.bundles.fitting.outline_fit import AGREES, Fit, FittedOutline, ShadeProfile
from barsight.yard.bundles.fitting.rotated_map import align_map
from barsight.yard.bundles.fitting.settings import BundleSettings
from barsight.yard.bundles.pack_edges import hold_off
from barsight.yard.bundles.reading import Reading
from barsight.yard.bundles.section.dark_lines import dark_lines
from barsight.yard.bundles.section.pack_sides import PackSide, _parting, _widest, ends_over_lower_bar
from barsight.yard.bundles.section.packs import Pack, contradicts, find_pack, strapped_pack
from barsight.yard.bundles.section.seen_section import SeenSection, section_of_pack
from barsight.yard.bundles.section.strap_lines import _best_stretches, row_gains, split_columns
from barsight.yard.bundles.section.straps import StrapSpan, _merged, longest_runs
from barsight.yard.bundles.strapped_bundles import _as_pack, _covered, _may_go_on, held_by_straps
from barsight.yard.types import DoubtKind, HeightMap
from lift_yards import laid, record
from yard_maps import Laid, draw, photographed

CELL = 0.01
LENGTH_M, WIDE_M = 5.0, 1.2


def drawn(
    packs: list[tuple[float, float, tuple[float, ...]]], rng: np.random.Generator, *, beside_m: float = 0.0,
    rough_log: float = 0.12, shades: tuple[float, ...] = (0.5, 1.8),
) -> HeightMap:  # fmt: skip
    """Draw round-topped packs (low x, high x, y of straps) on the floor, their gray levels with noise of
    rough_log; straps are darker or brighter by one of `shades` at each place. beside_m: height of what fills
    the rest."""
    x = CELL * np.arange(round(WIDE_M / CELL)) - WIDE_M / 2
    y = CELL * np.arange(round(LENGTH_M / CELL)) - LENGTH_M / 2
    z = np.full((len(y), len(x)), beside_m)
    gray = 60 * np.exp(rng.normal(0, rough_log, z.shape))
    for low, high, straps in packs:
        own = (x >= low) & (x < high)
        away = (x[own] - (low + high) / 2) / (high - low)
        z[:, own] = 0.3 - 0.3 * (2 * away) ** 4 * (high - low)
        for at in straps:
            rows = np.abs(y - at) < 0.016
            gray[np.ix_(rows, own)] *= rng.choice(shades, own.sum())
    z += rng.normal(0, 0.001, z.shape)
    shape = z.shape
    return HeightMap(
        float(x[0]), float(y[0]), CELL, z.astype(np.float32), np.full(shape, 0.003, np.float32),
        np.full(shape, 4, np.float32), np.full(shape, HeightSource.VISION, np.uint8),
        np.clip(gray, 1, 255).astype(np.uint8),
    )  # fmt: skip


def straight(*rows: float) -> tuple[tuple[float, float], ...]:
    """Straps square to the axis."""
    return tuple((row, row) for row in rows)


def pack_at(heights: HeightMap, u_m: float, width_m: float = 0.2, rings: int = 1) -> Pack | None:
    """Look for straps over an outline about x = u_m that agrees with all rows."""
    grid = align_map(heights, 0.0, 0.05)
    rows = grid.z_m.shape[0]
    values = np.array([u_m, 0.0, 0.2, 0.0, 0.0, width_m / 3])
    state, gain = np.full(rows, AGREES, np.uint8), np.ones(rows, np.float32)
    middle = grid.v0_m + CELL * rows / 2
    fit = Fit(rings, middle, values, np.zeros((6, 6)), 0, rows - 1, state, gain, 0.0, 0.0)
    return strapped_pack(heights, grid, fit)


@pytest.mark.parametrize("seed", range(5))
def test_straps_tell_touching_bundles_apart(seed: int) -> None:
    rng = np.random.default_rng(seed)
    heights = drawn([(-0.25, 0.0, (-1.5, 0.1, 1.6)), (0.0, 0.22, (-1.1, 0.6, 2.0))], rng)
    for u, low, high in ((-0.15, -0.25, 0.0), (0.12, 0.0, 0.22)):
        pack = pack_at(heights, u)
        assert pack is not None and pack.sides_seen
        assert u + pack.low_m == pytest.approx(low, abs=1.6 * CELL)
        assert u + pack.high_m == pytest.approx(high, abs=1.6 * CELL)
        assert len(pack.span.rows_m) == 3


@pytest.mark.parametrize(("count", "seed"), [(2, 0), (3, 1), (4, 0)])
def test_slim_bundles_side_by_side_are_no_triangles_of_thick_bars(count: int, seed: int) -> None:
    """Half of them were lost: two crests 144 mm apart look like two bars of 137 mm on a third one."""
    beside = [Laid(0.3 + 0.144 * k, 0.0, 0.3, 0.0, 0.04, 7, 5.0, 0.0) for k in range(count)]
    heights = photographed(draw(beside, (-0.3, 1.4), (-2.8, 2.8), seed=seed), beside, blur_m=0.02)
    y, x = np.meshgrid(heights.y_m, heights.x_m, indexing="ij")
    assert heights.gray is not None
    for k, one in enumerate(beside):
        for at in (-1.9, -0.6, 0.7, 2.0):
            heights.gray[np.isfinite(one.over(x, y)) & (np.abs(y - at - 0.3 * (k % 3)) < 0.016)] = 20
    found = find_bundles(heights, BundleSettings())
    assert [b.centre_m[0] for b in found] == pytest.approx([one.x_m for one in beside], abs=0.006)
    assert [b.width_m for b in found] == pytest.approx([0.12] * count, abs=0.04)


@pytest.mark.parametrize("seed", range(5))
def test_straps_in_line_leave_the_sides_open(seed: int) -> None:
    rows = (-1.5, 0.1, 1.6)
    heights = drawn([(-0.25, 0.0, rows), (0.0, 0.22, rows)], np.random.default_rng(seed))
    for u in (-0.15, 0.12):
        pack = pack_at(heights, u)
        assert pack is None or not pack.sides_seen


def test_a_flank_out_of_sight_is_not_seen() -> None:
    rng = np.random.default_rng(3)
    heights = drawn([(-0.2, 0.2, (-1.5, 0.1, 1.6))], rng)
    assert (whole := pack_at(heights, 0.0, 0.3)) is not None and whole.sides_seen
    x = heights.x0_m + CELL * np.arange(heights.shape[1])
    for hidden in ((x > 0.05), (x > 0.05) & (x < 0.15)):
        part = replace(heights, z_m=np.where(hidden, np.float32(np.nan), heights.z_m))
        pack = pack_at(part, -0.05, 0.3)
        assert pack is None or not pack.sides_seen


@pytest.mark.parametrize(("hidden_m", "last_m"), [(0.0, -0.06), (0.08, -0.06), (0.08, -0.048)])
def test_what_is_out_of_sight_behind_a_flank_makes_the_width_unsure(hidden_m: float, last_m: float) -> None:
    """Packs whose bars bulge out of sight were told as half their mass; the last place seen may be noisy."""
    level = level_of(*LEFT, (0.09, -0.05), (0.1, last_m), (0.101, -1.0), (0.4, -1.0))
    level[(BESIDE > 0.102) & (0.102 + hidden_m > BESIDE)] = np.nan
    pack = pack_beside(level, ROWS, 0.35)
    assert pack.sides_seen and pack.high_m == pytest.approx(0.1, abs=1.1 * CELL)
    assert pack.hidden_m == pytest.approx((0.0, hidden_m))
    state, gain = np.zeros(1, np.uint8), np.zeros(1, np.float32)
    fit = Fit(1, 0.0, np.zeros(6), np.zeros((6, 6)), 0, 0, state, gain, 0.0, 0.0)
    grid = align_map(drawn([], np.random.default_rng(0)), 0.0, 0.05)
    reading, bundle = Reading(FittedOutline(grid, fit), 0.0, None, 0.0, None), record(laid(0.0))
    sure, unsure = (
        _as_pack(bundle, bundle.sigma, reading, one, 0.0)
        for one in (replace(pack, hidden_m=(0.0, 0.0)), pack)
    )
    assert unsure.sigma.width_m == pytest.approx(np.hypot(sure.sigma.width_m, 0.4 * hidden_m))
    assert unsure.sigma.lateral_m == pytest.approx(np.hypot(sure.sigma.lateral_m, 0.2 * hidden_m))
    assert (unsure.sigma.section_m2 > sure.sigma.section_m2) == (hidden_m > 0)


def test_straps_that_go_on_contradict_an_outline() -> None:
    span = StrapSpan(-0.14, 0.06, straight(1.0, 2.0), 0.0)
    pack = Pack(-0.15, 0.08, span, (-np.inf, 0.09), 0.1, (PackSide.SEEN, PackSide.OPEN))
    for width, off, said in ((0.2, 0.04, "beyond its outline"), (0.26, 0.04, "into its outline")):
        off_m, doubt = contradicts(pack, width)
        assert said in doubt and off_m == pytest.approx(off)
    assert contradicts(replace(pack, others_m=(-np.inf, np.inf)), 0.26) == (0.0, "")


@pytest.mark.parametrize(
    ("sides_m", "shown", "seen_m", "aside_m"),
    [
        ((-0.1, 0.0), True, None, 0.0),
        ((-0.1, 0.0), False, (-0.105, 0.105), 0.0),
        ((-0.1, 0.0), False, None, 0.05),
        ((-0.1, 0.0), False, (-0.075, 0.075), 0.05),
        ((-0.06, 0.0), True, None, 0.03),
        ((-0.1, 0.2), True, None, 0.05),
        ((-0.1, 0.0), False, (-0.055, 0.155), 0.05),
        ((-0.075, 0.0), True, None, 0.025),
        ((-0.075, 0.0), False, (-0.075, 0.135), 0.03),
    ],
)
def test_straps_on_a_part_of_an_outline_dont_move_it_where_more_shows_that_it_is_right(
    sides_m: tuple[float, float], shown: bool, seen_m: tuple[float, float] | None, aside_m: float
) -> None:
    """Outlines within 3 mm of the truth had a sigma of 50 mm: sun hid the straps on one half of the bars.
    Then outlines whose straps and sides lie 55 mm aside had one of 3 mm.
    """
    state, gain = np.zeros(1, np.uint8), np.zeros(1, np.float32)
    fit = Fit(1, 0.0, np.array([0, 0, 0, 0, 0, 0.2 / 3]), np.zeros((6, 6)), 0, 0, state, gain, 0.0, 0.0)
    grid = align_map(drawn([], np.random.default_rng(0)), 0.0, 0.05)
    shades = ShadeProfile(np.zeros(1), np.zeros(1)) if shown else None
    span = StrapSpan(*sides_m, straight(1.0, 2.0, 3.0), 0.0)
    pack = Pack(*sides_m, span, (-np.inf, np.inf), 0.1, (PackSide.SEEN, PackSide.OPEN))
    reading = Reading(FittedOutline(grid, fit, shades), 0.0, None, 0.0, None, pack)
    seen = None
    if seen_m is not None:
        width, middle = seen_m[1] - seen_m[0], sum(seen_m) / 2
        seen = SeenSection(width, 0.0, sides_seen=True, sides_free=False, middle_m=middle)
    bundle = record(laid(0.0), bars=None)
    held = held_by_straps(bundle, bundle.sigma, reading, seen, 0.0)
    assert (held.sigma.lateral_m > 0.02) == (aside_m > 0.02)
    assert held.sigma.lateral_m > 0.99 * aside_m


@pytest.mark.parametrize("over_m", [0.1, 0.18, 0.36, np.inf])
@pytest.mark.parametrize("width_m", [0.1, 0.25, 0.7])
def test_a_section_fits_into_its_box(width_m: float, over_m: float) -> None:
    section, sigma = section_of_pack(width_m, 0.02, over_m)
    box = (width_m + 1.645 * 0.02) * min(over_m, 1.25 * width_m)
    assert section > 1.645 * sigma > 0
    assert section + 1.645 * sigma <= 0.79 * box + 1e-12
    wider = section_of_pack(width_m, 0.04, over_m)
    assert wider[0] == section and wider[1] >= sigma


def test_sections_of_settled_packs_lie_in_their_intervals() -> None:
    """Take their true width, with and without the floor under them; the prior is set on other seeds."""
    errors = []
    for seed in range(5000, 5120):
        rng = np.random.default_rng(seed)
        diameter = float(rng.choice([0.016, 0.025, 0.04, 0.06, 0.09]))
        count = int(np.clip(rng.uniform(0.006, 0.045) / (math.pi / 4 * diameter**2), 3, 200))
        hung = packed(count, diameter, rng) + np.array([0.0, 0.5])
        (pack,) = settle([BarPack(hung, diameter / 2)], [], [])
        width, height = pack.extent[1] - pack.extent[0], pack.top
        steel = count * math.pi / 4 * diameter**2
        for over in (height + 0.002, height + 0.09, np.inf):
            section, sigma = section_of_pack(width, 0.005, over)
            errors.append((steel - section) / sigma)
    assert 0.93 < np.mean(np.abs(errors) < 1.96) < 0.995
    assert np.mean(np.array(errors) < 1.645) > 0.95


@pytest.mark.parametrize("turn_deg", range(0, 60, 5))
def test_full_hexagons_weigh_no_more_than_their_bound(turn_deg: int) -> None:
    turn = math.radians(turn_deg)
    for rings in (1, 2, 3, 4):
        axes = [(q + r / 2, r * math.sqrt(0.75)) for q in range(-rings, rings + 1)
                for r in range(-rings, rings + 1) if abs(q + r) <= rings]  # fmt: skip
        across = np.array(axes) @ [math.cos(turn), math.sin(turn)]
        section, sigma = section_of_pack(float(np.ptp(across)) + 1.0, 0.0, np.inf)
        assert abs(len(axes) * math.pi / 4 - section) < 1.645 * sigma


def test_straps_over_what_looks_like_one_bar_bound_no_pack() -> None:
    """Doubt them: the topmost of thick bars alone may be in sight, and straps are wider than that."""
    heights = drawn([(-0.1, 0.1, (-1.5, 0.1, 1.6))], np.random.default_rng(2))
    assert (whole := pack_at(heights, 0.0, 0.5, rings=0)) is not None and not whole.is_bounded
    assert (whole := pack_at(heights, 0.0, 0.3, rings=0)) is not None and whole.is_bounded


def test_what_goes_on_beside_a_strap_leaves_the_side_open() -> None:
    heights = drawn([(-0.1, 0.1, (-1.5, 0.1, 1.6))], np.random.default_rng(2), beside_m=0.25)
    pack = pack_at(heights, 0.0)
    assert pack is not None and not pack.sides_seen


STRAPS = (-1.5, 0.2, 1.6)


@pytest.mark.parametrize(("width_m", "top_m"), [(0.2, 0.28), (0.3, 0.28), (0.3, 0.35)])
def test_straps_make_a_bundle_of_a_level_top(width_m: float, top_m: float) -> None:
    """With upright sides it looks like a plate or a wall; a circle over it would reach under the floor."""
    for straps in ((), STRAPS):
        heights = drawn([(0.3 - width_m / 2, 0.3 + width_m / 2, straps)], np.random.default_rng(3))
        level = heights.z_m > 0.1
        heights.z_m[level] = top_m + np.random.default_rng(4).normal(0, 0.001, int(level.sum()))
        bundles = find_bundles(heights, BundleSettings())
        assert len(bundles) == len(straps) / 3
        for one in bundles:
            assert one.width_m == pytest.approx(width_m, abs=0.01)
            assert one.centre_m[0] == pytest.approx(0.3, abs=0.02)
            assert one.top_z_m == pytest.approx(top_m, abs=0.02) and one.on_top is True


@pytest.mark.parametrize("at_border", [False, True])
@pytest.mark.parametrize(("straps", "carried"), [((), False), ((), True), (STRAPS, False), (STRAPS, True)])
def test_what_nothing_carries_may_be_a_wall(
    straps: tuple[float, ...], carried: bool, at_border: bool
) -> None:
    """Something round 0.6 m over the floor: alone or on beams across; one of its sides may be out of view,
    where beams tell nothing.
    """
    heights = drawn([(0.2, 0.4, straps)], np.random.default_rng(3))
    heights.z_m[heights.z_m > 0.1] += 0.3
    if carried:
        y = heights.y0_m + CELL * np.arange(heights.z_m.shape[0])
        beams = (np.abs(np.abs(y) - 1.5) < 0.06)[:, None] & (heights.z_m < 0.1)
        heights.z_m[beams] = 0.28
    if at_border:
        beyond = heights.x_m > 0.395
        heights.z_m[:, beyond], heights.source[:, beyond] = np.nan, HeightSource.UNKNOWN
    (one,) = find_bundles(heights, BundleSettings())
    is_wall = DoubtKind.WALL in {doubt.kind for doubt in one.reasons}
    assert is_wall is (at_border or not carried)
    assert one.on_top is (None if is_wall else True)
    assert (one.confidence < 0.5) is is_wall


def test_bars_without_straps_show_none() -> None:
    found = [pack_at(drawn([(-0.12, 0.12, ())], np.random.default_rng(seed)), 0.0) for seed in range(20)]
    assert found == [None] * 20


@pytest.mark.parametrize("seed", range(5))
def test_straps_fainter_than_the_bars_own_spots_are_found(seed: int) -> None:
    rows = (-1.5, 0.1, 1.6), (-1.1, 0.6, 2.0)
    packs = [(-0.25, 0.0, rows[0]), (0.0, 0.22, rows[1])]
    heights = drawn(packs, np.random.default_rng(seed), rough_log=0.35, shades=(0.7,))
    found = 0
    for u, low, high in ((-0.13, -0.25, 0.0), (0.11, 0.0, 0.22)):
        pack = pack_at(heights, u)
        assert pack is not None and len(pack.span.rows_m) >= 3
        if pack.sides_seen:
            found += 1
            assert u + pack.low_m == pytest.approx(low, abs=2.6 * CELL)
            assert u + pack.high_m == pytest.approx(high, abs=2.6 * CELL)
    assert found


def test_spots_of_rough_bars_are_no_straps() -> None:
    drawn_ones = (
        drawn([(-0.12, 0.12, ())], np.random.default_rng(seed), rough_log=0.35) for seed in range(20)
    )
    assert sum(pack_at(heights, 0.0) is not None for heights in drawn_ones) == 0


def test_a_clear_span_is_kept_unless_it_is_a_part_of_a_faint_one() -> None:
    faint = StrapSpan(-0.1, 0.1, straight(1.0, 2.0), 0.0)
    edge = StrapSpan(-0.09, 0.1, straight(1.0, 2.0), 0.0)
    part = StrapSpan(-0.1, 0.0, straight(1.0, 2.0), 0.0)
    rest = StrapSpan(0.0, 0.1, straight(1.5, 2.5), 0.0)
    over = StrapSpan(0.0, 0.3, straight(1.5, 2.5), 0.0)
    for clear, kept in (((), (faint,)), ((edge,), (edge,)), ((part,), (faint,))):
        assert _merged(list(clear), [faint]) == kept
    for clear in ((part, rest), (over,)):
        assert _merged(list(clear), [faint]) == clear


def test_a_place_belongs_to_the_straps_that_it_shares() -> None:
    contrast = np.full((200, 60), -1.2)
    contrast[[20, 100, 180], :25] = 3.0
    contrast[[60, 140], 25:] = 3.0
    contrast = np.maximum(contrast, np.roll(contrast, 1, axis=0))
    found = split_columns(contrast, 7, np.zeros(60, bool), np.zeros(60, bool))
    assert [(first, last) for first, last, _ in found] == [(0, 25), (25, 60)]
    assert [len(rows) for _, _, rows in found] == [3, 2]


BESIDE = CELL * np.arange(-40, 41)
ROWS, OTHER_ROWS = straight(0.5, 2.0, 3.5), straight(1.0, 2.6, 4.1)


def level_of(*points: tuple[float, float]) -> np.ndarray:
    """Heights over the places beside an axis, linear between points."""
    return np.interp(BESIDE, *np.array(points).T)


def pack_beside(
    level: np.ndarray, rows: tuple[tuple[float, float], ...], begins_m: float, thick_m: float = 0.1
) -> Pack:
    spans = StrapSpan(-0.12, 0.09, ROWS, 0.0), StrapSpan(begins_m, begins_m + 0.15, rows, 0.0)
    pack = find_pack(spans, 0, BESIDE, level, thick_m)
    assert pack is not None
    return pack


LEFT = (-0.4, -1.0), (-0.14, -1.0), (-0.13, -0.06), (-0.06, -0.01), (0.0, 0.0)


@pytest.mark.parametrize(
    ("right", "rows", "seen"),
    [
        (((0.09, -0.04), (0.13, -0.09), (0.2, -0.03), (0.4, 0.0)), OTHER_ROWS, True),
        (((0.09, -0.04), (0.13, -0.09), (0.2, -0.03), (0.4, 0.0)), ROWS, False),
        (((0.09, -0.04), (0.11, -0.08), (0.14, -0.04), (0.17, -0.08), (0.2, -0.03), (0.4, 0.0)), OTHER_ROWS,
         False),
        (((0.09, -0.04), (0.13, -0.05), (0.2, -0.06), (0.4, -0.06)), OTHER_ROWS, False),
        (((0.09, -0.04), (0.13, -0.04), (0.14, 0.3), (0.4, 0.3)), OTHER_ROWS, False),
    ],
    ids=["a gully", "straps in line", "two gullies", "no gully", "something higher begins"],
)  # fmt: skip
def test_a_single_gully_before_other_straps_is_the_flank(
    right: tuple[tuple[float, float], ...], rows: tuple[tuple[float, float], ...], seen: bool
) -> None:
    pack = pack_beside(level_of(*LEFT, *right), rows, 0.21)
    assert pack.sides_seen == seen
    if seen:
        assert pack.low_m == pytest.approx(-0.135, abs=CELL)
        assert pack.high_m == pytest.approx(0.13, abs=1.1 * CELL)


@pytest.mark.parametrize(
    ("right", "begins_m", "is_other"),
    [
        (((0.07, 0.0), (0.13, -0.09), (0.14, -1.0), (0.4, -1.0)), 0.08, False),
        (((0.3, 0.0), (0.31, -1.0), (0.4, -1.0)), 0.09, False),
        (((0.05, 0.0), (0.09, -0.01), (0.13, 0.0), (0.4, 0.0)), 0.09, True),
        (((0.05, 0.0), (0.09, -0.03), (0.1, np.nan), (0.12, np.nan), (0.13, -0.03), (0.4, -0.03)), 0.1, True),
    ],
    ids=["on its own flank", "on a level top", "behind a dent", "behind what isn't seen"],
)  # fmt: skip
def test_straps_of_others_lie_behind_a_dent(
    right: tuple[tuple[float, float], ...], begins_m: float, is_other: bool
) -> None:
    """Straps on a flank, 30 mm off along the bars from those on the crest, were told as other bundles'."""
    pack = pack_beside(level_of(*LEFT, *right), OTHER_ROWS, begins_m)
    assert pack.others_m == (-np.inf, begins_m if is_other else np.inf)


def test_a_top_as_wide_as_it_is_seen_ends_where_the_floor_shows_behind() -> None:
    """It rises by 4 mm before its edge; a higher bundle stands behind the floor."""
    level = level_of(*LEFT, (0.09, -0.004), (0.13, 0.0), (0.4, 0.0))
    level[(BESIDE > 0.125) & (BESIDE < 0.165)] = np.nan
    level[(BESIDE > 0.165) & (BESIDE < 0.205)] = -np.inf
    level[BESIDE > 0.205] = 0.1
    pack = pack_beside(level, OTHER_ROWS, 0.21)
    assert pack.sides_seen and pack.high_m == pytest.approx(0.125, abs=CELL)


DEEP = (0.09, -0.05), (0.13, -0.12), (0.2, -0.01), (0.4, 0.0)


@pytest.mark.parametrize(
    ("right", "thick_m", "side"),
    [
        (DEEP, 0.1, PackSide.SEEN),
        (DEEP, 0.13, PackSide.OPEN),
        (DEEP, math.nan, PackSide.OPEN),
        (((0.09, -0.03), (0.13, -0.06), (0.2, -0.01), (0.4, 0.0)), 0.02, PackSide.OPEN),
        (((0.09, -0.05), (0.13, -0.12), (0.2, -0.05), (0.4, -0.05)), 0.1, PackSide.OPEN),
        (((0.09, -0.04), (0.12, -0.07), (0.15, -0.04), (0.19, -0.12), (0.25, 0.0), (0.4, 0.0)), 0.1,
         PackSide.OPEN),
        (((0.09, -0.03), (0.26, -0.12), (0.33, 0.0), (0.4, 0.0)), 0.1, PackSide.OPEN),
        (((0.09, -0.05), (0.13, -0.12), (0.2, 0.35), (0.4, 0.35)), 0.1, PackSide.SEEN),
        (((0.09, -0.05), (0.13, -0.1), (0.2, 0.06), (0.4, 0.06)), 0.095, PackSide.COVERED),
    ],
    ids=[
        "deeper than a bar", "no deeper than a bar", "bars of unknown thickness", "thin bars, shallow",
        "one side is low", "a low bar before it", "too far from the straps", "a wall beside a steep flank",
        "a higher neighbour over a shallow flank",
    ],
)  # fmt: skip
def test_a_gully_deeper_than_one_pack_leaves_parts_two_whatever_their_straps(
    right: tuple[tuple[float, float], ...], thick_m: float, side: PackSide
) -> None:
    """All straps lie in line."""
    pack = pack_beside(level_of(*LEFT, *right), ROWS, 0.35, thick_m)
    assert pack.sides == (PackSide.SEEN, side)


def test_no_drawn_pack_has_a_gully_that_parts_two() -> None:
    rng = np.random.default_rng(17)
    for _ in range(60):
        diameter = float(rng.choice([0.016, 0.032, 0.06, 0.1]))
        cross, radius = packed(int(rng.integers(3, 40)), diameter, rng), diameter / 2
        u = np.arange(cross[:, 0].min() - radius, cross[:, 0].max() + radius, 0.002)
        under = np.maximum(radius**2 - (u[:, None] - cross[:, 0]) ** 2, 0.0)
        level = np.where(under > 0, cross[:, 1] + np.sqrt(under), cross[:, 1].min()).max(axis=1)
        crest = int(level.argmax())
        for outwards in (level[crest:], level[crest::-1]):
            assert _parting(outwards, len(outwards), level[crest], max(1.2 * diameter, 0.06)) is None


def test_a_hexagon_on_its_corner_is_no_triangle() -> None:
    """Four of 22 free bundles of `yard_dev` were no longer told as free."""
    radius = 0.045
    turn = np.pi / 3 * np.arange(6) + np.pi / 6
    own = np.vstack([[0.0, 0.0], 2 * radius * np.stack([np.cos(turn), np.sin(turn)], axis=1)])
    width = 2 * radius * (1 + math.sqrt(3))
    bars = np.vstack([own, own + np.array([width, 0.0])])
    u = np.arange(-0.12, 0.4, CELL)
    under = radius**2 - (u[:, None] - bars[:, 0]) ** 2
    level = np.where(under > 0, bars[:, 1] + np.sqrt(np.maximum(under, 0.0)), -np.inf).max(axis=1)
    at = int(np.searchsorted(u, 0.04))
    last = int(np.argmin(level[at : at + 10]))
    assert not ends_over_lower_bar(level[at:], level[at::-1], last, 3 * radius, width, CELL)


@pytest.mark.parametrize(("leans_rad", "over"), [(-0.1, False), (0.7, True)], ids=["beside", "over"])
def test_a_lower_bar_may_rest_on_the_flank_of_an_upright_triangle(leans_rad: float, *, over: bool) -> None:
    """Three bars of 90 mm, and one that touches the lower right one."""
    radius = 0.045
    bars = radius * np.array([[-1, 0], [1, 0], [0, math.sqrt(3)], [1 + 2 * math.cos(leans_rad), 0]])
    bars[3, 1] = 2 * radius * math.sin(leans_rad)
    u = np.arange(-0.12, 0.3, CELL)
    under = radius**2 - (u[:, None] - bars[:, 0]) ** 2
    level = np.where(under > 0, bars[:, 1] + np.sqrt(np.maximum(under, 0.0)), -np.inf).max(axis=1)
    at = int(np.searchsorted(u, 0.04))
    last = int(np.argmin(level[at : at + 7]))
    assert ends_over_lower_bar(level[at:], level[at::-1], last, bars[2, 1] + radius, 0.17, CELL) is over


@pytest.mark.parametrize(("rows", "side"), [(OTHER_ROWS, PackSide.SEEN), (ROWS, PackSide.OPEN)])
def test_straps_of_the_layer_below_end_no_pack(rows: tuple[tuple[float, float], ...], side: PackSide) -> None:
    """Those that lie in line with its own may hold its own lower bars."""
    below = (0.09, -0.05), (0.11, -0.07), (0.12, -0.23), (0.4, -0.3)
    assert pack_beside(level_of(*LEFT, *below), rows, 0.1).sides == (PackSide.SEEN, side)


def test_a_low_bar_at_the_flank_is_still_the_bundle_s() -> None:
    low_bar = (0.04, -0.05), (0.09, -0.13), (0.1, -0.16), (0.15, -0.17), (0.16, -1.0), (0.4, -1.0)
    pack = pack_beside(level_of(*LEFT, *low_bar), ROWS, 0.35)
    assert pack.sides_seen and 0.1 < pack.high_m < 0.17


@pytest.mark.parametrize(
    ("right", "rows", "side"),
    [
        (((0.09, -0.04), (0.11, -0.05), (0.15, 0.0), (0.4, 0.0)), ROWS, PackSide.OPEN),
        (((0.09, -0.04), (0.11, -0.07), (0.15, 0.0), (0.4, 0.0)), straight(0.53, 2.03, 3.53), PackSide.SEEN),
        (((0.09, -0.04), (0.11, -0.05), (0.15, 0.0), (0.4, 0.0)), straight(0.5, 2.3, 3.9), PackSide.OPEN),
        (((0.09, -0.04), (0.11, -0.07), (0.15, 0.0), (0.4, 0.0)), straight(0.5, 2.05, 3.5), PackSide.OPEN),
        (((0.09, -0.04), (0.11, -0.05), (0.15, 0.06), (0.4, 0.06)), OTHER_ROWS, PackSide.COVERED),
        (((0.09, -0.06), (0.11, -0.12), (0.15, 0.06), (0.4, 0.06)), OTHER_ROWS, PackSide.SEEN),
        (((0.09, -0.04), (0.11, -0.05), (0.4, -0.12)), OTHER_ROWS, PackSide.OPEN),
        (((0.09, -0.04), (0.1, -0.09), (0.13, -0.06), (0.14, 0.3), (0.4, 0.3)), OTHER_ROWS, PackSide.SEEN),
    ],
    ids=[
        "straps in line", "straps beside each other", "one of three in line", "two of three in line",
        "a higher neighbour", "a higher neighbour beside a deep flank",
        "one round surface", "a wall beyond something lower",
    ],
)  # fmt: skip
def test_the_side_where_other_straps_begin(
    right: tuple[tuple[float, float], ...], rows: tuple[tuple[float, float], ...], side: PackSide
) -> None:
    pack = pack_beside(level_of(*LEFT, *right), rows, 0.12)
    assert pack.sides == (PackSide.SEEN, side)
    if side != PackSide.OPEN:
        assert pack.high_m == pytest.approx(0.11, abs=1.1 * CELL)


@pytest.mark.parametrize("rows", [OTHER_ROWS, straight(0.5, 2.05, 3.5), ROWS])
def test_what_stands_higher_may_lie_over_a_pack_whether_or_not_its_straps_are_in_line(
    rows: tuple[tuple[float, float], ...],
) -> None:
    right = (0.09, -0.05), (0.13, -0.08), (0.2, 0.05), (0.4, 0.05)
    pack = pack_beside(level_of(*LEFT, *right), rows, 0.21)
    assert pack.sides == (PackSide.SEEN, PackSide.COVERED)


def test_a_smeared_flank_ends_where_a_pack_is_widest() -> None:
    smeared = (0.08, -0.03), (0.1, -0.12), (0.2, -0.4), (0.21, -1.0), (0.4, -1.0)
    pack = pack_beside(level_of(*LEFT, *smeared), ROWS, 0.35)
    assert pack.sides_seen and pack.high_m == pytest.approx(0.1, abs=1.1 * CELL)


def test_a_smeared_gully_ends_a_pack_where_it_is_widest() -> None:
    """Bundles 125 mm wide were told as 190 to 200 mm where matching filled the gullies between them."""
    gully = (0.08, -0.03), (0.1, -0.1), (0.13, -0.145), (0.16, -0.1), (0.18, -0.03), (0.4, 0.0)
    pack = pack_beside(level_of(*LEFT, *gully), OTHER_ROWS, 0.19)
    assert pack.sides_seen and pack.high_m == pytest.approx(0.115, abs=0.6 * CELL)


@pytest.mark.parametrize(
    ("falls", "last"),
    [((0.3,), 0), ((0.0, 0.05, 0.3), 1), ((0.0, 0.05), 1), ((0.0, 0.12, 0.123, 0.126), 3)],
)
def test_the_last_place_of_a_flank_that_falls_away(falls: tuple[float, ...], last: int) -> None:
    assert _widest(-np.array(falls), -0.1, CELL) == last


def test_what_lies_over_a_pack_leaves_its_section_open() -> None:
    """The low pack goes on under the high one, whose flank rises beside it: one is free, one in doubt."""
    rng = np.random.default_rng(4)
    heights = drawn([(-0.25, 0.0, (-1.5, 0.1, 1.6)), (0.0, 0.26, (-1.1, 0.6, 2.0))], rng)
    x = heights.x0_m + CELL * np.arange(heights.shape[1])
    low = np.where(x < -0.25, 0.0, 0.2 - 0.09 * ((x + 0.08) / 0.17) ** 2)
    z = np.where(x < 0, low + np.random.default_rng(5).normal(0, 0.001, heights.shape), heights.z_m)
    found = find_bundles(replace(heights, z_m=z.astype(np.float32)), BundleSettings())
    (lower,) = (b for b in found if abs(b.centre_m[0] + 0.125) < 0.05)
    (upper,) = (b for b in found if abs(b.centre_m[0] - 0.13) < 0.05)
    assert upper.on_top and upper.width_m == pytest.approx(0.26, abs=0.04)
    assert not lower.is_free and DoubtKind.HIDDEN_FLANK in {doubt.kind for doubt in lower.cover_doubts}
    assert lower.bars is None and not np.isfinite(lower.section_m2)
    assert lower.sigma.width_m > 0.4 * lower.width_m


@pytest.mark.parametrize("side", [PackSide.COVERED, PackSide.SEEN])
def test_a_covered_side_is_a_doubt_that_forbids_the_lift(side: PackSide) -> None:
    span = StrapSpan(-0.1, 0.1, straight(1.0, 2.0), 0.0)
    pack = Pack(-0.12, 0.12, span, (-np.inf, np.inf), 0.1, (side, PackSide.SEEN))
    bundle = _covered(record(laid(0.0)), pack)
    assert bundle.is_free == (side == PackSide.SEEN) and (bundle.bars is None) == bool(bundle.cover_doubts)


@pytest.mark.parametrize(
    ("straps_m", "seen", "may"),
    [
        (0.16, None, False),
        (0.07, None, True),
        (0.07, SeenSection(0.16, 0.0, sides_seen=True, sides_free=False), False),
        (0.07, SeenSection(0.21, 0.0, sides_seen=True, sides_free=False), True),
        (0.07, SeenSection(0.16, 0.0, sides_seen=False, sides_free=False), True),
    ],
)
def test_straps_on_the_crest_alone_bound_no_section(
    straps_m: float, seen: SeenSection | None, may: bool
) -> None:
    """Six bars of 80 mm, three on the ground, were told as half their mass by straps on the top bar."""
    span = StrapSpan(-straps_m / 2, straps_m / 2, straight(1.0, 2.0), 0.0)
    pack = Pack(-0.08, 0.08, span, (-np.inf, np.inf), 0.1, (PackSide.SEEN, PackSide.SEEN))
    assert _may_go_on(pack, seen) == may


def test_the_way_between_dark_lines_is_a_bar_s_diameter() -> None:
    places = 0.002 * np.arange(-65, 66)
    arches = np.log(60 + 60 * np.cos(np.pi * ((places + 0.03) / 0.06 % 1 - 0.5)))
    noise = np.random.default_rng(0).normal(0, 0.03, places.size)
    lines = dark_lines(ShadeProfile(places, arches + noise))
    assert np.diff(lines) == pytest.approx(0.06, abs=0.006) and lines.size >= 3
    assert dark_lines(ShadeProfile(places, 4 + noise)).size == 0


def test_an_outline_that_reaches_into_a_pack_is_cut_and_doubtful() -> None:
    pack, other = record(laid(0.0)), record(laid(0.22), 1)
    reach = (pack.width_m + other.width_m) / 2 - 0.22
    kept, cut = hold_off([pack, other], [True, False])
    assert kept is pack and cut.confidence < 0.5 and cut.bars is None
    assert cut.width_m == pytest.approx(other.width_m - reach)
    assert cut.centre_m[0] - cut.width_m / 2 == pytest.approx(pack.width_m / 2)
    higher = record(laid(0.22, 0.2 + pack.width_m), 1)
    assert hold_off([pack, higher], [True, False])[1] is higher


@pytest.mark.parametrize("bridged", [1, 3, 9])
def test_longest_runs_are_those_of_a_closing(bridged: int) -> None:
    rng = np.random.default_rng(bridged)
    lines = rng.random((200, 60)) < rng.random((200, 1))
    lines[:5] = False
    for own, found in zip(lines, longest_runs(lines, bridged), strict=True):
        closed = ndimage.binary_closing(np.pad(own, bridged), np.ones(bridged, bool))[bridged:-bridged]
        runs, count = ndimage.label(closed)
        if not count:
            assert found.tolist() == [0, 0]
            continue
        longest = np.flatnonzero(runs == 1 + int(np.bincount(runs)[1:].argmax()))
        assert found.tolist() == [longest[0], longest[-1] + 1]


@pytest.mark.parametrize("is_faint", [False, True])
def test_the_best_stretches_are_those_of_plain_sums(is_faint: bool) -> None:
    """Stretches over rows with lines that lie elsewhere left and right, a gully and a cliff."""
    rng = np.random.default_rng(7)
    rows, places, narrowest = 40, 50, 5
    values = rng.normal(0, 0.3, (rows, places))
    values[5, :30] += 2.0
    values[25, :30] += 2.0
    values[15, 32:] += 2.0
    sums = np.concatenate([np.zeros((1, rows)), np.cumsum(values, axis=1).T])
    spread = np.concatenate([[0.0], np.cumsum(rng.uniform(0.3, 0.5, places))])
    spread = spread if is_faint else np.arange(places + 1.0)
    prices = np.where(np.arange(places + 1) % 10 == 0, 5.0, 15.0)
    cliffs = np.arange(places) == 41

    def gained(first: int, last: int) -> float:
        own, wide = sums[last] - sums[first], spread[last] - spread[first]
        np.testing.assert_allclose(
            row_gains(sums[first], sums[last], wide, is_faint),
            np.maximum(own**2 / wide - 16, 0) / 2 if is_faint else np.where(own > 0.6 * wide, own, 0),
        )
        return float(row_gains(sums[first], sums[last], wide, is_faint).sum())

    best, before = [0.0], [0]
    for last in range(1, places + 1):
        begin = max([k + 1 for k in np.flatnonzero(cliffs) if k < last - 1], default=0)
        totals = [
            best[first] + (gained(first, last) if last - first >= narrowest else 0.0) - prices[last]
            for first in range(begin, last)
        ]
        before.append(begin + int(np.argmax(totals)))
        best.append(max(totals))
    found = _best_stretches(sums, spread, prices, narrowest, cliffs, is_faint)
    assert found.tolist() == before
    assert found[30] == 0 and found[places] in (30, 32, 42)
