"""Set-down: a place for the very bundle, on what carries it, with nothing in its way."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

import yard_maps
from barsight.core.records.heights import HeightSource
from barsight.yard.events import YardEvent
from barsight.yard.lift_settings import LiftSettings
from barsight.yard.lifting.bearing import find_bearing
from barsight.yard.lifting.ground import Ground
from barsight.yard.lifting.set_down import SetDown, find_set_down, sound_ground
from barsight.yard.lifting.targets import put_down
from barsight.yard.magnet.description import Magnet
from barsight.yard.magnet.footprint import Placement
from barsight.yard.placement.load import Load, laid_at, reaches_area
from barsight.yard.types import HeightMap
from barsight.yard.weight import load_centre
from lift_yards import LENGTH_M, MAGNET, SETTINGS, judged, laid, map_of, record

LOAD = Load.of((record(laid(0.3)),))
FREE = (1.6, 0.0)
"""A place on the bare floor of `yard`."""


def yard() -> HeightMap:
    return map_of([laid(0.3)], x_m=(-0.5, 3.0))


def cells(heights: HeightMap, x: tuple[float, float], y: tuple[float, float]) -> tuple[slice, slice]:
    """The cells between these places."""
    columns = np.searchsorted(heights.x_m, x)
    rows = np.searchsorted(heights.y_m, y)
    return slice(*rows.tolist()), slice(*columns.tolist())


def carried(heights: HeightMap, load: Load = LOAD, place: tuple[float, float] = FREE) -> bool:
    return find_bearing(heights, load, *place, 0.0, MAGNET, SETTINGS) is not None


def test_a_bare_level_floor_carries_all_of_it() -> None:
    bearing = find_bearing(yard(), LOAD, *FREE, 0.0, MAGNET, SETTINGS)
    assert bearing is not None
    assert bearing.z_m == pytest.approx(0.0, abs=0.01) and bearing.slope_deg < 1
    assert bearing.support_m > 0.9 * LENGTH_M
    assert bearing.margin_along_m > 0.45 * LENGTH_M and bearing.margin_across_m > LOAD.width_m / 6


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("length_m", [0.3, 6.0])
@pytest.mark.parametrize("beside_m", [0.0, 0.1])
def test_a_hole_of_300_mm_refuses(length_m: float, beside_m: float, turned: bool) -> None:
    heights = yard()
    middle = FREE[0] + beside_m
    x, y = (middle - 0.15, middle + 0.15), (1.0 - length_m / 2, 1.0 + length_m / 2)
    if turned:
        x, y = (FREE[0] - length_m / 2, FREE[0] + length_m / 2), (0.85, 1.15)
    heights.z_m[cells(heights, x, y)] -= 0.3
    assert not carried(heights)


def test_two_beams_about_the_middle_carry_and_two_on_one_side_do_not() -> None:
    for ends, fits in (
        ((-2.0, 2.0), True),
        ((-3.0, 3.0), False),
        ((0.5, 3.0), False),
        ((-0.8, 0.8), False),
        ((0.0, 0.0), False),
    ):
        heights = yard()
        for y in ends:
            heights.z_m[cells(heights, (1.0, 2.2), (y - 0.05, y + 0.05))] += 0.1
        assert carried(heights) is fits, ends


def test_gullies_between_bars_are_no_holes_and_a_ridge_is_no_support() -> None:
    close = map_of(
        [laid(1.0 + 0.091 * k, bars=1, diameter_m=0.09, z=0.045) for k in range(14)], x_m=(-0.5, 3.5)
    )
    far = map_of([laid(0.9 + 0.3 * k, bars=1, diameter_m=0.2, z=0.1) for k in range(6)], x_m=(-0.5, 3.5))
    dunnage = LiftSettings(dunnage_m=0.09)
    for heights, bare, bridged in ((close, False, True), (far, False, False)):
        assert carried(heights) is bare
        found = find_bearing(heights, LOAD, *FREE, 0.0, MAGNET, dunnage)
        assert (found is not None) is bridged
        assert found is None or found.z_m == pytest.approx(0.18, abs=0.006)
    across = [laid(1.6, bars=1, diameter_m=0.09, z=0.045, yaw_deg=90.0, length_m=2.0)] * 2
    across = [replace(one, y_m=y) for one, y in zip(across, (-2.0, 2.0), strict=True)]
    assert carried(map_of(across, x_m=(-0.5, 3.5)))


def test_a_slope_a_neighbour_a_tall_thing_under_the_beam_and_the_unseen_refuse() -> None:
    sloped = yard()
    sloped.z_m[:] += (np.tan(np.radians(4)) * sloped.x_m[None]).astype(np.float32)
    assert not carried(sloped)
    sloped = yard()
    sloped.z_m[:] += (np.tan(np.radians(3)) * sloped.y_m[:, None]).astype(np.float32)
    assert not carried(sloped)
    beside = FREE[0] + LOAD.width_m / 2 + SETTINGS.set_down_clear_m
    low = yard()
    low.z_m[cells(low, (beside - 0.02, beside + 0.2), (1.0, 1.5))] += 0.1
    assert not carried(low)
    unseen = yard()
    unseen.source[cells(unseen, (1.5, 1.6), (1.0, 1.1))] = HeightSource.FILLED
    assert not carried(unseen)
    tall = yard()
    tall.z_m[cells(tall, (beside + 0.1, beside + 0.2), (1.0, 1.5))] += 3.0
    assert carried(tall)
    broad = replace(MAGNET, beam=replace(MAGNET.beam, width_m=0.8))
    assert find_bearing(tall, LOAD, *FREE, 0.0, broad, SETTINGS) is None


@pytest.mark.parametrize(
    ("magnet", "x", "y"),
    [
        (MAGNET, (1.5, 1.7), (2.8, 2.9)),
        (replace(MAGNET, beam=replace(MAGNET.beam, length_m=3.0)), (1.5, 1.7), (2.4, 2.5)),
        (
            replace(MAGNET, poles=tuple(replace(p, across_m=-1.0) for p in MAGNET.poles)),
            (2.5, 2.7),
            (0.6, 0.8),
        ),
    ],
    ids=["a beam that holds the load 0.3 m off its middle", "poles beyond the beam", "poles beside the beam"],
)
def test_what_stands_or_is_not_seen_under_any_part_of_the_magnet_refuses(
    magnet: Magnet, x: tuple[float, float], y: tuple[float, float]
) -> None:
    """The load is 4 m long; nothing stands nearer to it than 0.3 m."""
    load = Load.of((record(laid(0.3, length_m=4.0)),))

    def found(heights: HeightMap) -> bool:
        return find_bearing(heights, load, *FREE, 0.0, magnet, SETTINGS) is not None

    open_ = map_of([laid(0.3, length_m=4.0)], x_m=(-3.0, 5.0), y_m=(-5.0, 5.0))
    assert found(open_)
    tall, unseen = (replace(open_, z_m=open_.z_m.copy(), source=open_.source.copy()) for _ in range(2))
    tall.z_m[cells(tall, x, y)] += 3.0
    unseen.source[cells(unseen, x, y)] = HeightSource.UNKNOWN
    assert not found(tall) and not found(unseen)
    assert found(replace(unseen, free_m=np.full(unseen.shape, 0.1, np.float32)))


@pytest.mark.parametrize(("bars", "fits"), [(7, True), (None, False)])
def test_a_magnet_on_a_pack_that_may_be_flat_needs_room_beyond_its_ends(bars: int | None, fits: bool) -> None:
    """A pack is taken to be as high as it is wide where its bars aren't counted; it may be half as high."""
    load = Load.of((record(laid(0.3, length_m=4.0), bars=bars),))
    heights = map_of([laid(0.3, length_m=4.0)], x_m=(-3.0, 5.0), y_m=(-5.0, 5.0))
    heights.z_m[cells(heights, (1.5, 1.7), (2.35, 2.45))] = 0.8 * load.height_m
    assert (find_bearing(heights, load, *FREE, 0.0, MAGNET, SETTINGS) is not None) is fits


