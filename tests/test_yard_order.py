"""The order that digs a bundle out: which lift uncovers which, and how high a load travels."""

from __future__ import annotations

import json
from dataclasses import replace

import jsonschema
import numpy as np
import pytest

from barsight.core.errors import Failed
from barsight.core.records.heights import HeightSource
from barsight.core.stamps import NS_PER_S
from barsight.yard.events import YardEvent
from barsight.yard.lift_settings import LiftSettings
from barsight.yard.lifting.ground import Ground
from barsight.yard.lifting.lift_file import lifts_content
from barsight.yard.lifting.order import LiftOrder, begin_order, order_lifts, travel_height
from barsight.yard.lifting.set_down import SetDown
from barsight.yard.lifting.targets import plan_lifts
from barsight.yard.lifting.travel_accuracy import Travel
from barsight.yard.placement.load import Load
from barsight.yard.stability.blockers import find_blocked
from barsight.yard.stability.stability import footing_checks, footings
from barsight.yard.types import Bundle, HeightMap
from barsight.yard.vetoes import Veto, vetoes_of
from lift_yards import GIVEN, LENGTH_M, MAGNET, SETTINGS, SIGMA, laid, map_of, record, sure_travel
from yard_folders import schema
from yard_maps import Laid

STOCK = [laid(0.3), laid(0.6), laid(0.9), laid(0.45, z=0.56), laid(0.75, z=0.56), laid(0.6, z=0.92)]
"""A pile of three layers: 5 lies on 3 and 4, which lie on 0, 1 and 2."""


def pile(settings: LiftSettings = SETTINGS, x_m: float = 6.0) -> tuple[HeightMap, tuple[Bundle, ...]]:
    on_top = (False, False, False, False, False, True)
    layers = (0, 0, 0, 1, 1, 2)
    bundles = tuple(
        record(one, k, layer=layers[k], on_top=on_top[k], ends_sigma_m=(0.02, 0.02))
        for k, one in enumerate(STOCK)
    )
    return map_of(STOCK, x_m=(-1.5, x_m), y_m=(-5.0, 5.0)), bundles


def fetch(bundle: int, settings: LiftSettings = SETTINGS) -> LiftOrder | Failed:
    heights, bundles = pile()
    return order_lifts(bundle, heights, bundles, plan_lifts(heights, bundles, MAGNET, settings, ()))


def test_what_lies_on_leans_or_rests_against_a_bundle_must_go_first() -> None:
    heights, bundles = pile()
    blocked = find_blocked(bundles, footings(heights, bundles, SETTINGS), SETTINGS)
    assert [set(each.blockers) for each in blocked] == [{3}, {3, 4, 5}, {4}, {5}, {5}, set()]
    across = record(laid(0.6, z=1.3, yaw_deg=90.0, length_m=2.0), 6)
    all_of = (*bundles, across)
    blocked = find_blocked(all_of, footings(heights, all_of, SETTINGS), SETTINGS)
    assert 6 in blocked[5].blockers and blocked[6].blockers == ()


def test_the_order_takes_what_is_above_first_and_offers_only_the_first() -> None:
    order = fetch(1)
    assert isinstance(order, LiftOrder)
    assert [step.bundle for step in order.steps] == [5, 3, 4, 1] or [s.bundle for s in order.steps] == [
        5,
        4,
        3,
        1,
    ]
    assert [step.is_offered for step in order.steps] == [True, False, False, False]
    places = [step.set_down for step in order.steps]
    for k, one in enumerate(places):
        assert one.z_m < 0.02, "on the floor beside the pile"
        assert min(abs(one.x_m - other.x_m) for other in STOCK) > 0.27 + SETTINGS.set_down_clear_m
        assert all(abs(one.x_m - other.x_m) > 0.27 + SETTINGS.set_down_clear_m for other in places[:k])
    top = STOCK[5].top_z_m
    for step in order.steps:
        assert step.travel_z_m == pytest.approx(top + SETTINGS.travel_clear_m, abs=0.02)


def test_the_offered_lift_that_begins_an_order_is_put_where_the_order_has_it() -> None:
    """Left alone it is put on the lowest nearest place, which may be beside what is dug out."""
    heights, bundles = pile()
    plan = plan_lifts(heights, bundles, MAGNET, SETTINGS, ())
    order = order_lifts(1, heights, bundles, plan)
    assert isinstance(order, LiftOrder)
    (lift,) = begin_order(order, plan, bundles, heights).offered
    assert lift.bundles == (5,) and lift.set_down == order.steps[0].set_down
    assert lift.magnet_down is not None
    away = np.array([lift.magnet_down.x_m - lift.place.x_m, lift.magnet_down.y_m - lift.place.y_m])
    moved = np.array([lift.set_down.x_m, lift.set_down.y_m]) - bundles[5].centre_m[:2]
    assert away == pytest.approx(moved, abs=1e-6), "magnet and load go the same way"


