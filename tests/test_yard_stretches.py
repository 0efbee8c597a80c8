"""A long yard is worked on in stretches: what is found is what one go finds."""

from __future__ import annotations

import numpy as np
import pytest

from barsight.yard import sections as cutting
from barsight.yard.bundles.bundle_record import describe_bundles
from barsight.yard.bundles.detection import find_bundles
from barsight.yard.bundles.fitting.settings import BundleSettings
from barsight.yard.lift_settings import LiftSettings
from barsight.yard.lifting.targets import plan_lifts
from barsight.yard.sections import part_about, patches, split_map
from barsight.yard.types import HeightMap
from lift_yards import MAGNET, laid, record
from yard_maps import Laid, draw

LENGTH_M = 13.0


def long_yard() -> list[Laid]:
    """Bundles side by side in two layers, one across them, one along X over a seam, two kinds of bars."""
    rng = np.random.default_rng(3)
    stock = [
        Laid(x, 0.0, 0.2, float(rng.normal(0, 0.3)), *((0.09, 7) if x < 6 else (0.04, 37)), roll_deg=k % 30)
        for k, x in enumerate(np.arange(0.3, LENGTH_M - 1, 0.31))
        if not 6 < x < 9.5
    ]
    stock += [Laid(x, 0.1, 0.52, 0.2, roll_deg=4) for x in (2.0, 4.3, 10.6)]
    return [*stock, Laid(5.2, 0.4, 0.47, 88.0, length_m=1.6), Laid(7.8, 0.5, 0.2, 89.5, length_m=3.0)]


def in_short_stretches(monkeypatch: pytest.MonkeyPatch) -> None:
    """So that small maps have many."""
    for name, metres in (("WHOLE_M", 8.0), ("OWN_M", 4.0), ("MARGIN_M", 2.5)):
        monkeypatch.setattr(cutting, name, metres)


@pytest.mark.slow
def test_a_yard_in_stretches_has_the_same_bundles_and_lifts(monkeypatch: pytest.MonkeyPatch) -> None:
    """They differ by what the bundles of a kind have in common, by less than half a sigma."""
    heights = draw(long_yard(), x_m=(-0.5, LENGTH_M))
    whole = find_bundles(heights, BundleSettings())
    assert len(whole) == 29
    plan = plan_lifts(heights, whole, MAGNET, LiftSettings(), ())
    in_short_stretches(monkeypatch)
    assert len(split_map(heights)) == 4
    cut = find_bundles(heights, BundleSettings())
    assert len(cut) == len(whole)
    for one, other in zip(cut, whole, strict=True):
        assert (one.id, one.layer, one.on_top, one.neighbours, one.ends_open) == (
            other.id, other.layer, other.on_top, other.neighbours, other.ends_open
        )  # fmt: skip
        # Which bars are doubtful is judged by the bundles of their kind, and a stretch has fewer of them.
        assert one.bars == other.bars or None in (one.bars, other.bars)
        np.testing.assert_allclose(one.ends_m, other.ends_m, atol=6e-3)
        assert one.yaw_rad == pytest.approx(other.yaw_rad, abs=0.5 * other.sigma.yaw_rad)
        assert one.top_z_m == pytest.approx(other.top_z_m, abs=0.5 * other.sigma.top_z_m)
        assert one.width_m == pytest.approx(other.width_m, abs=0.5 * other.sigma.width_m)
    again = plan_lifts(heights, whole, MAGNET, LiftSettings(), ())
    for ours, theirs in ((again.offered, plan.offered), (again.refused, plan.refused)):
        assert [lift.bundles for lift in ours] == [lift.bundles for lift in theirs]
        assert [lift.vetoes for lift in ours] == [lift.vetoes for lift in theirs]
        np.testing.assert_allclose([lift.safety for lift in ours], [lift.safety for lift in theirs])
    assert again.footings == plan.footings
    assert [lift.set_down for lift in again.offered] == [lift.set_down for lift in plan.offered]


def test_every_place_is_one_stretchs_own_and_well_inside_it(monkeypatch: pytest.MonkeyPatch) -> None:
    in_short_stretches(monkeypatch)
    nothing = np.zeros((500, 3000), np.float32)
    heights = HeightMap(-7.0, 100.0, 0.01, nothing, nothing, nothing, nothing.astype(np.uint8))
    parts = split_map(heights)
    assert len(parts) == 8
    for place in np.random.default_rng(0).uniform((-8, 99), (24, 106), (300, 2)):
        (own,) = (part for part in parts if part.owns(place))
        held = heights.part(own.rows, own.columns)
        low = np.array([held.x0_m, held.y0_m])
        high = low + held.cell_m * np.array(held.shape[::-1])
        for axis in range(2):
            inside = (-7.0, 100.0)[axis] < place[axis] < (23.0, 105.0)[axis]
            beyond = min(place[axis] - low[axis], high[axis] - place[axis])
            assert not inside or beyond > 2.48 or low[axis] < (-6.99, 100.01)[axis] or high[axis] > 22.99
    covered = np.zeros(heights.shape, int)
    for patch in patches(heights, 64):
        covered[patch] += 1
    assert (covered == 1).all()


def test_the_part_about_places_beyond_the_map_is_its_border() -> None:
    heights = draw([], x_m=(0.0, 1.0), y_m=(0.0, 1.0))
    assert part_about(heights, np.array([0.314, 0.32]), np.array([0.5])).shape == (1, 2)
    assert part_about(heights, np.array([-3.0]), np.array([9.0])).shape == (1, 1)


def test_a_bundle_whose_middle_is_far_beyond_the_seam_still_lies_on_another() -> None:
    low, high = laid(0.3, y_m=-0.2, length_m=10.0), laid(0.535, z=0.335, y_m=8.1, length_m=11.0)
    heights = draw([low, high], x_m=(-1.5, 2.5), y_m=(-31.0, 31.0), sigma_m=0.002)
    parts = split_map(heights)
    bundles = describe_bundles([record(one) for one in (low, high)], 0.0, parts)
    assert len(parts) == 2 and not bundles[0].is_free and bundles[0].neighbours == (1,)
    plan = plan_lifts(heights, bundles, MAGNET, LiftSettings(), ())
    vetoes = {veto.code for lift in plan.refused if lift.bundles == (0,) for veto in lift.vetoes}
    assert vetoes == {"covered", "unstable-side"}
