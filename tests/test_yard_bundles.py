"""Bundles found in maps drawn from known geometry."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from numpy.typing import NDArray

from barsight.core.arrays import Float64
from barsight.core.errors import ConfigError
from barsight.core.records.heights import HeightSource
from barsight.yard.bundles import detection
from barsight.yard.bundles.bundle_kinds import listed_diameter
from barsight.yard.bundles.collinear_pieces import join_pieces
from barsight.yard.bundles.detection import _on, find_bundles
from barsight.yard.bundles.doubts import straighten
from barsight.yard.bundles.fitting.ends import middle_and_length_sigma
from barsight.yard.bundles.fitting.outline import TRIANGLE, bundle_width
from barsight.yard.bundles.fitting.outline_fit import AGREES, Fit, FittedOutline, compare_halves
from barsight.yard.bundles.fitting.outline_fit import Z as OUTLINE_Z
from barsight.yard.bundles.fitting.rotated_map import AlignedMap
from barsight.yard.bundles.fitting.settings import BundleSettings
from barsight.yard.bundles.headings import find_headings
from barsight.yard.bundles.irregular import widen_unended
from barsight.yard.bundles.layers import list_overlaps
from barsight.yard.bundles.reading import Reading
from barsight.yard.bundles.section.flanks import Flanks, _flank
from barsight.yard.bundles.section.laid_objects import measure_laid
from barsight.yard.bundles.section.seen_section import (
    SeenSection,
    _edge,
    estimate_section,
    is_no_hexagon,
    seen_section,
)
from barsight.yard.bundles.strapped_bundles import doubted_if_narrow, doubted_without_straps
from barsight.yard.lift_settings import UPPER
from barsight.yard.magnet.holding import min_diameter_m
from barsight.yard.placement.load import Load
from barsight.yard.types import Bundle, Doubt, DoubtKind, HeightMap
from barsight.yard.weight import bundle_mass
from lift_yards import record
from yard_maps import Laid, draw, photographed

SETTINGS = BundleSettings()


def nearest(bundles: tuple[Bundle, ...], laid: Laid) -> Bundle:
    place = np.array([laid.x_m, laid.y_m, laid.z_m])
    return min(bundles, key=lambda b: float(np.linalg.norm(b.centre_m - place)))


def expect(bundle: Bundle, laid: Laid) -> None:
    """All figures within three stated sigmas and within the limits that a crane needs."""
    yaw = np.radians(laid.yaw_deg)
    offset = bundle.centre_m - np.array([laid.x_m, laid.y_m, laid.z_m])
    lateral = offset[0] * np.cos(yaw) + offset[1] * np.sin(yaw)
    sigma = bundle.sigma
    assert abs(lateral) < min(3 * sigma.lateral_m, 0.010)
    turned = (bundle.yaw_rad - yaw + np.pi / 2) % np.pi - np.pi / 2
    assert abs(turned) < min(3 * sigma.yaw_rad, np.radians(0.2))
    assert abs(bundle.top_z_m - laid.top_z_m) < min(3 * sigma.top_z_m, 0.010)
    assert abs(bundle.width_m - laid.width_m) < 0.025
    if not any(bundle.ends_open):
        assert abs(bundle.length_m - laid.length_m) < 0.06


def test_two_touching_neighbours_and_one_apart_are_three_bundles() -> None:
    laid = [
        Laid(0.2, 0.0, 0.225, 0.3, roll_deg=5),
        Laid(0.48, 0.1, 0.225, 0.3, roll_deg=40),
        Laid(1.2, -0.2, 0.225, -0.8, roll_deg=20),
    ]
    bundles = find_bundles(draw(laid), SETTINGS)
    assert len(bundles) == 3
    for one in laid:
        expect(nearest(bundles, one), one)
    assert [b.is_free for b in bundles] == [True] * 3
    assert [b.layer for b in bundles] == [0] * 3
    assert bundles[0].neighbours == (1,) and bundles[1].neighbours == (0,) and bundles[2].neighbours == ()
    assert not any(any(b.ends_open) for b in bundles)


def test_thin_bars_are_found_by_their_outline() -> None:
    laid = [Laid(0.2, 0.0, 0.2, 0.2, 0.02, 61, roll_deg=1), Laid(0.6, 0.0, 0.25, 0.0, 0.04, 37, roll_deg=-1)]
    bundles = find_bundles(draw(laid), SETTINGS)
    assert len(bundles) == 2
    for one in laid:
        expect(nearest(bundles, one), one)


def test_single_heavy_bars_are_bundles_of_one() -> None:
    laid = [Laid(0.3, 0.0, 0.13, 0.5, 0.2, 1), Laid(0.56, 0.0, 0.13, 0.5, 0.2, 1)]
    bundles = find_bundles(draw(laid), SETTINGS)
    # Many thin bars, smoothed, may look the same.
    assert [b.bars for b in bundles] == [None, None]
    for one in laid:
        expect(nearest(bundles, one), one)


@dataclass(frozen=True)
class Bowed(Laid):
    """Bars whose middle lies this far beside the line through their ends; is_s: their quarters, to both
    sides.
    """

    bow_m: float = 0.012
    is_s: bool = False

    def over(self, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        v = 2 * (y - self.y_m) / self.length_m
        aside = self.bow_m * (np.sin(np.pi * v) if self.is_s else 1 - v**2)
        return super().over(x - aside, y)


def bowed(laid: Laid) -> tuple[Bundle, tuple[float, float]]:
    """Find the one bundle, and compare its halves."""
    found, make = [], detection.make_bundle
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(detection, "make_bundle", lambda *args: found.append(args[0].found) or make(*args))
        (bundle,) = find_bundles(draw([laid]), SETTINGS)
    return bundle, compare_halves(found[0], SETTINGS)


@pytest.mark.parametrize("length_m", [3.6, 1.5])
@pytest.mark.parametrize("bow_m", [0.012, 0.006])
def test_bars_that_bow_widen_the_heading(bow_m: float, length_m: float) -> None:
    laid = Bowed(0.6, 0.0, 0.225, 0.0, length_m=length_m, bow_m=bow_m)
    bundle, (bow, _) = bowed(laid)
    straight, (none, turn) = bowed(replace(laid, bow_m=0.0))
    assert bow == pytest.approx(4 * bow_m / length_m, rel=0.25)
    assert none < 2e-3 and turn < 1e-3
    assert bundle.sigma.yaw_rad**2 - straight.sigma.yaw_rad**2 > (0.1 * bow) ** 2
    assert np.radians(0.03) < straight.sigma.yaw_rad < np.radians(0.06) * 3.6 / length_m


def test_halves_that_run_on_another_heading_than_the_whole_widen_it() -> None:
    bundle, (_, turn) = bowed(Bowed(0.6, 0.0, 0.225, 0.0, length_m=3.6, is_s=True))
    assert turn > 0.5 * abs(bundle.yaw_rad) > np.radians(0.1)
    assert abs(bundle.yaw_rad) < 4 * bundle.sigma.yaw_rad


@pytest.mark.parametrize(("width_m", "bars", "is_doubted"), [
    (0.080, None, False), (0.110, None, True), (0.139, None, True), (0.145, None, False), (0.110, 2, False),
])  # fmt: skip
def test_less_than_two_bars_side_by_side_are_no_whole_bundle(
    width_m: float, bars: int | None, *, is_doubted: bool
) -> None:
    found = find_bundles(draw([Laid(0.6, 0.0, 0.225, 0.0)]), SETTINGS)[0]
    known = replace(found, width_m=width_m, bar_diameter_m=0.08, bars=bars, section_m2=0.02, confidence=0.95)
    told = doubted_if_narrow(known)
    assert (told is not known) == is_doubted == bool(np.isnan(bundle_mass(told).kg))
    assert (told.confidence < 0.5) == is_doubted


class HungBelow(Laid):
    """A hexagon of seven with a row of three more below it, which can't be seen from above."""

    @property
    def axes_m(self) -> NDArray[np.float64]:
        row = self.diameter_m * np.array([[k, -(3**0.5)] for k in (-1, 0, 1)])
        return np.concatenate([super().axes_m, row])


