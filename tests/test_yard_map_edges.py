"""Bundles of which a map shows a part: cut by its end, or parted by unknown cells."""

from __future__ import annotations

import numpy as np
import pytest

from barsight.yard.bundles.detection import find_bundles
from barsight.yard.bundles.fitting.settings import BundleSettings
from barsight.yard.lifting.targets import plan_lifts
from barsight.yard.types import DoubtKind, HeightMap
from barsight.yard.weight import STEEL_KG_PER_M3, bundle_mass
from lift_yards import MAGNET, laid, map_of
from lift_yards import SETTINGS as LIFTS
from yard_maps import Laid

SETTINGS = BundleSettings()


def cut(heights: HeightMap, x_m: float) -> HeightMap:
    """The same map, ended at an x."""
    end = round((x_m - heights.x0_m) / heights.cell_m)
    return heights.part(slice(0, heights.shape[0]), slice(0, end))


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


def test_a_bundle_whose_flanks_are_seen_is_free_beside_the_maps_end() -> None:
    one = laid(0.0, 0.165)
    for beyond_m in (0.06, 0.2):
        (told,) = find_bundles(cut(map_of([one]), one.width_m / 2 + beyond_m), SETTINGS)
        assert told.is_free and told.sigma.width_m < 0.05
        assert bundle_mass(told).upper_kg > mass_of(one)