def test_a_stanchion_is_not_touched_and_stands_over_what_it_holds() -> None:
    for x, top, fits in ((1.65, 2.0, False), (2.3, 2.0, True), (2.3, 0.2, False), (2.95, 0.2, True)):
        settings = LiftSettings(stanchions=((x, 1.0, top),))
        found = find_bearing(yard(), LOAD, *FREE, 0.0, MAGNET, settings)
        assert (found is not None) is fits, (x, top)


def test_nothing_is_put_down_in_a_no_lift_area() -> None:
    """The nearest place is taken; with that barred another one, and with all barred none."""
    heights = yard()
    place = find_set_down(Ground.of(heights), LOAD, MAGNET, SETTINGS)
    assert place is not None
    for reach_m, found in ((0.3, True), (50.0, False)):
        area = (place.x_m - reach_m, place.y_m - reach_m, place.x_m + reach_m, place.y_m + reach_m)
        settings = LiftSettings(no_lift_areas=(area,))
        other = find_set_down(sound_ground(Ground.of(heights), (), (), settings), LOAD, MAGNET, settings)
        assert (other is not None) is found
        if other is not None:
            middle = np.array([other.x_m, other.y_m])
            yaw_rad = np.radians(other.yaw_deg)
            assert not reaches_area(middle, yaw_rad, (LOAD.width_m, LOAD.length_m), area)