def test_bars_are_counted_only_where_nothing_may_hide_below() -> None:
    """Seven bars on the floor, seven on dunnage, and ten whose upper seven look like those."""
    stands, raised, ten = (
        Laid(0.0, 0.0, 0.163, 0.0, 0.11, roll_deg=25.0), Laid(0.8, 0.0, 0.178, 0.0, 0.08, roll_deg=0.0),
        HungBelow(1.6, 0.0, 0.178, 0.0, 0.08, roll_deg=0.0),
    )  # fmt: skip
    assert ten.axes_m[:, 1].min() + ten.z_m == pytest.approx(0.04, abs=0.001)
    bundles = find_bundles(draw([stands, raised, ten]), SETTINGS)
    assert [b.bars for b in bundles] == [7, None, None]
    for bundle, one, bars in zip(bundles, (stands, raised, ten), (7, 7, 10), strict=True):
        mass, told = bars * np.pi / 4 * one.diameter_m**2 * 3.0 * 7850, bundle_mass(bundle)
        if one is ten:
            # Hardly any pack is a fifth taller than wide: outside of its 95 %, within a lift's safety factor.
            assert mass < 1.2 * told.upper_kg
        else:
            assert abs(told.kg - mass) < 1.96 * told.sigma_kg
            assert mass < told.upper_kg


class Triangle(Laid):
    """One bar on two, as thick bars are strapped."""

    @property
    def axes_m(self) -> NDArray[np.float64]:
        rise = 0.75**0.5 / 2
        return self.diameter_m * np.array([[-0.5, -rise], [0.5, -rise], [0.0, rise]])

    @property
    def width_m(self) -> float:
        return 2 * self.diameter_m


def test_three_thick_bars_are_one_bundle_as_wide_as_two() -> None:
    """The upper bar alone was read, as a bundle of thin bars, half as wide and a third as heavy."""
    laid = [Triangle(0.2, 0.0, 0.3, 0.5, 0.1), Triangle(0.7, 0.1, 0.093, -0.3, 0.1), Laid(1.3, 0.0, 0.3, 0.0)]
    bundles = find_bundles(draw(laid), SETTINGS)
    assert len(bundles) == 3
    for one in laid:
        expect(nearest(bundles, one), one)
    raised, stands = (nearest(bundles, one) for one in laid[:2])
    assert raised.bars is None and stands.bars in (None, 3)
    for bundle in (raised, stands):
        assert bundle.bar_diameter_m == pytest.approx(0.1, abs=0.006)
        mass = bundle_mass(bundle)
        assert np.isnan(mass.kg) or 3 * np.pi / 4 * 0.1**2 * 3.0 * 7850 < 1.01 * mass.upper_kg


def test_a_pack_that_was_read_as_one_thin_bar_does_not_weigh_as_little() -> None:
    """A single bar's outline laid on a wide section is no single bar."""
    values = np.array([0.0, 0.0, 0.18, 0.0, 0.0, 0.111])
    empty = np.zeros(1, np.float32)
    fit = Fit(0, 0.0, values, np.zeros((6, 6)), 0, 0, empty.astype(np.uint8), empty, 0.001, 0.001)
    steel_m2 = 25 * np.pi / 4 * 0.04**2
    for width_m in (0.18, 0.2, 0.24):
        seen = SeenSection(width_m, 0.001, sides_seen=True, sides_free=True)
        assert is_no_hexagon(seen, fit, 0.235, 0.0)
        section, sigma = estimate_section(seen, fit, 0.235, 0.0)
        assert np.isnan(section) or section + 1.645 * sigma > steel_m2