def test_what_cannot_be_dug_out_says_why() -> None:
    missing = fetch(9)
    assert isinstance(missing, Failed) and "no bundle 9" in missing.reason
    heights, bundles = pile()
    plan = plan_lifts(heights, bundles, MAGNET, SETTINGS, (Veto("one-view", "one frame"),))
    refused = order_lifts(1, heights, bundles, plan)
    assert isinstance(refused, Failed) and "one frame" in refused.reason
    weak = plan_lifts(heights, bundles, replace(MAGNET, capacity_kg=1000.0), SETTINGS, ())
    refused = order_lifts(1, heights, bundles, weak)
    assert isinstance(refused, Failed) and "(5)" in refused.reason
    doubted = (*bundles[:5], replace(bundles[5], on_top=None))
    plan = plan_lifts(heights, doubted, MAGNET, SETTINGS, ())
    refused = order_lifts(1, heights, doubted, plan)
    assert isinstance(refused, Failed) and "what lies on bundle 5" in refused.reason
    heights, bundles = pile(x_m=1.4)
    refused = order_lifts(1, heights, bundles, plan_lifts(heights, bundles, MAGNET, SETTINGS, ()))
    assert isinstance(refused, Failed) and "no place" in refused.reason


def test_no_load_travels_over_what_was_not_seen_or_below_what_may_stand_there() -> None:
    heights, bundles = pile()
    spot = (
        (np.abs(heights.y_m - LENGTH_M / 2 - 0.3) < 0.15)[:, None] & (heights.x_m < 0.5) & (heights.x_m > 0.2)
    )
    heights.source[spot] = HeightSource.UNKNOWN
    plan = plan_lifts(heights, bundles, MAGNET, SETTINGS, ())
    refused = order_lifts(5, heights, bundles, plan)
    assert isinstance(refused, Failed) and "not seen" in refused.reason
    told = replace(plan, settings=LiftSettings(max_stack_m=3.0))
    order = order_lifts(5, heights, bundles, told)
    assert isinstance(order, LiftOrder) and order.steps[0].travel_z_m == pytest.approx(3.5)
    free = np.full(heights.shape, 1.7, np.float32)
    order = order_lifts(5, replace(heights, free_m=free), bundles, plan)
    assert isinstance(order, LiftOrder) and order.steps[0].travel_z_m == pytest.approx(2.2)


def test_no_load_travels_below_a_stanchion_that_the_map_does_not_show() -> None:
    heights, bundles = pile()
    settings = replace(SETTINGS, stanchions=((0.1, LENGTH_M / 2 + 0.3, 3.0), (4.0, 0.0, 5.0)))
    order = order_lifts(5, heights, bundles, plan_lifts(heights, bundles, MAGNET, settings, ()))
    assert isinstance(order, LiftOrder) and order.steps[0].travel_z_m == pytest.approx(3.5)


def test_a_magnet_that_is_longer_than_its_load_travels_over_what_stands_too() -> None:
    """The load of 4 m and its swing end at 2.5 m, the beam of 5.4 m that holds it may come to 3.5 m."""
    stock = [laid(0.3, length_m=4.0)]
    load = Load.of((record(stock[0]),))
    place = SetDown(2.0, 0.0, 0.0, 0.0, 0.0, 0.0, 4.0, 2.0, 0.1)
    for y_m, height_m in ((2.8, 3.0), (3.7, 0.0)):
        heights = map_of(stock, x_m=(-3.0, 5.0), y_m=(-5.0, 5.0))
        near = np.abs(heights.y_m - y_m) < 0.1
        heights.z_m[near] = 3.0
        found = travel_height(Ground.of(heights), load, place, MAGNET, SETTINGS)
        highest = max(height_m, stock[0].top_z_m)
        assert found == pytest.approx(highest + SETTINGS.travel_clear_m, abs=0.02)


def test_lifts_json_says_the_order_and_what_is_in_the_way() -> None:
    heights, bundles = pile()
    plan = plan_lifts(heights, bundles, MAGNET, SETTINGS, ())
    order = order_lifts(3, heights, bundles, plan)
    assert isinstance(order, LiftOrder)
    content = json.loads(json.dumps(lifts_content(plan, "yard", GIVEN, "0", order=order)))
    jsonschema.validate(content | {"content_sha256": ""}, schema("lifts"))
    assert [step["bundle"] for step in content["fetch"]["steps"]] == [5, 3]
    assert content["blocked"][1] == {"bundle": 1, "blockers": [3, 4, 5]}
    assert content["lifts"][0]["set_down"]["z_m"] < 0.02
    assert lifts_content(plan, "yard", GIVEN, "0")["fetch"] is None