def test_a_magnet_that_holds_a_load_off_its_middle_keeps_out_of_a_no_lift_area_too() -> None:
    """The load is 4 m long, the beam 5.4 m, which may hang 0.3 m further along."""
    load = Load.of((record(laid(0.3, length_m=4.0)),))
    heights = map_of([laid(0.3, length_m=4.0)], x_m=(-0.5, 3.0), y_m=(-6.0, 6.0))
    heights.source[np.abs(heights.y_m) > 3.2] = HeightSource.UNKNOWN
    heights = replace(heights, free_m=np.zeros(heights.shape, np.float32))
    for from_y_m in (2.6, 2.95, 4.5):
        settings = LiftSettings(no_lift_areas=((-9.0, from_y_m, 9.0, 9.0), (-9.0, -9.0, 9.0, -from_y_m)))
        place = find_set_down(sound_ground(Ground.of(heights), (), (), settings), load, MAGNET, settings)
        assert (place is None) == (from_y_m < 4), from_y_m


def test_the_place_is_the_bundles_own_kind_of_place() -> None:
    heights = yard()
    place = find_set_down(Ground.of(heights), LOAD, MAGNET, SETTINGS)
    assert place is not None and place.turn_deg == 0 and place.z_m < 0.02
    clear = place.x_m - LOAD.width_m / 2 - (0.3 + LOAD.width_m / 2)
    assert clear >= SETTINGS.set_down_clear_m
    assert abs(place.y_m) + LENGTH_M / 2 < 4.0
    # Nearest to where it lies, and never where the load itself is all that is known.
    assert place.x_m < 1.2
    heights.source[:, heights.x_m > 0.8] = HeightSource.UNKNOWN
    heights.source[:, heights.x_m < -0.2] = HeightSource.UNKNOWN
    assert find_set_down(Ground.of(heights), LOAD, MAGNET, SETTINGS) is None
    long = replace(LOAD, length_m=9.0)
    assert find_set_down(Ground.of(yard()), long, MAGNET, SETTINGS) is None


def test_a_place_across_counts_where_the_crane_can_turn() -> None:
    stock = [laid(-3.0)]
    heights = map_of(stock, x_m=(-3.5, 6.5))
    heights.source[(heights.y_m < -1) | (heights.y_m > 1)] = HeightSource.UNKNOWN
    load = Load.of((record(stock[0]),))
    assert find_set_down(Ground.of(heights), load, MAGNET, SETTINGS) is None
    turning = LiftSettings(max_turn_deg=90.0)
    place = find_set_down(Ground.of(heights), load, MAGNET, turning)
    assert place is not None and abs(abs(place.yaw_deg) - 90) < 0.1 and place.turn_deg == 90


def test_a_single_round_bar_rolls() -> None:
    bar = Load.of((record(laid(0.3, bars=1, diameter_m=0.2)),))
    assert bar.rolls and find_set_down(Ground.of(yard()), bar, MAGNET, SETTINGS) is None
    assert not LOAD.rolls and LOAD.height_m == pytest.approx(laid(0).top_z_m * 2 - 0.4, abs=1e-9)
    assert math.isclose(LOAD.x_m, 0.3)