def test_a_bundle_across_others_lies_on_them() -> None:
    laid = [Laid(0.3, 0.0, 0.2, 0.0), Laid(0.7, 0.0, 0.2, 1.0), Laid(0.5, 0.2, 0.47, 88.0, length_m=1.6)]
    bundles = find_bundles(draw(laid), SETTINGS)
    assert len(bundles) == 3
    for one in laid:
        expect(nearest(bundles, one), one)
    assert nearest(bundles, laid[2]).on_top is True
    assert nearest(bundles, laid[2]).layer == 1
    for lower in laid[:2]:
        bundle = nearest(bundles, lower)
        assert bundle.on_top is False
        assert any("lies on it" in doubt.sentence for doubt in bundle.reasons)


def test_a_stack_turned_by_30_degrees_is_found_whole() -> None:
    laid = [Laid(0.5, 0.0, 0.2, 30.0, length_m=2.0), Laid(0.9, 0.1, 0.2, 31.0, length_m=2.0)]
    bundles = find_bundles(draw(laid), SETTINGS)
    assert len(bundles) == 2
    for one in laid:
        expect(nearest(bundles, one), one)


def test_an_end_out_of_view_is_open() -> None:
    bundles = find_bundles(draw([Laid(0.5, 1.0, 0.2, 0.0)]), SETTINGS)
    assert len(bundles) == 1
    assert bundles[0].ends_open == (False, True)
    assert np.isnan(bundles[0].sigma.length_m)
    assert [doubt.end for doubt in bundles[0].reasons if doubt.end is not None] == [1]


def test_an_empty_floor_and_an_unknown_map_hold_no_bundle() -> None:
    assert find_bundles(draw([]), SETTINGS) == ()
    assert find_bundles(draw([], floor=False), SETTINGS) == ()


def test_the_bars_of_a_bundle_are_found_one_by_one() -> None:
    laid = Laid(0.5, 0.0, 0.3, 0.7, roll_deg=8)
    (bundle,) = find_bundles(draw([laid]), SETTINGS)
    true = laid.axes_m + np.array([0.0, laid.z_m])
    assert bundle.visible_bars == len(bundle.bar_axes) >= 3
    for bar in bundle.bar_axes:
        along = bar.centre_m[1] / np.cos(np.radians(0.7))
        place = np.array([bar.centre_m[0] - 0.5 + along * np.sin(np.radians(0.7)), bar.centre_m[2]])
        miss = np.abs(place - true)[np.linalg.norm(place - true, axis=1).argmin()]
        assert miss[0] < 4 * np.sqrt(bar.covariance[0, 0])
        assert miss[1] < 4 * np.sqrt(bar.covariance[1, 1])


@pytest.mark.parametrize(
    "change",
    [
        {"catalogue_mm": (0.5,)},
        {"catalogue_mm": (6.0, 8.0)},
        {"max_width_m": 0.05},
        {"slice_m": 0.0},
        {"max_skew_deg": 40.0},
    ],
)
def test_impossible_settings_are_refused(change: dict[str, object]) -> None:
    with pytest.raises(ConfigError):
        BundleSettings(**change)  # type: ignore[arg-type]


@pytest.mark.parametrize(("yaw_deg", "length_m"), [(88.0, 1.6), (12.0, 2.4)])
def test_a_slim_bundle_over_others_is_found_and_covers_them(yaw_deg: float, length_m: float) -> None:
    lower = [Laid(0.25 * k, 0.0, 0.2, 0.0, 0.04, 19, roll_deg=1) for k in range(5)]
    over = Laid(0.5, 0.2, 0.375, yaw_deg, 0.02, 61, length_m, roll_deg=2)
    bundles = find_bundles(draw([*lower, over]), SETTINGS)
    found = nearest(bundles, over)
    expect(found, over)
    assert found.on_top is True
    # Where it hides a bundle over more than 0.8 m, that bundle shows as two pieces.
    under = [b for b in bundles if b is not found and 0.2 < b.centre_m[0] < 0.8]
    assert len(under) >= 3 and not any(b.on_top for b in under)


def test_a_beam_over_bundles_is_no_bundle() -> None:
    lower = [Laid(0.3 * k, 0.0, 0.2, 0.0) for k in range(4)]
    heights = draw(lower)
    rows, columns = heights.z_m.shape
    x = heights.x0_m + heights.cell_m * np.arange(columns)
    y = heights.y0_m + heights.cell_m * np.arange(rows)
    noise = np.random.default_rng(3).normal(0, 0.003, heights.z_m.shape)
    for at, on_top, said in ((0.5, None, "lies across it"), (-0.8, True, "crosses over it at 2 places")):
        beam = (np.abs(y - at) < 0.05)[:, None] & ((x > -0.2) & (x < 1.2))[None]
        heights.z_m[beam] = (lower[0].top_z_m + 0.1 + noise[beam]).astype(np.float32)
        bundles = find_bundles(heights, SETTINGS)
        assert len(bundles) == 4 and all(b.on_top is on_top for b in bundles)
        assert all(any(said in doubt.sentence for doubt in b.reasons) for b in bundles)
        assert not any(b.is_free for b in bundles)


@pytest.mark.parametrize(
    ("from_axis_m", "rise_m", "width_m", "is_free"),
    [(0.06, 0.14, 0.1, False), (0.06, 0.14, 0.02, True), (0.06, 0.01, 0.1, True), (0.15, 0.14, 0.1, True)],
)
def test_a_beams_end_on_a_flank_holds_the_bundle_down(
    from_axis_m: float, rise_m: float, width_m: float, *, is_free: bool
) -> None:
    """Not what is narrower than 40 mm, as straps are, or ends beside the bundle, 0.27 m wide."""
    heights = draw([Laid(0.0, 0.0, 0.2, 0.0)])
    rows, columns = heights.z_m.shape
    x = heights.x0_m + heights.cell_m * np.arange(columns)
    y = heights.y0_m + heights.cell_m * np.arange(rows)
    heights.z_m[(np.abs(y - 0.6) < width_m / 2)[:, None] & (x > from_axis_m)[None]] += rise_m
    (bundle,) = [b for b in find_bundles(heights, SETTINGS) if abs(b.centre_m[0]) < 0.05]
    assert bundle.is_free is is_free


