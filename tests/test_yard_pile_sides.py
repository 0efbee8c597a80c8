"""The pile's sides: slope, lean and overhang per layer, with sigmas that hold."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from barsight.core.records.heights import HeightSource
from barsight.yard.magnet.footprint import Placement
from barsight.yard.stability.pile_sides import pile_sides
from barsight.yard.stability.stability import footings
from barsight.yard.types import Bundle
from lift_yards import SETTINGS, SIGMA, codes, judged, laid, map_of, record

RISE, STEP = 0.36, 0.08
LEAN = math.degrees(math.atan2(2 * STEP, 2 * RISE))
STOCK = [laid(0.3 + STEP * layer + 0.3 * k, z=0.2 + RISE * layer) for layer in range(3) for k in range(3)]
APART = laid(3.0)
BUNDLES = (*(record(one, k, layer=k // 3) for k, one in enumerate(STOCK)), record(APART, 9))
STANDING = footings(map_of([*STOCK, APART]), BUNDLES, SETTINGS)


def test_a_side_that_steps_back_says_how_far_and_one_that_is_hidden_says_nothing() -> None:
    low, high, *others = pile_sides(BUNDLES, STANDING)
    assert (low.side, high.side) == (-1, 1)
    # On the high side every layer stands over the one below: from above only the highest shows.
    assert (low.bundles, high.bundles) == ((0, 3, 6), (8,))
    assert low.lean_deg == pytest.approx(-LEAN) and math.isnan(high.lean_deg)
    assert [o.overhang_m for o in low.overhangs][1:] == pytest.approx([-STEP, -STEP])
    assert math.isnan(low.overhangs[0].overhang_m) and math.isnan(high.overhangs[0].overhang_m)
    assert high.drop_m == pytest.approx(STOCK[8].top_z_m, abs=0.02)
    assert low.slope_deg < 85 < high.slope_deg
    assert [side.bundles for side in others] == [(9,), (9,)]


def test_a_gully_within_the_pile_is_none_of_its_sides() -> None:
    stock = [laid(0.0, z=0.56), laid(0.4), laid(0.8, z=0.56)]
    bundles = tuple(record(one, k, layer=int(one.z_m > 0.5)) for k, one in enumerate(stock))
    low, high = pile_sides(bundles, footings(map_of(stock), bundles, SETTINGS))
    assert (low.bundles, high.bundles) == ((0,), (2,))


def test_a_bundle_over_the_edge_stands_over_and_leans() -> None:
    stock = [laid(0.0), laid(0.1, z=0.56)]
    bundles = tuple(record(one, k, layer=k) for k, one in enumerate(stock))
    low, high = pile_sides(bundles, footings(map_of(stock), bundles, SETTINGS))
    assert high.bundles == (1,) and low.bundles == (0, 1)
    assert high.overhangs[0].overhang_m == pytest.approx(0.1, abs=0.02) and high.lean_deg > 5
    assert low.overhangs[1].overhang_m == pytest.approx(-0.1, abs=0.001) and low.lean_deg < -5


def test_a_bundle_beside_its_neighbour_isnt_told_to_stand_over_the_gully_between() -> None:
    """Bundles within a layer "overhung" and "leaned" beside a gully that the map missed."""
    stock = [laid(0.0), laid(0.3), laid(0.6), laid(0.04, z=0.56), laid(0.34, z=0.56)]
    bundles = tuple(record(one, k, layer=int(one.z_m > 0.5)) for k, one in enumerate(stock))
    heights = map_of(stock)
    gully = (heights.x_m > 0.165) & (heights.x_m < 0.215)
    heights.z_m[:, gully], heights.source[:, gully] = np.nan, HeightSource.UNKNOWN
    *_, left, right = footings(heights, bundles, SETTINGS)
    assert left.overhang_side == right.overhang_side == 0 and left.lean_deg == 0


@pytest.mark.parametrize("aisle_m", [0.25, 0.8])
def test_a_bundle_over_the_edge_stands_over_beside_an_aisle_whose_floor_isnt_seen(aisle_m: float) -> None:
    edge = 0.1 + laid(0.0).width_m / 2
    beyond = edge + aisle_m + laid(0.0).width_m / 2
    stock = [laid(0.0), laid(beyond), laid(beyond, z=0.56), laid(0.1, z=0.56)]
    bundles = tuple(record(one, k, layer=int(one.z_m > 0.5)) for k, one in enumerate(stock))
    heights = map_of(stock)
    aisle = (heights.x_m > edge - 0.01) & (heights.x_m < edge + aisle_m + 0.01)
    heights.z_m[:, aisle], heights.source[:, aisle] = np.nan, HeightSource.UNKNOWN
    over = footings(heights, bundles, SETTINGS)[-1]
    assert over.overhang_side == 1 and over.overhang_m == pytest.approx(0.1, abs=0.02)


def test_the_bundle_that_one_over_its_edge_rests_on_without_dunnage_is_none_beside_it() -> None:
    stock = [laid(0.0), laid(0.13, z=laid(0.0).z_m + 0.26)]
    bundles = tuple(record(one, k, layer=k) for k, one in enumerate(stock))
    over = footings(map_of(stock), bundles, SETTINGS)[-1]
    assert over.overhang_side == 1 and over.overhang_m == pytest.approx(0.13, abs=0.02)


def test_the_stated_sigmas_hold() -> None:
    rng = np.random.default_rng(5)

    def seen(bundle: Bundle) -> Bundle:
        moved = bundle.centre_m + np.array([rng.normal(0, SIGMA.lateral_m), 0, 0])
        return replace(bundle, centre_m=moved, width_m=bundle.width_m + rng.normal(0, SIGMA.width_m))

    scores = []
    for _ in range(300):
        low = pile_sides(tuple(seen(b) for b in BUNDLES), STANDING)[0]
        scores.append([(low.lean_deg + LEAN) / low.lean_sigma_deg])
        scores[-1] += [(o.overhang_m + STEP) / o.sigma_m for o in low.overhangs[1:]]
    assert np.std(scores, axis=0) == pytest.approx(np.ones(3), abs=0.15)


def test_bundles_across_are_a_pile_of_their_own() -> None:
    across = record(laid(0.6, z=1.3, yaw_deg=88.0, length_m=1.5), 10, layer=3)
    bundles = (*BUNDLES, across)
    sides = pile_sides(bundles, footings(map_of(STOCK), bundles, SETTINGS))
    assert sum(side.bundles == (10,) for side in sides) == 2 and len(sides) == 6
    assert pile_sides((), ()) == ()


@pytest.mark.parametrize("gap_m", [0.06, 0.1])
@pytest.mark.parametrize(("shown", "told"), [("gap", True), ("free", True), ("carried on", False)])
def test_a_support_that_may_end_in_an_unseen_gap_forbids(gap_m: float, *, shown: str, told: bool) -> None:
    """A bundle stands 130 mm beside the one below, with a neighbour of its layer beyond the gap: that the gap
    is free down to half its height doesn't tell whether what carries it ends there.
    """
    width = laid(0.0).width_m
    above = [laid(x, z=0.28 + width) for x in (0.13, 0.13 + width + gap_m)]
    below = [laid(x) for x in (0.0, 0.13 + width + gap_m)]
    heights = map_of([*above, *below], x_m=(-1.5, 2.5))
    at = np.abs(heights.x_m - 0.13 - (width + gap_m) / 2) < gap_m / 2
    free = np.full(heights.shape, np.inf, np.float32)
    if shown == "carried on":
        heights.z_m[:, at] = above[0].top_z_m - 1.2 * width
    elif shown == "free":
        heights.z_m[:, at], heights.source[:, at] = np.nan, HeightSource.UNKNOWN
        free[:, at] = above[0].top_z_m - 0.12
    heights = replace(heights, free_m=free)
    bundles = tuple(record(one, k, layer=int(k < 2), on_top=k < 2) for k, one in enumerate((*above, *below)))
    assert (
        "overhanging" in codes(judged(above, bundles, Placement(0.13, 0.0, 0.0), heights=heights))
    ) == told
