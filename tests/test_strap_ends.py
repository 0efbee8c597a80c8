"""Flanks by straps: drawn straps end where they were drawn; what they can't tell stays as told."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from barsight.bundle_pictures.flanks import MeanSection, takes_another, with_flanks
from barsight.bundle_pictures.measuring import measure_from_pictures
from barsight.bundle_pictures.strap_ends import StrapEnds
from barsight.yard.types import Bundle, Doubt, DoubtKind, HeightMap
from drawn_pictures import TOP_M, Pictures, flat_map, looking_down
from lift_yards import record
from yard_maps import Laid

WIDTH_M, LENGTH_M = 0.26, 2.0
PLACES_M = -0.6, 0.05, 0.7
"""Where along a bundle its straps lie."""


def told(yaw_deg: float, width_m: float = WIDTH_M, aside_m: float = 0.0) -> Bundle:
    """Describe a bundle that isn't counted, its flanks as unsure as a map may tell them."""
    bundle = record(Laid(aside_m, 0.0, TOP_M - width_m / 2, yaw_deg, length_m=LENGTH_M))
    sigma = replace(bundle.sigma, lateral_m=0.04, width_m=0.08, bar_diameter_m=0.01)
    return replace(
        bundle, bars=None, bar_diameter_m=0.03, visible_bars=7, width_m=width_m, top_z_m=TOP_M, sigma=sigma,
        section_m2=np.nan,
    )  # fmt: skip


def strapped(
    yaw_deg: float, spans_m: Sequence[tuple[float, float]], gray: float = 25.0
) -> Callable[[np.ndarray], np.ndarray]:
    """Shade bars along the heading, with straps from and to these places beside the axis."""
    yaw = np.radians(yaw_deg)
    across, along = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])

    def shade(places: np.ndarray) -> np.ndarray:
        u, v = places @ across, places @ along
        level = 110 + 40 * np.abs(np.sin(np.pi * u / 0.03))
        for at, (low, high) in zip(PLACES_M, spans_m, strict=True):
            level = np.where((np.abs(v - at) < 0.012) & (u > low) & (u < high), gray, level)
        return level

    return shade


def ridge(yaw_deg: float, low_m: float, high_m: float, beside_z_m: float = 0.0) -> HeightMap:
    """Map a flat bundle between two flanks, and what is beside it."""
    heights, yaw = flat_map(), np.radians(yaw_deg)
    u = np.cos(yaw) * heights.x_m + np.sin(yaw) * heights.y_m[:, None]
    heights.z_m[(u < low_m) | (u > high_m)] = beside_z_m
    return heights


def measured(bundle: Bundle, gray: Callable[[np.ndarray], np.ndarray], heights: HeightMap) -> Bundle:
    poses = looking_down(0.03, 1)
    (one,) = measure_from_pictures(Pictures(poses, gray), poses, heights, (bundle,))
    return one


def middle_m(bundle: Bundle) -> float:
    """Return how far beside the drawn axis, through the origin, a bundle lies."""
    across = np.array([np.cos(bundle.yaw_rad), np.sin(bundle.yaw_rad)])
    return float(bundle.centre_m[:2] @ across)


@pytest.mark.parametrize("gray", [25.0, 240.0])
@pytest.mark.parametrize("yaw_deg", [7.0, -15.0])
def test_flanks_stand_where_straps_end(yaw_deg: float, gray: float) -> None:
    """The map told a bundle 80 mm too wide and 30 mm aside; its ends move with its middle."""
    low, high = -0.10, 0.08
    across = np.array([np.cos(np.radians(yaw_deg)), np.sin(np.radians(yaw_deg)), 0.0])
    bundle = told(yaw_deg)
    bundle = replace(bundle, centre_m=bundle.centre_m + 0.02 * across, ends_m=bundle.ends_m + 0.02 * across)
    one = measured(bundle, strapped(yaw_deg, [(low, high)] * 3, gray), ridge(yaw_deg, low, high))
    assert one.width_m == pytest.approx(high - low, abs=0.008)
    assert middle_m(one) == pytest.approx((low + high) / 2, abs=0.006)
    np.testing.assert_allclose(one.ends_m.mean(axis=0), one.centre_m, atol=1e-9)
    # 0.6 of what they are off the map's flanks, 10 and 70 mm, adds to the sigma.
    assert 0.034 < one.sigma.width_m < 0.046 and one.sigma.lateral_m < 0.024
    assert 0.4 < one.section_m2 / (high - low) ** 2 < 0.8 and one.sigma.section_m2 > 0


