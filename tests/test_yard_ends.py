"""Ends of bundles at the pictures' edge and in the map's holes, against drawn truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from barsight.core.records.heights import HeightSource
from barsight.yard.bundles.detection import find_bundles
from barsight.yard.bundles.fitting.settings import BundleSettings
from barsight.yard.types import HeightMap
from yard_maps import Laid, draw

SETTINGS = BundleSettings()
EYE_M, EDGE_M = 7.5, 1.5
"""Height of the camera over y = 0; the floor's last place in its pictures."""


def lying_to(end_m: float) -> Laid:
    """A bundle 1.2 m over the floor, from y = -1.8 m to end_m."""
    return Laid(0.5, (end_m - 1.8) / 2, 1.2, 0.0, length_m=end_m + 1.8)


def seen_from_above(one: Laid) -> HeightMap:
    """The map of what one camera sees, with the bounds by its lines of sight to the floor."""
    heights = draw([one], y_m=(-2.0, EDGE_M))
    z, y = heights.z_m.copy(), heights.y_m[:, None]
    over = np.abs(heights.x_m - one.x_m) < one.width_m / 2
    end_m = one.y_m + one.length_m / 2
    hides = 1 - one.top_z_m / EYE_M
    in_picture_m = EDGE_M * hides
    hidden = (y > in_picture_m) if end_m > in_picture_m else (y > end_m) & (y < end_m / hides)
    z[hidden & over] = np.nan
    free = np.full(z.shape, np.inf, np.float32)
    if end_m < in_picture_m:
        bound = np.broadcast_to(EYE_M * (1 - y / EDGE_M) + 0.02, z.shape)
        free = np.where(y > in_picture_m, bound, np.inf).astype(np.float32)
    source = np.where(np.isnan(z), HeightSource.UNKNOWN, HeightSource.VISION).astype(np.uint8)
    return replace(heights, z_m=z, source=source, free_m=free)


def test_lines_of_sight_past_an_end_show_it_and_bars_that_leave_the_pictures_stay_open() -> None:
    one = lying_to(1.2)
    heights = seen_from_above(one)
    (found,) = find_bundles(heights, SETTINGS)
    assert found.ends_open == (False, False)
    assert found.length_m == pytest.approx(one.length_m, abs=2 * found.sigma.length_m)
    (blind,) = find_bundles(replace(heights, free_m=None), SETTINGS)
    assert blind.ends_open == (False, True)
    for end_m in (1.3, 1.45):
        (going_on,) = find_bundles(seen_from_above(lying_to(end_m)), SETTINGS)
        assert going_on.ends_open == (False, True)


@pytest.mark.parametrize(("beyond_m", "is_open"), [(0.02, True), (0.08, False)])
def test_an_end_near_the_maps_edge_needs_less_of_the_floor_behind_it(beyond_m: float, is_open: bool) -> None:
    one = Laid(0.5, 0.0, 0.2, 0.0, length_m=3.0)
    (found,) = find_bundles(draw([one], y_m=(-2.0, 1.5 + beyond_m)), SETTINGS)
    assert found.ends_open == (False, is_open)
    if not is_open:
        assert found.length_m == pytest.approx(one.length_m, abs=2 * found.sigma.length_m)


@pytest.mark.parametrize("lower_m", [0.0, 0.02])
def test_bars_may_go_on_in_what_the_map_misses_before_the_floor_shows(lower_m: float) -> None:
    """lower_m: length over which heights fall off where the hole begins."""
    one = Laid(0.5, 0.0, 0.2, 0.0, length_m=3.0)
    heights = draw([one])
    (whole,) = find_bundles(heights, SETTINGS)
    y, over = heights.y_m[:, None], np.abs(heights.x_m - 0.5) < 0.2
    heights.z_m[(y > 1.2) & (y < 1.52) & over] = 0.0
    lost = (y > 1.2 + lower_m) & (y < 1.52) & over
    heights.z_m[lost], heights.source[lost] = np.nan, HeightSource.UNKNOWN
    (found,) = find_bundles(heights, SETTINGS)
    assert found.ends_open == (False, False)
    assert abs(found.length_m - one.length_m) > 5 * whole.sigma.length_m
    assert abs(found.length_m - one.length_m) < 3 * found.sigma.length_m