def test_a_bundle_nested_against_another_vetoes_it() -> None:
    low = record(laid(0.3), 0, neighbours=(1,))
    high = record(laid(0.3 + 0.235, z=0.335), 1, neighbours=(0,))
    stock = [laid(0.3), laid(0.535, z=0.335)]
    standing = footings(map_of(stock), (low, high), SETTINGS)
    codes = {veto.code for veto in vetoes_of(footing_checks(low, (low, high), standing, SETTINGS))}
    assert codes == {"unstable-side"}
    level = replace(high, centre_m=np.array([0.3 + 0.28, 0.0, 0.2]), top_z_m=low.top_z_m, sigma=SIGMA)
    assert "unstable-side" not in {
        veto.code for veto in vetoes_of(footing_checks(low, (low, level), standing, SETTINGS))
    }


def test_the_pile_is_laid_as_told() -> None:
    assert isinstance(STOCK[0], Laid) and STOCK[5].z_m > STOCK[3].top_z_m


def test_nothing_is_set_down_or_carried_over_where_something_happened_since() -> None:
    heights, bundles = pile()
    plan = plan_lifts(heights, bundles, MAGNET, SETTINGS, ())
    place = plan.offered[0].set_down
    assert place is not None
    event = YardEvent(1, "set-down", place.x_m, place.y_m, place.yaw_deg, LENGTH_M, 0.3)
    wary = replace(SETTINGS, disturbed_reach_m=0.3)
    since = plan_lifts(heights, bundles, MAGNET, wary, (), events=(event,))
    moved = since.offered[0].set_down
    assert moved is not None and abs(moved.x_m - place.x_m) > 0.3 + 0.3
    refused = order_lifts(5, heights, bundles, since)
    assert isinstance(refused, Failed) and "not seen" in refused.reason


@pytest.mark.parametrize("several", [False, True])
def test_nothing_is_set_down_or_carried_over_where_nobody_looked_for_too_long(several: bool) -> None:
    """The pile was seen a minute ago, the free floor an hour ago, by this pass or by an earlier one."""
    heights, bundles = pile()
    heights.source[:, heights.x_m < -0.1] = HeightSource.UNKNOWN
    now_ns = 10_000 * NS_PER_S
    spots = np.array([(x, y) for x in (0.0, 5.0) for y in (-3.0, 0.0, 3.0)])
    hour, minute = now_ns - 3600 * NS_PER_S, now_ns - 60 * NS_PER_S
    if several:
        newest = np.where(heights.x_m > 1.5, 1, 2).astype(np.uint8)
        heights = replace(heights, passes=np.tile(newest, (heights.shape[0], 1)))
        ways = [sure_travel(spots, first + np.arange(6)) for first in (hour, minute)]
        seen = Travel.joined(ways)
    else:
        seen = sure_travel(spots[::-1], np.r_[hour + np.arange(3), minute + np.arange(3)])
        seen = replace(seen, sure_reach_m=1.8)
    heights = replace(heights, tops=np.full(heights.shape, 90, np.uint8))
    plan = plan_lifts(heights, bundles, MAGNET, SETTINGS, (), seen, now_ns)
    (lift,) = plan.offered
    assert lift.bundles == (5,) and lift.set_down is None
    refused = order_lifts(5, heights, bundles, plan)
    assert isinstance(refused, Failed) and refused.code == "no-set-down"
    late = replace(seen, stamp_ns=minute + np.arange(len(seen.stamp_ns)))
    (lift,) = plan_lifts(heights, bundles, MAGNET, SETTINGS, (), late, now_ns).offered
    assert lift.set_down is not None and lift.set_down.x_m > 1.2


def test_a_lift_ends_where_the_ground_it_is_put_down_on_grows_old() -> None:
    """The pile was seen 10 s ago, the floor beside it 540 s ago."""
    heights, bundles = pile()
    passes = np.tile(np.where(heights.x_m > 1.5, 1, 2).astype(np.uint8), (heights.shape[0], 1))
    heights = replace(heights, passes=passes, tops=np.full(heights.shape, 90, np.uint8))
    heights.source[:, heights.x_m < -0.1] = HeightSource.UNKNOWN
    now_ns, spots = 10_000 * NS_PER_S, np.array([(x, y) for x in (0.0, 5.0) for y in (-3.0, 0.0, 3.0)])
    old_ns, new_ns = now_ns - 540 * NS_PER_S, now_ns - 10 * NS_PER_S
    travel = Travel.joined([sure_travel(spots, first + np.arange(6)) for first in (old_ns, new_ns)])
    plan = plan_lifts(heights, bundles, MAGNET, SETTINGS, (), travel, now_ns)
    ends = [lift.validity.until_ns for lift in plan.offered if lift.validity and lift.set_down]
    assert ends and max(ends) < old_ns + SETTINGS.max_age_s * NS_PER_S + NS_PER_S
