"""Two maps of one yard: what moved, settled, was taken or added, and what chance alone would do."""

from __future__ import annotations

import json
import math
import time
import zlib
from dataclasses import replace

import numpy as np
import pytest

from barsight.yard.inventory.changes import Change, YardChanges, compare_yards, look_at
from barsight.yard.inventory.coarse_map import pack, unpack, unpack_seen
from barsight.yard.inventory.matching import Places, match_bundles, moved_bundles
from barsight.yard.inventory.stock_list import ListedBundle, match_stock
from barsight.yard.types import Bundle, HeightMap
from lift_yards import SIGMA, laid, map_of, record

STOCK = [laid(0.3), laid(0.65), laid(1.0)]


def compared(old: list[Bundle], new: list[Bundle]) -> tuple[Change, ...]:
    heights = map_of(STOCK)
    return compare_yards(tuple(old), heights, tuple(new), heights).changes


def row(first: int, last: int, **changes: float) -> list[Bundle]:
    """Alike bundles 0.35 m apart, as measured."""
    rng = np.random.default_rng(first)
    stock = [laid(0.35 * k + rng.normal(0, SIGMA.lateral_m), **changes) for k in range(first, last)]
    return [record(one, k) for k, one in enumerate(stock)]


def test_moved_settled_taken_and_added_are_told_apart() -> None:
    old = [record(one, k) for k, one in enumerate(STOCK)]
    new = [
        record(replace(STOCK[0], x_m=0.36), 7),
        record(replace(STOCK[1], z_m=0.18), 8),
        record(laid(1.6), 9),
    ]
    changes = compare_yards(tuple(old), map_of(STOCK), tuple(new), map_of([*STOCK[:2], laid(1.6)])).changes
    assert [c.kind for c in changes] == ["moved", "settled", "taken", "added"]
    assert all(c.significant for c in changes)
    assert changes[0].across_mm == pytest.approx(60, abs=1) and changes[0].sigmas[0] == pytest.approx(
        3 * 2**0.5
    )
    assert changes[1].up_mm == pytest.approx(-20, abs=1)
    kg = 7 * math.pi / 4 * 0.09**2 * 7.0 * 7850
    assert changes[2].kg == pytest.approx(-kg) and changes[3].kg == pytest.approx(kg)
    assert changes[3].sigma_kg > 0


@pytest.mark.parametrize(
    ("open_before", "open_after", "moved"),
    [
        ((False, True), (False, True), True),
        ((False, False), (False, True), True),
        ((True, False), (False, True), False),
    ],
    ids=["one-end-twice", "whole-before", "never-the-same-end"],
)
def test_an_end_that_was_seen_twice_tells_a_move_along(
    open_before: tuple[bool, bool], open_after: tuple[bool, bool], moved: bool
) -> None:
    """The bundle lies 0.5 m further along itself, and is cut off at the same place at its high-y end."""
    one = STOCK[0]
    before = record(one, 0, ends_open=open_before)
    cut = record(replace(one, y_m=one.y_m + 0.25, length_m=one.length_m - 0.5), 1, ends_open=open_after)
    assert cut.ends_m[1, 1] == pytest.approx(before.ends_m[1, 1])
    (change,) = compared([before], [cut])
    assert (change.kind == "moved") is moved and moved_bundles([before], [cut]) == [moved]
    assert change.along_mm == pytest.approx(500 if moved else 0, abs=1)


def test_a_bundle_along_x_that_turns_through_the_right_angle_has_not_moved_along() -> None:
    """One end is open; its low end is the other one once its yaw passes 90 deg."""
    before, after = (
        record(replace(STOCK[0], yaw_deg=yaw_deg), k, ends_open=is_open)
        for k, (yaw_deg, is_open) in enumerate(((89.99, (True, False)), (-89.99, (False, True))))
    )
    (change,) = compared([before], [after])
    assert change.kind == "same" and moved_bundles([before], [after]) == [False]
    assert change.along_mm == pytest.approx(0, abs=0.1) and change.sigmas[1] > 0


@pytest.mark.slow
def test_what_errs_as_stated_is_rarely_called_a_change() -> None:
    rng = np.random.default_rng(5)

    def measured(number: int) -> Bundle:
        one = STOCK[0]
        drawn = replace(
            one, x_m=one.x_m + rng.normal(0, SIGMA.lateral_m), y_m=rng.normal(0, SIGMA.along_m),
            yaw_deg=math.degrees(rng.normal(0, SIGMA.yaw_rad)),
        )  # fmt: skip
        return record(drawn, number, top_z_m=one.top_z_m + rng.normal(0, SIGMA.top_z_m))

    kinds = [compared([measured(0)], [measured(1)])[0].kind for _ in range(100)]
    assert kinds.count("same") >= 99


@pytest.mark.parametrize("unknown", ["lateral_m", "along_m", "top_z_m", "yaw_rad"])
def test_a_bundle_whose_sigma_is_not_known_may_have_moved(unknown: str) -> None:
    """It went 0.3 m aside or along, rose by 0.19 m or turned by 2 deg."""
    before = record(laid(0.3))
    moves = {"lateral_m": (0.3, 0.0, 0.2, 0.0), "along_m": (0.0, 0.3, 0.2, 0.0),
             "top_z_m": (0.0, 0.0, 0.39, 0.0), "yaw_rad": (0.0, 0.0, 0.2, 2.0)}  # fmt: skip
    x, y, z, yaw = moves[unknown]
    after = record(laid(0.3 + x, z=z, y_m=y, yaw_deg=yaw), sigma=replace(SIGMA, **{unknown: math.nan}))
    (change,) = compared([before], [after])
    assert change.kind == "moved" and change.significant