def test_a_load_settles_about_its_centre_of_mass() -> None:
    """Two bundles, the second a quarter heavier: supports count from their common centre of mass."""
    light, heavy = (
        record(laid(x), k, section_m2=area, bars=None)
        for k, (x, area) in enumerate(((0.3, 0.04), (0.6, 0.05)))
    )
    load = Load.of((light, heavy))
    assert (load.x_m, load.off_across_m, load.off_along_m) == pytest.approx((0.45, 0.05 / 3, 0.0))
    np.testing.assert_allclose(load_centre((light, heavy)), (1.4 / 3, 0.0), atol=1e-12)
    unknown = replace(heavy, section_m2=float("nan"))
    np.testing.assert_allclose(load_centre((light, unknown)), (0.45, 0.0), atol=1e-12)
    middle = find_bearing(yard(), replace(load, off_across_m=0.0), *FREE, 0.0, MAGNET, SETTINGS)
    found = find_bearing(yard(), load, *FREE, 0.0, MAGNET, SETTINGS)
    assert middle is not None and found is not None
    assert middle.margin_across_m - found.margin_across_m == pytest.approx(0.05 / 3, abs=0.01)
    assert found.z_m == pytest.approx(middle.z_m, abs=2e-3)


@pytest.mark.parametrize("turn_deg", [0.0, 2.5, 90.0])
@pytest.mark.parametrize("yaw_deg", [0.0, 89.0])
def test_a_magnet_that_holds_a_load_off_its_middle_goes_as_far_beside_the_place(
    yaw_deg: float, turn_deg: float
) -> None:
    """Bars and magnet are one rigid body from target to set-down: the bars' middle comes to the place."""
    stock = laid(0.3, yaw_deg=yaw_deg)
    load, off_m = Load.of((record(stock),)), np.array([0.03, 0.25])
    yaw = math.radians(yaw_deg)
    held = Placement(*(np.array([load.x_m, load.y_m]) + off_m), yaw)
    lift = judged([stock], place=held)
    x, y, to_deg = 3.0, -1.0, yaw_deg + turn_deg
    wrapped_deg = to_deg - 180 * math.ceil(to_deg / 180 - 0.5)
    moved = put_down(lift, load, SetDown(x, y, 0.0, wrapped_deg, turn_deg, 0.0, 5.0, 1.0, 0.1))
    assert moved.magnet_down is not None
    turned = moved.magnet_down.yaw_rad - yaw
    cos, sin = math.cos(turned), math.sin(turned)
    bars = np.array([[cos, -sin], [sin, cos]]) @ -off_m
    middle = np.array([moved.magnet_down.x_m, moved.magnet_down.y_m]) + bars
    assert middle == pytest.approx([x, y], abs=1e-9)
    assert turned == pytest.approx(math.radians(turn_deg))
    none = put_down(moved, load, None)
    assert none.set_down is None and none.magnet_down is None


@pytest.mark.parametrize(("away_m", "fits"), [(2.9, False), (4.0, False), (5.0, True)])
def test_the_magnet_keeps_off_what_the_map_does_not_know_any_more(away_m: float, fits: bool) -> None:
    """A beam of 5.4 m over a load of 3: what happened beyond both ends of it counts under the beam."""
    short = laid(0.3, length_m=3.0)
    heights = map_of([short], x_m=(-0.5, 3.0), y_m=(-6.0, 6.0))
    heights = replace(heights, free_m=np.zeros(heights.shape, np.float32))
    load = Load.of((record(short),))
    events = tuple(YardEvent(10, "set-down", 1.25, side * away_m, 0.0, 0.4, 4.0) for side in (-1, 1))
    ground = sound_ground(Ground.of(heights), (), (), SETTINGS, events)
    assert (find_set_down(ground, load, MAGNET, SETTINGS) is not None) is fits


def test_several_bundles_are_laid_as_wide_as_they_lie() -> None:
    pair = record(laid(0.3)), record(laid(0.75))
    down, whole = laid_at(pair, 5.0, 1.0, 0.3), Load.of(pair)
    assert (down.width_m, down.length_m) == (whole.width_m, whole.length_m)
    assert (*down.centre_m[:2], down.yaw_rad) == (5.0, 1.0, 0.3) and whole.width_m > 0.7


@pytest.mark.parametrize("cell_m", [0.005, 0.008, 0.01, 0.015, 0.02])
@pytest.mark.parametrize(("wide_m", "rise_m"), [(0.02, 0.12), (0.05, 0.05)])
def test_nothing_is_put_down_on_a_thing_whatever_the_maps_cells_are(
    wide_m: float, rise_m: float, cell_m: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A plate on edge of 20 mm and a block of 50 mm."""
    monkeypatch.setattr(yard_maps, "CELL_M", cell_m)
    assert carried(yard())
    for shift in range(4):
        heights, low = yard(), FREE[0] + shift * 0.006
        heights.z_m[cells(heights, (low, low + wide_m - 1e-6), (1.0, 1.3))] += rise_m
        assert not carried(heights)