def _reading_of(
    z_m: Float64, width_m: float, *, pack_only: bool = False, views: Float64 | None = None
) -> Reading:
    """Describe a bundle by its heights, its top at 0.24 m. pack_only: the fit has the topmost bar alone."""
    fitted_m = width_m / 4 if pack_only else width_m
    values = np.zeros(6)
    values[OUTLINE_Z] = 0.24 - fitted_m / 2
    fit = SimpleNamespace(width_m=fitted_m, first=0, last=len(z_m) - 1, v_m=0.0, values=values)
    pack = SimpleNamespace(
        is_bounded=True, low_m=-width_m / 2, high_m=width_m / 2, width_m=width_m, top_m=fitted_m / 2
    )
    views = np.full_like(z_m, 5) if views is None else views
    grid = SimpleNamespace(
        z_m=z_m, sigma_m=np.full_like(z_m, 0.003), views=views, cell_m=0.01, u0_m=-width_m / 2, v0_m=-1.0
    )
    reading = SimpleNamespace(found=SimpleNamespace(grid=grid, fit=fit), pack=pack if pack_only else None)
    return cast(Reading, reading)


@pytest.mark.parametrize(
    ("sunk_from_m", "own_m", "top_m", "laid_m"),
    [(0.085, 0.0, 0.1, 0.0), (0.085, 0.0, 0.2, 0.2), (0.085, 0.06, 0.1, 0.04), (0.0, 0.0, 0.1, 0.1)],
)
@pytest.mark.parametrize("pack_only", [False, True])
def test_dunnage_that_shows_in_a_gully_lies_beside_the_bundle(
    sunk_from_m: float, own_m: float, top_m: float, laid_m: float, *, pack_only: bool
) -> None:
    """A bundle is read 0.24 m wide, up to 0.24 m high. From one place on, to its rim or over 30 mm inside it,
    own_m shows, and at one place along it what is top_m high.
    """
    v, u = 0.01 * np.arange(200) - 1, 0.01 * np.arange(25) - 0.12
    sunken = (u > sunk_from_m) & (u < sunk_from_m + 0.045)
    z = np.where(sunken, own_m, 0.24) + np.zeros((200, 1))
    z[(np.abs(v) < 0.05)[:, None] & sunken[None]] = top_m
    laid = measure_laid(straighten(_reading_of(z, 0.24, pack_only=pack_only)))
    assert laid == (pytest.approx(laid_m), laid_m > 0)


@pytest.mark.parametrize(("aside_m", "over_m"), [(0.0, 0.0), (0.04, 0.0), (0.0, 0.03), (0.04, 0.03)])
def test_a_bow_is_not_another_thing(aside_m: float, over_m: float) -> None:
    """Flanks fall by 25 mm a cell. At both ends the bundle lies aside, and something may lie over its top."""
    v, u = 0.01 * np.arange(200) - 1, 0.01 * np.arange(25) - 0.12
    bow = aside_m * v[:, None] ** 2
    z = 0.24 - 2.5 * np.maximum(np.abs(np.round(u - bow, 2)) - 0.06, 0.0)
    z[80:90, 10:18] += over_m
    laid, is_clear = measure_laid(straighten(_reading_of(z, 0.24)))
    assert laid < over_m + 0.026 and is_clear is (over_m > 0)


@pytest.mark.parametrize("length", [20, 40, 80])
def test_a_bar_beside_a_flank_is_not_taken_for_a_bow(length: int) -> None:
    """The other flank isn't seen. Over 0.2 to 0.8 m the flank, of 45 degrees, lies 40 mm out."""
    u = 0.01 * np.arange(25) - 0.12
    z = np.tile(0.24 - np.maximum(np.abs(u) - 0.06, 0.0), (200, 1))
    z[80 : 80 + length] = 0.24 - np.maximum(np.abs(u) - 0.1, 0.0)
    z[:, u < -0.06] = np.nan
    assert measure_laid(straighten(_reading_of(z, 0.24))) == (pytest.approx(0.04), True)


def test_nothing_is_known_to_lie_on_a_bundle_without_rows() -> None:
    assert measure_laid(straighten(_reading_of(np.full((10, 25), 0.24), 0.24))) == (0.0, False)


def test_a_flank_that_ends_early_is_not_clearly_another_thing() -> None:
    """Over 60 mm the flank, which falls by 25 mm a cell, reaches a cell further."""
    u = 0.01 * np.arange(25) - 0.12
    z = np.tile(0.24 - 2.5 * np.maximum(np.abs(u) - 0.06, 0.0), (200, 1))
    z[80:86] = 0.24 - 2.5 * np.maximum(np.abs(u) - 0.07, 0.0)
    assert measure_laid(straighten(_reading_of(z, 0.24))) == (pytest.approx(0.025), False)


@pytest.mark.parametrize(("lost", "is_found"), [(0, True), (2, True), (6, False)])
def test_what_lies_on_a_bundle_is_found_though_matching_loses_its_edge(lost: int, *, is_found: bool) -> None:
    """A beam's end, 60 mm wide, lies on a bundle. lost: places of a row, from its edge on, that aren't known;
    in every other row all but the first of them.
    """
    z = np.full((200, 25), 0.24)
    z[80:86, 20:] += 0.06
    for row in range(80, 86):
        z[row, 20 + row % 2 : 20 + lost] = np.nan
    assert (measure_laid(straighten(_reading_of(z, 0.24)))[0] > 0) is is_found


