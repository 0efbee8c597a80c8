"""A seen surface tells what a pole reaches, however uncertain the outline is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from barsight.core.records.heights import HeightSource
from barsight.yard.lifting.assessment import assess_place
from barsight.yard.magnet.description import Tolerance
from barsight.yard.magnet.footprint import BundleTable, Grip, Placement, count_gripped
from barsight.yard.magnet.partings import without_parted
from barsight.yard.magnet.reach import reached_strips
from barsight.yard.magnet.seen_edges import seen_clearances
from barsight.yard.types import Bundle, HeightMap
from lift_yards import MAGNET, SETTINGS, SIGMA, codes, laid, map_of, record, yard_of

OVER = Placement(0.3, 0.0, 0.0)
FACES = np.full(4, laid(0.3).top_z_m)
UNSURE = replace(SIGMA, lateral_m=0.06)


def hidden(heights: HeightMap, low_m: float, high_m: float) -> HeightMap:
    """The same where nothing was seen between two places across."""
    source = heights.source.copy()
    source[:, (heights.x_m > low_m) & (heights.x_m < high_m)] = HeightSource.UNKNOWN
    return replace(heights, source=source)


def clearances(heights: HeightMap, *bundles: Bundle) -> tuple[np.ndarray, np.ndarray]:
    """Reach of the poles, and by how much they miss each bundle but the first."""
    table, unsure = BundleTable.of(bundles), np.full(len(bundles), 0.1)
    strips = reached_strips(heights, OVER, MAGNET, MAGNET.tolerance, FACES)
    held = Grip((0,), 0.5, unsure)
    found = seen_clearances(held, heights, OVER, MAGNET, MAGNET.tolerance, table, FACES, strips)
    return strips, found


@pytest.mark.parametrize("beside_m", [0.55, 0.6, 0.05])
def test_a_seen_flank_is_where_geometry_puts_it(beside_m: float) -> None:
    stock = [laid(0.3), laid(beside_m)]
    heights = map_of(stock, sigma_m=0.001)
    far = record(stock[1], 1, sigma=UNSURE)
    strips, found = clearances(heights, record(stock[0]), far)
    # Bars of 90 mm: 50 mm under their crests the two on top end 90 mm beside the bundle's middle.
    true = abs(beside_m - 0.3 - strips[:, 1]) - strips[:, 3] / 2 - 0.09
    assert (found[1] <= true + 0.006).all() and (found[1] >= true - 0.016).all()


def test_a_flank_that_falls_on_out_of_sight_is_followed_and_one_that_is_hidden_is_not() -> None:
    stock = [laid(0.3), laid(0.6285)]
    heights = map_of(stock, sigma_m=0.001)
    two = record(stock[0]), record(stock[1], 1, sigma=UNSURE)
    _, seen = clearances(heights, *two)
    # Its flank is seen down to 33 of 50 mm, where it falls steeply.
    _, out = clearances(hidden(heights, 0.42, 0.5395), *two)
    assert (out[1] <= seen[1]).all() and (out[1] > seen[1] - 0.02).all()
    _, crest = clearances(hidden(heights, 0.42, 0.56), *two)
    assert (crest[1] == -np.inf).all()


def test_the_nearer_of_two_bundles_under_one_outline_counts() -> None:
    stock = [laid(0.3), laid(0.52), laid(0.72)]
    heights = map_of(stock, sigma_m=0.001)
    both = replace(record(stock[1], 1, sigma=UNSURE), width_m=0.4, centre_m=np.array([0.64, 0.0, 0.2]))
    strips, found = clearances(heights, record(stock[0]), both)
    assert (found[1] <= 0.52 - 0.09 - 0.3 - strips[:, 1] - strips[:, 3] / 2 + 0.006).all()
    _, unseen = clearances(hidden(heights, 0.38, 0.66), record(stock[0]), both)
    assert (unseen[1] == -np.inf).all(), "most of the outline shows nothing"


def test_a_surface_that_goes_on_beyond_its_outline_ends_nowhere() -> None:
    stock = [laid(0.3), laid(0.56)]
    narrow = replace(record(stock[1], 1, sigma=UNSURE), width_m=0.1, centre_m=np.array([0.6, 0.0, 0.2]))
    _, found = clearances(map_of(stock, sigma_m=0.001), record(stock[0]), narrow)
    assert (found[1] == -np.inf).all()


def counted(heights: HeightMap, own: Bundle, place: Placement, tolerance: Tolerance) -> tuple[Grip, Grip]:
    """The count by the outline alone, and by the surface as well."""
    table = BundleTable.of((own,))
    strips = reached_strips(heights, place, MAGNET, tolerance, FACES)
    before = count_gripped(place, MAGNET, tolerance, table, FACES, strips)
    clear = seen_clearances(before, heights, place, MAGNET, tolerance, table, FACES, strips)
    return before, count_gripped(place, MAGNET, tolerance, table, FACES, strips, clear)


def test_what_is_seen_under_the_faces_is_reached_wherever_the_bundle_ends() -> None:
    heights, own = map_of([laid(0.3)]), record(laid(0.3), sigma=UNSURE)
    before, after = counted(heights, own, OVER, MAGNET.tolerance)
    assert before.probability < 0.999 < after.probability and after.gripped == (0,)


@pytest.mark.parametrize("tolerance", [Tolerance(0.08, 0.08, 0.0), Tolerance(0.0, 0.0, 2.0)])
def test_what_a_face_may_miss_within_the_cranes_tolerance_is_not_certainly_reached(
    tolerance: Tolerance,
) -> None:
    """0.15 m beside the load's middle nothing within reach lies under a face 0.1 m wide."""
    heights, aside = map_of([laid(0.3)]), Placement(0.15, 0.0, 0.0)
    own = record(laid(0.3), sigma=UNSURE)
    near = replace(own, centre_m=own.centre_m - (0.03, 0.0, 0.0))
    before, after = counted(heights, near, aside, tolerance)
    assert before.gripped == (0,) and after.probability == before.probability < 0.9


