"""Bundles of which a map shows a part: cut by its end, or parted by unknown cells."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from barsight.core.records.heights import HeightSource
from barsight.yard.bundles.bundle_record import describe_bundles
from barsight.yard.bundles.collinear_pieces import join_pieces
from barsight.yard.bundles.detection import find_bundles
from barsight.yard.bundles.fitting.settings import BundleSettings
from barsight.yard.lifting.targets import plan_lifts
from barsight.yard.sections import split_map
from barsight.yard.types import ENDS, Doubt, DoubtKind, HeightMap
from barsight.yard.weight import STEEL_KG_PER_M3, bundle_mass
from lift_yards import MAGNET, laid, map_of, record
from lift_yards import SETTINGS as LIFTS
from yard_maps import Laid

SETTINGS = BundleSettings()


def cut(heights: HeightMap, x_m: float) -> HeightMap:
    """The same map, ended at an x."""
    end = round((x_m - heights.x0_m) / heights.cell_m)
    return heights.part(slice(0, heights.shape[0]), slice(0, end))


def unseen(heights: HeightMap, y_m: float, length_m: float) -> HeightMap:
    """The same map without the rows of a length about a y."""
    hidden = np.abs(heights.y_m - y_m) < length_m / 2
    hidden = np.repeat(hidden[:, None], heights.shape[1], axis=1)
    unknown, z_m = heights.source.copy(), np.where(hidden, np.float32(np.nan), heights.z_m)
    unknown[hidden] = HeightSource.UNKNOWN
    return replace(heights, z_m=z_m, source=unknown)


def mass_of(one: Laid) -> float:
    return float(one.bars * np.pi / 4 * one.diameter_m**2 * one.length_m * STEEL_KG_PER_M3)


@pytest.mark.parametrize("stock", [{}, {"diameter_m": 0.05, "bars": 19}, {"diameter_m": 0.2, "bars": 1}])
@pytest.mark.parametrize("ratio", [0.3, 0.15, 0.0])
def test_a_bundle_that_the_maps_end_cuts_lengthwise_may_be_wider(
    stock: dict[str, float], ratio: float
) -> None:
    """It was told free and as 164 +- 34 mm wide instead of 251 mm. The one beside it is seen whole."""
    whole, part = (laid(x, 0.165, **stock) for x in (0.0, 0.35))
    heights = cut(map_of([whole, part]), part.x_m + ratio * part.width_m)
    seen, told = find_bundles(heights, SETTINGS)
    assert not told.is_free and np.isnan(bundle_mass(told).kg)
    assert abs(told.width_m - part.width_m) < 1.96 * told.sigma.width_m
    assert abs(told.centre_m[0] - part.x_m) < 1.96 * told.sigma.lateral_m
    assert any(doubt.kind is DoubtKind.MAY_GO_ON for doubt in told.reasons)
    assert seen.is_free and bundle_mass(seen).kg > 0 and seen.sigma.width_m < 0.05
    plan = plan_lifts(heights, (seen, told), MAGNET, LIFTS, ())
    assert not any(told.id in lift.bundles for lift in plan.offered)


def test_floor_behind_a_wide_unknown_strip_is_no_flank() -> None:
    one = laid(0.0, 0.165)
    heights = map_of([one])
    heights.source[:, (heights.x_m > 0.0) & (heights.x_m < 0.2)] = HeightSource.UNKNOWN
    (told,) = find_bundles(heights, SETTINGS)
    assert not told.is_free and np.isnan(bundle_mass(told).kg)
    assert abs(told.width_m - one.width_m) < 1.96 * told.sigma.width_m


def test_a_bundle_whose_flanks_are_seen_is_free_beside_the_maps_end() -> None:
    one = laid(0.0, 0.165)
    for beyond_m in (0.03, 0.06, 0.2):
        (told,) = find_bundles(cut(map_of([one]), one.width_m / 2 + beyond_m), SETTINGS)
        assert told.is_free and told.sigma.width_m < 0.05
        assert bundle_mass(told).upper_kg > mass_of(one)


@pytest.mark.parametrize(("gap_m", "unknown_m"), [(0.02, 0.06), (0.1, 0.1), (0.05, 0.3), (0.5, 0.55)])
def test_a_gap_may_hide_in_what_the_map_does_not_show(gap_m: float, unknown_m: float) -> None:
    """Two bundles end to end were told as one of 6.3 m, free and certain, and a lift of both was offered."""
    one = replace(laid(0.0, 0.165), length_m=6.5, y_m=-0.25)
    behind = replace(one, length_m=0.7, y_m=3.0 + 0.35 + gap_m)
    place_m = 3.0 + gap_m / 2
    heights = unseen(map_of([one, behind], y_m=(-4.0, 4.6)), place_m, unknown_m)
    (told,) = find_bundles(heights, SETTINGS)
    assert told.length_m > 7.0 and told.confidence < 0.5
    assert any(doubt.kind is DoubtKind.GAP for doubt in told.reasons)
    assert not plan_lifts(heights, (told,), MAGNET, LIFTS, ()).offered
    (whole,) = find_bundles(map_of([replace(one, length_m=7.2, y_m=0.1)]), SETTINGS)
    assert whole.confidence > 0.9


@pytest.mark.parametrize(("size_m", "is_free"), [(0.08, True), (0.12, False), (0.6, False)])
def test_something_may_lie_where_half_of_the_width_was_not_seen(size_m: float, *, is_free: bool) -> None:
    """The place lies beyond the magnet: such a lift was offered, whatever lay there."""
    one = laid(0.0, 0.165, length_m=7.4)
    heights = map_of([one], y_m=(-4.5, 4.5))
    along, across = np.abs(heights.y_m - 2.95) < size_m / 2, np.abs(heights.x_m - 0.1) < 0.1
    heights.source[along[:, None] & across] = HeightSource.UNKNOWN
    (told,) = find_bundles(heights, SETTINGS)
    assert told.is_free is is_free and told.confidence > 0.9
    plan = plan_lifts(heights, (told,), MAGNET, LIFTS, ())
    assert len(plan.offered) == is_free
    assert all("covered" in {veto.code for veto in lift.vetoes} for lift in plan.refused)


@pytest.mark.parametrize(
    ("why", "is_free"),
    [("end is open: the map doesn't show what lies beyond", True), (DoubtKind.COVERED_END.value, False)],
)
def test_pieces_joined_over_what_was_not_seen_may_be_two_bundles(why: str, *, is_free: bool) -> None:
    pieces = [
        record(
            replace(laid(0.0), y_m=y_m, length_m=3.0), ends_open=(y_m > 0, y_m < 0),
            reasons=(Doubt.read(f"the {ENDS[y_m < 0]} {why}"),),
        )
        for y_m in (-1.7, 1.7)
    ]  # fmt: skip
    (whole,) = describe_bundles(join_pieces(pieces), 0.0, split_map(map_of([laid(0.0)])))
    assert whole.length_m > 6.0 and not any(whole.ends_open)
    assert whole.is_free is is_free and (whole.confidence < 0.5) is is_free