@pytest.mark.parametrize(
    ("views", "row_views", "clear"), [(4, 10, False), (4, 4, False), (7, 10, True), (np.inf, 10, True)]
)
def test_a_flank_that_few_views_tell_is_not_clearly_another_thing(
    views: float, row_views: float, *, clear: bool
) -> None:
    """Over 0.1 m the last 30 mm of a flank lie 45 mm too high. Of ten views some tell these rows, of those
    some tell the flank; or the laser does.
    """
    u = 0.01 * np.arange(25) - 0.12
    z = np.tile(0.24 - np.maximum(np.abs(u) - 0.03, 0.0), (200, 1))
    told = np.full_like(z, 10)
    z[80:90, -3:] += 0.045
    told[80:90] = row_views
    told[80:90, -3:] = views
    assert measure_laid(straighten(_reading_of(z, 0.24, views=told))) == (pytest.approx(0.045), clear)


def test_outlines_that_overlap_leave_open_which_bundle_lies_over_the_other() -> None:
    (one,) = find_bundles(draw([Laid(0.0, 0.0, 0.2, 0.0)]), SETTINGS)
    for overlap_m, up_ratio, top_ratio, is_free in (
        (0.03, -0.1, -0.1, False), (0.005, -0.1, -0.1, True), (0.03, -0.2, -0.2, True),
        (0.03, -0.2, 0.0, False),
    ):  # fmt: skip
        away_m = np.array([one.width_m - overlap_m, 0.0, up_ratio * one.width_m])
        top_z_m = one.top_z_m + top_ratio * one.width_m
        other = replace(one, id=1, centre_m=one.centre_m + away_m, top_z_m=top_z_m)
        assert (not list_overlaps(one, [one, other])) is is_free
        assert (not list_overlaps(other, [one, other])) is (overlap_m < 0.02)


@pytest.mark.parametrize(
    ("bars", "diameter_m", "roll_deg"),
    [(61, 0.016, 25.0), (61, 0.02, 10.0), (37, 0.02, 10.0), (19, 0.03, 25.0)],
)
def test_bars_that_cannot_be_counted_may_be_as_thin_as_they_are(
    bars: int, diameter_m: float, roll_deg: float
) -> None:
    """A map of 10 mm reads thin bars as one, or as others of two and three times their diameter."""
    one = Laid(0.0, 0.0, 0.3, 0.0, diameter_m, bars, 3.0, roll_deg)
    (bundle,) = find_bundles(draw([one]), SETTINGS)
    assert bundle.bars is None
    assert min_diameter_m(bundle) < diameter_m


def test_what_has_no_flanks_is_no_bundle() -> None:
    """A plate of 0.4 by 1.2 m at the bundle's height, as a cart's top is."""
    heights = draw([Laid(0.0, 0.0, 0.2, 0.0)])
    rows, columns = heights.z_m.shape
    x = heights.x0_m + heights.cell_m * np.arange(columns)
    y = heights.y0_m + heights.cell_m * np.arange(rows)
    plate = (np.abs(y) < 0.6)[:, None] & (np.abs(x - 0.7) < 0.2)[None]
    noise = np.random.default_rng(4).normal(0, 0.003, plate.shape)
    heights.z_m[plate] = (0.5 + noise[plate]).astype(np.float32)
    heights.source[plate] = HeightSource.VISION
    bundles = find_bundles(heights, SETTINGS)
    assert [abs(b.centre_m[0]) < 0.02 for b in bundles] == [True]


def test_a_neighbour_that_may_lie_over_a_flank_leaves_open_what_lies_on_it() -> None:
    """A map shows 0.1 m of a free flank of 0.25 m; what rolled over it hides most of that."""
    for fall, rise, is_seen in ((0.1, 0.1, True), (0.03, 0.1, False), (0.04, 0.4, True), (0.01, -0.1, False)):
        assert (not Flanks(0.25, (0.1, fall), (-np.inf, rise), False).doubt) is is_seen, (fall, rise)
    for fall, is_sure in ((0.07, False), (0.08, True)):
        flanks = Flanks(0.25, (0.1, fall), (-np.inf, 0.1), False)
        assert not flanks.doubt and (not flanks.cover_doubt) is is_sure


@pytest.mark.parametrize(
    ("behind_m", "fall_m", "rise_m"),
    [(-np.inf, np.inf, -np.inf), (-0.2, np.inf, -0.2), (-0.1, 0.02, 0.1), (np.nan, 0.02, 0.1)],
)
def test_a_sheer_flank_is_seen_where_what_shows_behind_is_deeper_than_the_bundle(
    behind_m: float, fall_m: float, rise_m: float
) -> None:
    """A top 0.28 m wide falls by 20 mm; behind 40 mm out of sight and 40 mm more a higher bundle begins."""
    outwards = np.arange(-14, 30) * 0.01
    level = np.where(outwards < 0.135, np.where(outwards > 0.1, -0.02, 0.0), np.nan)
    level[(outwards > 0.175) & (outwards < 0.215)] = behind_m
    level[outwards > 0.215] = 0.1
    assert _flank(outwards, level, 0.0, 0.28) == (0.02, fall_m, rise_m)


@pytest.mark.parametrize("rise_m", [-0.02, 0.0, 0.01, 0.08])
def test_a_bar_along_a_flank_hides_it_where_floor_shows_just_behind(rise_m: float) -> None:
    outwards = np.arange(-14, 30) * 0.01
    level = np.where(outwards > 0.08, rise_m, 0.0)
    level[outwards > 0.175] = -np.inf
    fall_m = _flank(outwards, level, 0.0, 0.28)[1]
    assert fall_m == pytest.approx(-rise_m)


