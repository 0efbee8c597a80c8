"""A magnet's reach is judged by the surface under its faces, not by outlines that lie there."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from barsight.core.records.heights import HeightSource
from barsight.yard.magnet.description import Tolerance
from barsight.yard.magnet.footprint import BundleTable, Grip, Placement, count_gripped
from barsight.yard.magnet.partings import without_parted
from barsight.yard.magnet.reach import reached_strips
from barsight.yard.stability.stability import footings
from lift_yards import MAGNET, SETTINGS, SIGMA, codes, judged, laid, map_of, record
from yard_maps import Laid

EXACT = Tolerance(0.0, 0.0, 0.0)
OVER = Placement(0.3, 0.0, 0.0)
FACES = np.full(4, laid(0.3).top_z_m)


def test_flanks_that_fall_beyond_the_reach_are_left_out() -> None:
    strips = reached_strips(map_of([laid(0.3)], sigma_m=0.0), OVER, MAGNET, MAGNET.tolerance, FACES)
    poles = MAGNET.pole_table
    assert strips[:, :2] == pytest.approx(poles[:, :2], abs=0.012)
    # The crests of the two bars on top are 45 mm from the middle; the crane may miss by 15 mm and more.
    assert (strips[:, 3] > 0.09).all() and (strips[:, 3] < poles[:, 3] + 2 * 0.015 + 0.01).all()
    assert strips[:, 2] == pytest.approx(poles[:, 2] + 2 * 0.03, abs=0.05)


def test_a_surface_that_goes_on_within_reach_is_reached_to_the_tolerance() -> None:
    stock = [laid(0.3), laid(0.48)]
    strips = reached_strips(map_of(stock, sigma_m=0.0), Placement(0.39, 0.0, 0.0), MAGNET, EXACT, FACES)
    assert strips == pytest.approx(MAGNET.pole_table, abs=0.012)
    wide = reached_strips(map_of(stock), Placement(0.39, 0.0, 0.0), MAGNET, Tolerance(0.02, 0, 0), FACES)
    assert wide[:, 3] == pytest.approx(MAGNET.pole_table[:, 3] + 0.04, abs=0.012)


def test_what_was_not_seen_may_be_reached_and_what_lies_deep_is_not() -> None:
    heights = map_of([laid(0.3)], sigma_m=0.0)
    aside = Placement(0.3 + 0.16, 0.0, 0.0)
    assert (reached_strips(heights, aside, MAGNET, EXACT, FACES)[:, 2:] == 0).all()
    unseen = replace(heights, source=np.full_like(heights.source, HeightSource.UNKNOWN))
    assert reached_strips(unseen, aside, MAGNET, EXACT, FACES) == pytest.approx(MAGNET.pole_table, abs=1e-9)


@pytest.mark.parametrize("unseen", [False, True])
def test_a_flank_that_is_none_in_one_place_is_none(*, unseen: bool) -> None:
    heights = map_of([laid(0.3)], sigma_m=0.0)
    x = heights.x0_m + heights.cell_m * np.arange(heights.shape[1])
    y = heights.y0_m + heights.cell_m * np.arange(heights.shape[0])
    beside = np.ix_((y > 0.5) & (y < 0.75), (x > 0.37) & (x < 0.45))
    z, source = heights.z_m.copy(), heights.source.copy()
    z[beside], source[beside] = FACES[0] - 0.03, HeightSource.UNKNOWN if unseen else HeightSource.VISION
    changed = replace(heights, z_m=z, source=source)
    plain, found = (reached_strips(h, OVER, MAGNET, MAGNET.tolerance, FACES) for h in (heights, changed))
    high = found[:, 1] + found[:, 3] / 2 - plain[:, 1] - plain[:, 3] / 2
    assert high[2] > 0.009 and high[[0, 1, 3]] == pytest.approx(0.0, abs=1e-9)


def test_a_neighbour_that_is_hardly_known_counts_only_where_the_poles_may_reach_it() -> None:
    unsure = replace(SIGMA, lateral_m=0.06)
    stock = [laid(0.3), laid(0.66)]
    bundles = (record(stock[0], 0), record(stock[1], 1, sigma=unsure))
    assert "count-uncertain" not in codes(judged(stock, bundles, OVER))
    # Level ground between them within reach: nobody knows where the neighbour begins.
    filled = [*stock, laid(0.48, z=0.19)]
    assert "count-uncertain" in codes(judged(filled, (replace(bundles[0], width_m=0.12), bundles[1]), OVER))


@pytest.mark.parametrize("way", ["seen", "shallow", "unseen", "not all along"])
def test_a_neighbour_behind_a_deep_gully_that_is_seen_is_not_reached(way: str) -> None:
    stock = [laid(0.3), laid(0.6)]
    heights = map_of([*stock, laid(0.45, z=0.17)] if way == "shallow" else stock)
    if way in ("unseen", "not all along"):
        ends = (0.5, 1.2) if way == "not all along" else (-9.0, 9.0)
        hidden = np.ix_((heights.y_m > ends[0]) & (heights.y_m < ends[1]), np.abs(heights.x_m - 0.45) < 0.06)
        source = heights.source.copy()
        source[hidden] = HeightSource.UNKNOWN
        heights = replace(heights, source=source)
    table = BundleTable.of(tuple(record(one, k) for k, one in enumerate(stock)))
    held = Grip((0,), 0.5, np.array([0.0, 0.5]))
    strips = MAGNET.pole_table * (1, 1, 1, 0.8)
    found = without_parted(held, heights, OVER, table, strips)
    assert found.gripped == (0,)
    assert (found.flips[1], found.probability) == ((0.0, 1.0) if way == "seen" else (0.5, 0.5))


def test_what_one_bundle_has_is_not_anothers_beside_it() -> None:
    unsure = replace(SIGMA, lateral_m=0.06, yaw_rad=0.0)
    known = replace(SIGMA, lateral_m=0.02, width_m=0.0, yaw_rad=0.0)
    strips = MAGNET.pole_table * (1, 1, 1, 0.8)
    place = Placement(0.33, 0.0, 0.0)

    def flip(own: float) -> float:
        two = (record(laid(0.3), 0, sigma=known, width_m=own), record(laid(0.62), 1, sigma=unsure))
        return float(count_gripped(place, MAGNET, EXACT, BundleTable.of(two), FACES, strips).flips[1])

    def below(z: float) -> float:
        return 0.5 * math.erfc(-z / math.sqrt(2))

    # Both halves of the beam count: two poles on one side err together.
    narrow, wide = laid(0.3).width_m - 0.03, laid(0.3).width_m
    spread = math.hypot(0.02, 0.001)
    assert flip(wide) == pytest.approx(2 * below(-(wide / 2 - 0.03 - 0.04) / spread), rel=1e-6)
    assert flip(narrow) == pytest.approx(2 * below(-(narrow / 2 - 0.03 - 0.04) / spread), rel=1e-6)
    gap = 0.62 - laid(0.62).width_m / 2 - 0.33 - 0.04
    assert flip(0.12) == pytest.approx(2 * below(-gap / math.hypot(0.06, SIGMA.width_m / 2, 0.001)), rel=1e-6)


@pytest.mark.parametrize(("aside_m", "side"), [(0.005, 0), (0.05, 1)])
def test_edges_that_show_alike_on_both_sides_tell_no_shift(aside_m: float, side: int) -> None:
    stock = [laid(0.0, diameter_m=0.1), laid(aside_m, z=0.58)]
    top = record(stock[1], 0, layer=1)
    (footing,) = footings(map_of(stock), (top,), SETTINGS)
    assert footing.overhang_side == side


def test_what_stands_on_nothing_that_shows_is_not_lifted() -> None:
    """A wall looks like a bundle from above, but falls sheer on both sides."""

    def over_floor(z: float, beside: list[Laid]) -> bool:
        stock = [laid(0.3, z=z), *beside]
        lift = judged(stock, tuple(record(one, k) for k, one in enumerate(stock)))
        return any(
            "nothing that carries it is visible" in veto.reason
            for veto in lift.vetoes
            if veto.code == "unstable-side"
        )

    high = record(laid(0.3)).width_m * 2.5 + 0.3 - laid(0.3).top_z_m + laid(0.3).z_m
    assert not over_floor(high - 0.08, [])
    assert over_floor(high + 0.02, []) and over_floor(1.4, [])
    assert not over_floor(1.4, [laid(0.5, z=1.1)])