def test_what_straps_cannot_tell_stays() -> None:
    """Straps that end differently, a surface that goes on where they end, a gully that parts them."""
    low, high = -0.10, 0.08
    same = [(low, high)] * 3
    differ = [(-0.10, 0.02), (-0.04, 0.08), (-0.07, 0.05)]
    parted = ridge(7.0, low, high)
    u = np.cos(np.radians(7.0)) * parted.x_m + np.sin(np.radians(7.0)) * parted.y_m[:, None]
    parted.z_m[np.abs(u) < 0.025] = 0.2
    for spans, heights in (
        (differ, ridge(7.0, low, high)), (same, flat_map()), (same, ridge(7.0, low, 0.13)), (same, parted),
    ):  # fmt: skip
        bundle = told(7.0)
        one = measured(bundle, strapped(7.0, spans), heights)
        assert one.width_m == bundle.width_m and one.sigma.width_m == bundle.sigma.width_m
        assert one.centre_m is bundle.centre_m and np.isnan(one.section_m2)


def ends(low_m: float, high_m: float, count: int = 3) -> list[StrapEnds]:
    return [StrapEnds(0.6 * k, low_m, high_m, 5.0, 0.006) for k in range(count)]


def section(low_m: float, high_m: float) -> MeanSection:
    beside = np.arange(-0.35, 0.35, 0.01)
    return MeanSection(beside, np.where((beside >= low_m) & (beside <= high_m), TOP_M, 0.0), WIDTH_M)


def test_straps_far_off_the_map_make_a_bundle_unsure() -> None:
    bundle = told(7.0)
    sure = replace(bundle, sigma=replace(bundle.sigma, lateral_m=0.005, width_m=0.01), section_m2=0.03)
    one = with_flanks(sure, ends(-0.08, 0.03), section(-0.08, 0.03), 0.0, 0.0)
    assert one.width_m == sure.width_m and one.centre_m is sure.centre_m
    assert one.sigma.lateral_m > 0.025 and one.sigma.width_m > 0.1 and np.isnan(one.section_m2)


def test_a_bundle_that_may_be_covered_is_left() -> None:
    bundle, seen = told(7.0), section(-0.1, 0.1)
    doubt = Doubt(DoubtKind.HIDDEN_FLANK, "what stands higher beside it may lie over its low flank")
    for one in (replace(bundle, on_top=False), replace(bundle, cover_doubts=(doubt,))):
        assert with_flanks(one, ends(-0.1, 0.1), seen, 0.0, 0.0) is one
    may_go_on = Doubt(DoubtKind.MAY_GO_ON, "it may be wider")
    one = with_flanks(replace(bundle, reasons=(may_go_on,)), ends(-0.1, 0.1), seen, 0.0, 0.0)
    assert one.width_m == pytest.approx(0.2) and np.isnan(one.section_m2)
    no_straps = Doubt(DoubtKind.NO_STRAPS, "the photo shows no straps that hold it")
    one = with_flanks(replace(bundle, reasons=(no_straps,)), ends(-0.1, 0.1), seen, 0.0, 0.0)
    assert one.width_m == pytest.approx(0.2) and not one.reasons