def test_a_side_that_nothing_shows_to_end_may_go_on() -> None:
    """Two outlines that share a bundle miss each other's part: half a width, on one side each."""
    nothing = Reading(cast(FittedOutline, None), 1.0, None, 0.0, None)
    for falls_m, sides in (((0.1, 0.1), 0), ((0.02, 0.1), 1), ((0.02, 0.03), 2)):
        flanks = Flanks(0.2, falls_m, (-np.inf, -np.inf), False)
        assert replace(nothing, flanks=flanks).unended_sides == sides
    bundle = record(Laid(0.0, 0.0, 0.2, 0.0))
    for sides, off_m in ((0, 0.0), (1, bundle.width_m / 2), (2, bundle.width_m / 2)):
        sigma = widen_unended(bundle, sides).sigma
        side_m = float(np.hypot(sigma.lateral_m, sigma.width_m / 2))
        assert off_m < 1.96 * side_m and (sides or side_m < 0.02)


@pytest.mark.parametrize(("rise_m", "is_free"), [(-0.05, True), (0.15, False), (0.4, False)])
def test_a_flank_out_of_sight_may_lie_under_what_stands_higher(rise_m: float, *, is_free: bool) -> None:
    lower = Laid(0.0, 0.0, 0.15, 0.0)
    heights = draw([lower])
    x = heights.x0_m + heights.cell_m * np.arange(heights.z_m.shape[1])
    unseen, beside = (x > 0.04) & (x < 0.17), (x >= 0.17) & (x < 0.4)
    heights.z_m[:, unseen], heights.source[:, unseen] = np.nan, HeightSource.UNKNOWN
    heights.z_m[:, beside] = lower.top_z_m + rise_m
    found = min(find_bundles(heights, SETTINGS), key=lambda one: abs(one.centre_m[0]))
    assert found.is_free is is_free and (found.on_top is True) is is_free


@pytest.mark.parametrize(("z_m", "straps_m", "photo_to_m", "is_sure"), [
    (0.3, (), 2.0, False), (0.3, (-1.0, 0.1, 1.0), 2.0, True), (0.3, (-1.0, 0.1, 1.0), 0.0, False),
    (0.3, (), 0.0, False), (0.134, (), 2.0, True),
])  # fmt: skip
def test_bars_that_no_straps_hold_may_lie_loose_unless_they_are_counted(
    z_m: float, straps_m: tuple[float, ...], photo_to_m: float, *, is_sure: bool
) -> None:
    """At 0.3 m it stands too high for the full bundle that it is, and can't be counted. Without a photo, or
    with one that ends at its middle and shows one strap, nothing tells that it is held.
    """
    laid = Laid(0.5, 0.0, z_m, 0.0)
    heights = draw([laid])
    (bundle,) = find_bundles(heights, SETTINGS)
    assert bundle.confidence > 0.9
    assert (doubted_without_straps(bundle).confidence > 0.9) is (bundle.bars is not None) is (z_m < 0.2)
    heights = photographed(heights, [laid])
    assert heights.gray is not None
    y = heights.y0_m + heights.cell_m * np.arange(heights.z_m.shape[0])
    for at in straps_m:
        heights.gray[np.abs(y - at) < 0.02] = 10
    heights.gray[y > photo_to_m] = 0
    (bundle,) = find_bundles(heights, SETTINGS)
    assert (doubted_without_straps(bundle).confidence > 0.9) is is_sure
    assert any(doubt.kind is DoubtKind.NO_STRAPS for doubt in bundle.reasons) is not is_sure


def test_two_readings_of_one_bundle_are_joined() -> None:
    (one,) = find_bundles(draw([Laid(0.0, 0.0, 0.2, 0.0)]), SETTINGS)
    step = np.array([0.004, 1.0, 0.0])
    pieces = [
        replace(
            one, centre_m=one.ends_m.mean(axis=0) + side * step, ends_m=one.ends_m + side * step,
            ends_open=(side > 0, side < 0),
        )
        for side in (-(one.length_m / 2 + 0.1), one.length_m / 2 + 0.1)
    ]  # fmt: skip
    (whole,) = join_pieces(pieces)
    assert whole.length_m == pytest.approx(2 * one.length_m + 0.2, abs=1e-3) and whole.ends_open == (
        False,
        False,
    )
    assert whole.sigma.lateral_m > one.sigma.lateral_m
    wide = replace(pieces[1], bars=None, width_m=1.4 * one.width_m, section_m2=2 * one.section_m2)
    (mixed,) = join_pieces([replace(pieces[0], bars=None, length_m=one.length_m + 0.01), wide])
    assert bundle_mass(mixed).upper_kg > 1.5 * bundle_mass(mixed).kg, "one piece holds twice the steel"
    doubt = Doubt(DoubtKind.NO_STRAPS, "the photo shows no straps that hold it")
    for strapped in ((True, False), (False, True), (False, False)):
        told = [
            replace(piece, reasons=() if has_straps else (doubt,))
            for piece, has_straps in zip(pieces, strapped, strict=True)
        ]
        (whole,) = join_pieces(told)
        assert (doubt in whole.reasons) is not any(strapped)
    assert len(join_pieces([replace(piece, ends_open=(False, False)) for piece in pieces])) == 2


def test_a_bar_along_a_bundle_five_times_as_wide_lies_on_it() -> None:
    laid = Laid(0.7, 0.0, 0.2155, 0.0, bars=19)
    bar = Laid(0.7, 0.0, laid.top_z_m + 0.033, 0.0, bars=1, length_m=2.0)
    found = find_bundles(draw([laid, bar]), SETTINGS)
    assert nearest(found, laid).on_top is False and nearest(found, bar).on_top