def test_what_the_other_map_did_not_see_is_neither_taken_nor_added() -> None:
    seen, dark = map_of(STOCK), map_of(STOCK)
    dark.source[:] = 0
    changes = compare_yards((record(STOCK[0]),), seen, (), dark).changes
    assert [c.kind for c in changes] == ["not-seen"]
    changes = compare_yards((), dark, (record(STOCK[0]),), seen).changes
    assert [c.kind for c in changes] == ["not-seen"]


def test_two_empty_yards_are_the_same() -> None:
    assert compared([], []) == ()


def test_a_bundle_that_the_other_map_shows_but_does_not_name_is_neither_taken_nor_added() -> None:
    one = record(STOCK[0])
    for old, new in (([one], []), ([], [one])):
        assert [c.kind for c in compared(old, new)] == ["not-found"]
    higher = compare_yards((one,), map_of(STOCK), (), map_of([STOCK[0], laid(0.3, z=0.5)]))
    assert [c.kind for c in higher.changes] == ["covered"]


def test_a_row_of_alike_bundles_does_not_move_on_by_one_where_one_end_went_and_one_came() -> None:
    """The most pairs with the least total distance would have each of them moved by 0.35 m."""
    old, new = row(0, 8), row(1, 9)
    wanted = {k + 1: k for k in range(7)}
    assert match_bundles(Places.of(old), Places.of(new), 0.5) == wanted
    listed = tuple(ListedBundle(str(k), 0.35 * k, 0.0) for k in range(8))
    match = match_stock(listed, tuple(new))
    assert [(int(one.name), one.bundle) for one in match.matched] == list(wanted.items())
    assert (match.moved, match.missing, match.extra) == ((), ("0",), (7,))


def test_neighbours_that_differ_in_size_are_told_apart_on_a_rough_list() -> None:
    """Both are listed 0.2 m too far along X, each then nearer to the other."""
    thick, thin = record(laid(0.3), 0), record(replace(laid(0.55), diameter_m=0.05), 1)
    listed = [ListedBundle("thick", 0.5, 0.0, width_m=thick.width_m),
              ListedBundle("thin", 0.75, 0.0, width_m=thin.width_m)]  # fmt: skip
    match = match_stock(tuple(listed), (thick, thin))
    assert [(one.name, one.bundle, one.disagrees) for one in match.matched] == [
        ("thick", 0, ()), ("thin", 1, ()),
    ]  # fmt: skip


def test_a_yard_that_is_shifted_as_a_whole_has_not_moved_and_the_shift_is_told() -> None:
    old = row(0, 12)
    new = [record(laid(0.35 * k + 0.03 + (0.04 if k == 5 else 0.0), z=0.21), k) for k in range(12)]
    heights = map_of(STOCK)
    told: YardChanges = compare_yards(tuple(old), heights, tuple(new), heights)
    assert told.shift_m == pytest.approx([0.03, 0.0, 0.01], abs=0.005)
    assert [k for k, change in enumerate(told.changes) if change.kind != "same"] == [5]


def test_ten_thousand_bundles_are_matched_in_seconds() -> None:
    rng = np.random.default_rng(0)
    one, count = Places.of([record(laid(0.0))]), 10_000
    places = one.take(np.zeros(count, np.int64))
    places.top_m[:, 0], places.top_m[:, 1] = 0.35 * (np.arange(count) // 10), 8.0 * (np.arange(count) % 10)
    order = rng.permutation(count)[: count - 500]
    after = places.take(order)
    after.top_m[:] += rng.normal(0, 0.004, after.top_m.shape)
    began = time.perf_counter()
    pairs = match_bundles(places, after, 0.5)
    assert time.perf_counter() - began < 20
    assert len(pairs) == len(order) and all(order[j] == i for i, j in pairs.items())


def test_a_packed_map_tells_which_places_it_saw_without_reading_their_heights() -> None:
    rng = np.random.default_rng(6)
    heights = map_of([laid(0.3)])
    heights.z_m[rng.random(heights.shape) < 0.4] = np.nan
    heights.source[np.isnan(heights.z_m)] = 0
    packed = pack(heights)
    whole, seen = unpack(packed), unpack_seen(packed)
    findings = []
    for x_m, y_m in rng.uniform((-1.5, -3.0), (1.5, 3.0), (100, 2)):
        one = record(replace(laid(x_m), y_m=y_m))
        findings.append(look_at(one, whole))
        assert (look_at(one, seen) == "unseen") == (findings[-1] == "unseen")
    assert 10 < findings.count("unseen") < 90
    mm = np.where(np.isnan(whole.z_m), np.iinfo(np.int16).min, np.round(1e3 * whole.z_m)).astype("<i2")
    head = json.dumps([whole.x0_m, whole.y0_m, whole.cell_m, *whole.shape])
    earlier = zlib.compress(head.encode() + b"\n" + mm.tobytes())
    for told in (unpack(earlier), unpack_seen(earlier)):
        assert isinstance(told, HeightMap)
        np.testing.assert_array_equal(told.z_m, whole.z_m)