def test_a_strip_out_of_sight_is_no_flank_nor_the_maps_border() -> None:
    """Straps that end within a pack, where one column of the map isn't seen, or where the map ends."""
    beside = np.arange(-0.35, 0.35, 0.01)
    bundle, level = told(7.0), np.where(np.abs(beside) < 0.131, TOP_M, 0.0)
    for hole, value in ((np.abs(beside - 0.06) < 0.006, np.nan), (beside > 0.06, np.inf)):
        seen = MeanSection(beside, np.where(hole, value, level), WIDTH_M)
        assert with_flanks(bundle, ends(-0.13, 0.06), seen, 0.0, 0.0) is bundle


def test_straps_in_line_with_a_neighbours_are_not_one_bundle() -> None:
    """A neighbour touches: straps go on over it, and the map smooths the gully between."""
    beside = np.arange(-0.35, 0.35, 0.01)
    level = np.where((beside > -0.13) & (beside < 0.31), TOP_M, 0.0)
    level[np.abs(beside - 0.13) < 0.011] = TOP_M - 0.085
    bundle = told(7.0)
    seen = MeanSection(beside, level, WIDTH_M)
    assert with_flanks(bundle, ends(-0.13, 0.31), seen, 0.0, 0.0) is bundle
    shallow = np.where(level == TOP_M - 0.085, TOP_M - 0.05, level)
    one = with_flanks(bundle, ends(-0.13, 0.31), MeanSection(beside, shallow, WIDTH_M), 0.0, 0.0)
    assert one.centre_m is bundle.centre_m and one.sigma.lateral_m > 0.09 and np.isnan(one.section_m2)
    assert one.reasons[-1].sentence.startswith("in the pictures its straps end")


def test_flanks_take_no_other_bundle_in() -> None:
    bundle = told(7.0)
    across = np.array([np.cos(bundle.yaw_rad), np.sin(bundle.yaw_rad), 0.0])
    near, beside = (replace(bundle, centre_m=bundle.centre_m + d * across) for d in (0.1, 0.2))
    lower = replace(near, top_z_m=TOP_M - 0.2)
    assert takes_another(bundle, [beside, near]) and not takes_another(bundle, [beside, lower])
    assert not takes_another(bundle, [])


def test_sigma_grows_with_the_pixel_and_the_slope_of_the_view() -> None:
    """Straps end where the map has the flanks; elsewhere 0.6 of what they differ adds to it."""
    bundle, seen = told(7.0), section(-0.13, 0.13)
    near = with_flanks(bundle, ends(-0.13, 0.13), seen, 0.0, 0.0)
    assert 0.005 < near.sigma.width_m < 0.008  # Drawn packs are 4.6 mm off (rms).
    coarse = [end._replace(pixel_m=0.02) for end in ends(-0.13, 0.13)]
    assert with_flanks(bundle, coarse, seen, 0.0, 0.0).sigma.width_m > 2 * near.sigma.width_m
    assert with_flanks(bundle, ends(-0.13, 0.13), seen, 0.0, 0.4).sigma.width_m > 2 * near.sigma.width_m
    assert with_flanks(bundle, ends(-0.13, 0.13, count=1), seen, 0.0, 0.0) is bundle


def test_straps_that_fade_or_run_into_dunnage_are_not_sure() -> None:
    """Straps that fade 30 mm before a rim that isn't seen; a beam in line with all of them on the floor."""
    beside = np.arange(-0.35, 0.35, 0.01)
    level = np.where(np.abs(beside) < 0.101, TOP_M, np.where(np.abs(beside) < 0.131, np.nan, 0.0))
    one = with_flanks(told(7.0), ends(-0.1, 0.1), MeanSection(beside, level, WIDTH_M), 0.0, 0.0)
    assert one.width_m + 2.5 * one.sigma.width_m > WIDTH_M and one.width_m == pytest.approx(0.2)
    beam = section(-0.13, 0.13)
    assert with_flanks(bundle := told(7.0), ends(-0.13, 0.19), beam, 0.0, 0.0) is bundle
    assert with_flanks(bundle, ends(-0.13, 0.14), beam, 0.0, 0.0) is not bundle