def test_a_bundle_of_the_next_row_is_no_neighbour_at_a_flank() -> None:
    laid = Laid(0.7, -1.7, 0.1355, 0.0)
    (alone,) = find_bundles(draw([laid], y_m=(-3.7, 3.7)), SETTINGS)
    for aside_m in (0.0, 0.1):
        row = [laid, replace(laid, x_m=laid.x_m + aside_m, y_m=1.7)]
        found = nearest(find_bundles(draw(row, y_m=(-3.7, 3.7)), SETTINGS), laid)
        assert found.bars == alone.bars and found.section_m2 == pytest.approx(alone.section_m2, rel=0.03)


@pytest.mark.parametrize("gap_m", [0.02, 0.04, 0.06, 0.08, 0.1])
def test_a_gap_parts_two_bundles_end_to_end(gap_m: float) -> None:
    laid = Laid(0.7, -1.6, 0.12, 0.0, diameter_m=0.05, bars=19)
    behind = replace(laid, y_m=laid.y_m + laid.length_m + gap_m)
    found = find_bundles(draw([laid, behind], y_m=(-3.5, 3.5)), SETTINGS)
    for bundle in found:
        assert any(bundle.ends_open) if len(found) == 2 else bundle.confidence < 0.5
        doubts = [doubt for doubt in bundle.reasons if doubt.kind is DoubtKind.GAP]
        assert doubts and [Doubt.read(doubt.sentence) for doubt in doubts] == doubts


def test_ripples_of_the_floor_are_no_heading() -> None:
    """Matching ripples a flat floor along the pictures' columns; the bars alone say how bundles lie."""
    x, y = np.meshgrid(0.01 * np.arange(900), 0.01 * np.arange(400))
    turned = np.cos(np.radians(4.2)) * x + np.sin(np.radians(4.2)) * y
    z = 0.004 * np.sin(2 * np.pi * turned / 0.15)
    stack = x < 2.0
    z[stack] = 0.3 + np.sqrt(0.045**2 - (np.mod(x[stack], 0.09) - 0.045) ** 2)
    flat = np.full(z.shape, 0.005, np.float32)
    seen = np.full(z.shape, HeightSource.VISION, np.uint8)
    height_map = HeightMap(0.0, 0.0, 0.01, z.astype(np.float32), flat, flat + 3, seen)
    assert find_headings(height_map, 3.0) == (0.0,)
    part = height_map.part(slice(0, 150), slice(140, 900))
    steeper = replace(part, z_m=np.where(part.z_m < 0.1, 8 * part.z_m, part.z_m))
    assert find_headings(steeper, 3.0) != (0.0,)
    assert find_headings(steeper, 3.0, stock_over_m=0.05) == (0.0,)


@pytest.mark.parametrize(("rings", "top_m", "is_on"), [(0, 0.052, False), (0, 0.061, True), (1, 0.052, True)])
def test_a_thin_bar_on_the_floor_is_no_bundle(rings: int, top_m: float, is_on: bool) -> None:
    """A map shows its flanks too wide; its top over the floor says how thick it can be."""
    width = 0.063
    state, gain = np.ones(100, np.uint8), np.ones(100, np.float32)
    diameter = width / bundle_width(rings, 1.0)
    values = np.array([0.0, 0.0, 1.0 + top_m - width / 2, 0.0, 0.0, diameter])
    fit = Fit(rings, 0.0, values, np.zeros((6, 6)), 0, 99, state, gain, 0.0, 0.0)
    assert _on(1.0, fit, SETTINGS) == is_on


@pytest.mark.parametrize(
    ("behind", "begins", "seen"),
    [(-0.09, False, False), (-0.3, False, True), (-np.inf, False, True), (-0.09, True, True)],
)
def test_what_shows_behind_a_steep_flank_may_be_a_bundles_own_lower_bars(
    behind: float, begins: bool, seen: bool
) -> None:
    """A crest 0.1 m wide, four places out of sight, then a shelf: as deep as lower bars, or deeper."""
    level = np.concatenate([np.zeros(6), np.full(4, np.nan), np.full(8, behind)])
    another = np.arange(18) >= (9 if begins else 18)
    last, is_seen, is_free = _edge(level, another, 0, 1, 0.1, np.inf, -0.2, 12)
    assert (last, is_seen, is_free) == (5, seen, behind == -np.inf)


@pytest.mark.parametrize(("deep_m", "seen"), [(0.09, False), (0.12, False), (0.14, True)])
def test_a_gully_parts_two_bundles_of_thick_bars_if_no_bar_one_layer_down_leaves_it(
    deep_m: float, seen: bool
) -> None:
    """Six bars of 80 mm were told as the three that show highest, half their mass."""
    cell, diameter = 0.01, 0.085
    u = cell * np.arange(-30, 31)
    level = np.where(np.abs(u) > 0.08, 0.43, 0.5 - deep_m * (u / 0.08) ** 2)
    z = np.tile(level.astype(np.float32), (40, 1))
    grid = AlignedMap(0.0, float(u[0]), 0.0, cell, z, np.full_like(z, 0.003), np.full_like(z, 5), 0.05)
    fits = [
        Fit(
            TRIANGLE, 0.2, np.array([at, 0.0, 0.42, 0.0, 0.0, diameter]), np.zeros((6, 6)), 0, 39,
            np.full(40, AGREES, np.uint8), np.ones(40, np.float32), 0.0, 0.0,
        )
        for at in (-0.17, 0.0, 0.17)
    ]  # fmt: skip
    left, one, right = (FittedOutline(grid, fit) for fit in fits)
    section = seen_section(one, [left, right], 0.01)
    assert section is not None and section.sides_seen == seen