@pytest.mark.parametrize("way", ["shown", "hidden"])
def test_a_hardly_known_neighbour_whose_flank_is_seen_isnt_taken(way: str) -> None:
    stock = [laid(0.3), laid(0.56)]
    heights = hidden(map_of(stock), 0.41 if way == "shown" else 0.4, 0.45 if way == "shown" else 0.49)
    two = tuple(record(one, k, sigma=replace(SIGMA, lateral_m=0.03)) for k, one in enumerate(stock))
    lift = assess_place(OVER, yard_of(heights, two), MAGNET, SETTINGS).lift
    assert ("count-uncertain" in codes(lift)) == (way == "hidden")


def test_an_end_that_may_lie_under_a_pole_isnt_parted_by_a_gully_beside() -> None:
    ends_at = 2.1 + 0.45 + 0.03 + 0.02
    behind = replace(laid(0.3), y_m=ends_at + 3.5)
    unsure = replace(SIGMA, along_m=0.1, length_m=0.2)
    table = BundleTable.of((record(laid(0.3)), record(behind, 1, sigma=unsure)))
    heights = map_of([laid(0.3)])
    strips = reached_strips(heights, OVER, MAGNET, MAGNET.tolerance, FACES)
    held = count_gripped(OVER, MAGNET, MAGNET.tolerance, table, FACES, strips)
    assert without_parted(held, heights, OVER, table, strips).flips[1] == held.flips[1] > 0.1


def test_a_yaws_error_acts_over_the_distance_to_the_pole_not_to_where_an_open_end_may_lie() -> None:
    def flip(*, is_open: bool) -> float:
        turned = replace(SIGMA, lateral_m=0.01, width_m=0.0, yaw_rad=0.003)
        beside = replace(record(laid(0.52), 1, sigma=turned), ends_open=(False, is_open), bar_diameter_m=0.09)
        table = BundleTable.of((record(laid(0.3)), beside))
        return float(count_gripped(OVER, MAGNET, MAGNET.tolerance, table, FACES, MAGNET.pole_table).flips[1])

    assert flip(is_open=True) == pytest.approx(flip(is_open=False), rel=1e-6)