def test_what_is_out_of_sight_beside_a_section_makes_it_unsure() -> None:
    """Four places behind the low side and seven behind the high one are out of sight, then floor."""
    u = 0.01 * np.arange(-30, 31)
    level = np.where(np.abs(u) < 0.085, 0.5 - 4 * u**2, 0.0)
    sights = []
    for hidden in (np.zeros(61, bool), ((u < -0.085) & (u > -0.125)) | ((u > 0.085) & (u < 0.155))):
        z = np.tile(np.where(hidden, np.nan, level).astype(np.float32), (40, 1))
        grid = AlignedMap(0.0, float(u[0]), 0.0, 0.01, z, np.full_like(z, 0.003), np.full_like(z, 5), 0.05)
        values = np.array([0.0, 0.0, 0.42, 0.0, 0.0, 0.17 / bundle_width(1, 1.0)])
        state, gain = np.full(40, AGREES, np.uint8), np.ones(40, np.float32)
        fit = Fit(1, 0.2, values, np.zeros((6, 6)), 0, 39, state, gain, 0.0, 0.0)
        seen = seen_section(FittedOutline(grid, fit), [], 0.01)
        assert seen is not None and seen.sides_seen
        own, along = (
            estimate_section(seen, fit, 0.5, 0.0, is_along_baseline=is_along) for is_along in (False, True)
        )
        sights.append((seen.hidden_m, own, along))
    (none_m, (section, sigma), along), (hidden_m, (same, wider), all_hidden) = sights
    assert none_m == (0.0, 0.0) and hidden_m == pytest.approx((0.04, 0.07)) and along == (section, sigma)
    assert same == pytest.approx(section, rel=0.01) and wider > 1.2 * sigma
    # Along the baseline bars may fill all of what wasn't seen: (0.17 + 0.11)^2 / 0.17^2 is 2.7.
    assert 2.7 * section < all_hidden[0] + UPPER * all_hidden[1] < 3.2 * section
    assert same + UPPER * wider < 1.9 * section


def test_bars_along_the_baseline_may_go_on_where_nothing_was_seen() -> None:
    heights = draw([Laid(0.3, 0.0, 0.35, 0.0, bars=19, diameter_m=0.04)])
    x = heights.x0_m + heights.cell_m * np.arange(heights.z_m.shape[1])
    unseen = (x > 0.38) & (x < 0.45)
    heights.z_m[:, unseen], heights.source[:, unseen] = np.nan, HeightSource.UNKNOWN
    yaw = np.radians([0.0, 20.0, 40.0, 90.0])
    upper = []
    for baseline in (None, *np.column_stack([-np.sin(yaw), np.cos(yaw)])):
        (found,) = find_bundles(heights, SETTINGS, baseline)
        upper.append(found.section_m2 + UPPER * found.sigma.section_m2)
    assert upper[1] > 1.1 * upper[0] and upper[1:3] == [upper[1]] * 2 and upper[3:] == [upper[0]] * 2


def test_a_single_bar_may_roll_whatever_is_listed() -> None:
    heights = draw([Laid(0.3, 0.0, 0.13, 0.5, 0.2, 1)])
    for listed_mm, least_m in (((), 0.02), ((150.0, 200.0), 0.15), ((20.0, 60.0, 120.0, 160.0, 200.0), 0.02)):
        (found,) = find_bundles(heights, replace(SETTINGS, catalogue_mm=listed_mm))
        bundle = listed_diameter(found, listed_mm)
        assert bundle.bars is None and min_diameter_m(bundle) == pytest.approx(least_m, rel=0.05)
        assert Load.of((bundle,)).rolls


@pytest.mark.parametrize(
    ("told_mm", "sigma_mm", "listed_mm", "mean_mm", "least_mm"),
    [
        (110.0, 66.0, (), 110.0, 11.0),
        (110.0, 66.0, (100.0, 120.0), 110.0, 100.0),
        (110.0, 66.0, (20.0, 110.0), 85.0, 20.0),
        (110.0, 66.0, (20.0, 80.0, 90.0, 100.0, 110.0, 120.0, 130.0), 100.0, 20.0),
        (110.0, 40.0, (20.0, 50.0, 110.0), 93.0, 50.0),
        (84.0, 5.0, (40.0, 90.0), 90.0, 88.0),
        (100.0, 6.0, (85.0, 117.0), 94.3, 85.0),
        (100.0, 6.0, (88.0, 111.4), 100.8, 88.0),
        (90.0, 5.0, (40.0,), 90.0, 81.0),
    ],
    ids=[
        "no list", "thick bars alone", "thin bars too", "many thick bars", "thin bars that it can't be",
        "one of them", "a thin one is the likeliest", "a thin one is nearly as likely", "none of them",
    ],
)  # fmt: skip
def test_a_catalogue_narrows_the_diameters_that_it_leaves(
    told_mm: float, sigma_mm: float, listed_mm: tuple[float, ...], mean_mm: float, least_mm: float
) -> None:
    (bundle,) = find_bundles(draw([Laid(0.0, 0.0, 0.2, 0.0)]), SETTINGS)
    sigma = replace(bundle.sigma, bar_diameter_m=sigma_mm / 1e3)
    told = replace(bundle, bars=None, bar_diameter_m=told_mm / 1e3, sigma=sigma, confidence=0.95)
    listed = listed_diameter(told, listed_mm)
    assert 1e3 * listed.bar_diameter_m == pytest.approx(mean_mm, abs=2)
    assert 1e3 * min_diameter_m(listed) == pytest.approx(least_mm, abs=2)
    assert (listed.confidence < 0.5) == (listed_mm == (40.0,))


def test_both_ends_err_outwards_alike() -> None:
    """The middle is surer, the length less sure than of ends that err each for itself."""
    rng = np.random.default_rng(7)
    outwards = rng.multivariate_normal([0, 0], [[1, 0.6 * 2], [0.6 * 2, 4]], 20_000)
    middle, length = middle_and_length_sigma((1.0, 2.0))
    assert np.std(outwards[:, 1] - outwards[:, 0]) / 2 == pytest.approx(middle, rel=0.03)
    assert np.std(outwards.sum(axis=1)) == pytest.approx(length, rel=0.03)
    assert np.isnan(middle_and_length_sigma((np.nan, 1.0))).all()
