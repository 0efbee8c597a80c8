"""Bars that lie along on a bundle, in maps drawn from known geometry."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import yard_maps
from barsight.yard.bundles.detection import find_bundles
from barsight.yard.bundles.fitting.settings import BundleSettings
from barsight.yard.bundles.section import straps
from barsight.yard.bundles.section.laid_objects import StraightSections, measure_along, measure_laid
from barsight.yard.types import Bundle
from yard_maps import Laid, draw, photographed

SETTINGS = BundleSettings()
BELOW = Laid(0.0, 0.0, 0.2, 0.0, 0.032, 37, roll_deg=0.0)


def in_groove(bar_m: float, length_m: float = 3.0, y_m: float = 0.0) -> Laid:
    """A bar in the groove between the two middle ones of the topmost four."""
    rise = np.sqrt(((bar_m + BELOW.diameter_m) / 2) ** 2 - (BELOW.diameter_m / 2) ** 2)
    axis_z_m = BELOW.z_m + BELOW.axes_m[:, 1].max() + rise
    return Laid(0.0, y_m, axis_z_m, 0.0, bar_m, 1, length_m=length_m)


def said(bundle: Bundle) -> list[str]:
    return [doubt.sentence for doubt in bundle.cover_doubts]


@pytest.mark.parametrize(("bar_m", "is_told"), [(0.04, True), (0.05, True), (None, False)])
def test_a_bar_that_lies_along_on_a_bundle_covers_it(bar_m: float | None, *, is_told: bool) -> None:
    """Neither width nor top tells."""
    stock = [BELOW] if bar_m is None else [BELOW, in_groove(bar_m)]
    (found,) = find_bundles(draw(stock, x_m=(-0.6, 0.6), sigma_m=0.002), SETTINGS)
    assert any("lies along on it" in sentence for sentence in said(found)) is is_told
    assert bool(said(found)) is is_told


@pytest.mark.parametrize("part", [0.3, 0.5, 0.7])
def test_a_bar_along_on_a_part_of_a_bundle_is_higher_than_the_rest(part: float) -> None:
    """It rises by 15 to 20 mm. Half as long as the bundle, it is in the median along it."""
    bar = in_groove(0.025, 3 * part, 1.5 * (1 - part))
    found = find_bundles(draw([BELOW, bar], x_m=(-0.6, 0.6), sigma_m=0.002), SETTINGS)
    (below,) = [one for one in found if one.width_m > 0.15]
    assert any("lies along on it" in sentence for sentence in said(below)) and not below.is_free


@pytest.mark.parametrize("bar_m", [None, 0.03])
def test_a_bundle_that_sags_between_its_timbers_has_no_bar_on_it(bar_m: float | None) -> None:
    """Its ends and its middle lie 18 mm higher. A bar on one of them is told nevertheless."""
    below = replace(BELOW, length_m=6.0)
    bars = [] if bar_m is None else [in_groove(bar_m, 1.2, 2.2)]
    heights = draw([below, *bars], x_m=(-0.6, 0.6), y_m=(-3.2, 3.2), sigma_m=0.002)
    y = heights.y0_m + heights.cell_m * np.arange(heights.z_m.shape[0])
    sag_m = 0.009 * (1 - np.cos(2 * np.pi * y / 3.0))[:, None]
    heights.z_m[:] -= np.where(heights.z_m > 0.1, sag_m, 0).astype(np.float32)
    found = max(find_bundles(heights, SETTINGS), key=lambda one: one.width_m)
    assert any("lies along on it" in sentence for sentence in said(found)) is (bar_m is not None)
    assert found.length_m > 5.8


VIEWS = np.full((200, 25), 5.0)


def test_a_ridge_over_the_fitted_outline_lies_along_whatever_the_straps_bound() -> None:
    """A pack's top, which straps bound, holds the bar."""
    beside = 0.01 * np.arange(25) - 0.12
    z = np.tile(np.where(np.abs(beside) < 0.025, 0.27, 0.24), (200, 1))
    sure = np.zeros_like(z)
    rises = (pytest.approx(0.03), pytest.approx(0.03))
    assert measure_along(StraightSections(z, sure, VIEWS, 0.15, 0.24, 0.24, 0.01)) == rises
    assert measure_along(StraightSections(z, sure, VIEWS, 0.15, 0.27, 0.24, 0.01)) == (0.0, 0.0)


def test_what_a_map_is_unsure_of_only_may_lie_along() -> None:
    """A fifth of the crest is 30 mm too high, and its sigma exceeds the others by 5 or 20 mm."""
    beside = 0.01 * np.arange(25) - 0.12
    z = np.full((200, 25), 0.24)
    z[80:120, np.abs(beside) < 0.025] = 0.27
    for unsure_m, sure in ((0.005, 0.025), (0.02, 0.01)):
        unsure = np.where(z > 0.25, unsure_m, 0.0)
        rises = (pytest.approx(0.03), pytest.approx(sure))
        assert measure_along(StraightSections(z, unsure, VIEWS, 0.15, 0.24, 0.24, 0.01)) == rises


@pytest.mark.parametrize(("unsure_m", "is_clear"), [(0.01, True), (0.025, False)])
def test_what_a_map_is_unsure_of_only_may_lie_on_a_bundle(unsure_m: float, *, is_clear: bool) -> None:
    """A patch of 0.1 m by 40 mm is 40 mm too high."""
    z = np.full((200, 25), 0.24)
    z[80:90, 20:24] = 0.28
    unsure = np.where(z > 0.25, unsure_m, 0.0)
    laid = measure_laid(StraightSections(z, unsure, VIEWS, 0.12, 0.24, 0.24, 0.01))
    assert laid == (pytest.approx(0.04), is_clear)


@pytest.mark.parametrize("is_bare", [True, False])
def test_no_strap_crosses_a_bar_that_lies_along(*, is_bare: bool) -> None:
    """The bar is as long as the bundle, and no higher than a map's smoothing leaves open."""
    bar = in_groove(0.032)
    heights = photographed(draw([BELOW, bar], x_m=(-0.6, 0.6), sigma_m=0.002), [BELOW, bar])
    assert heights.gray is not None
    x = heights.x0_m + heights.cell_m * np.arange(heights.z_m.shape[1])
    y = heights.y0_m + heights.cell_m * np.arange(heights.z_m.shape[0])
    on_bar = np.abs(x) < bar.diameter_m / 2 + heights.cell_m / 2
    for at in (-1.2, -0.4, 0.4, 1.2):
        strap = (np.abs(y - at) < 0.02)[:, None] & ~(is_bare & on_bar)
        heights = replace(heights, gray=np.where(strap, 10, heights.gray).astype(np.uint8))
    found = min(find_bundles(heights, SETTINGS), key=lambda one: abs(one.centre_m[0]))
    assert any("no strap crosses" in sentence for sentence in said(found)) is is_bare


NOISY = [
    [-1.1, 0.0, -1.4, -1.6, 0.1, 1.5, 1.9, 1.4, 2.0, 1.0, 0.2, 1.5, 2.8, 1.0, 0.1, 0.3, 1.4, 1.1],
    [3.1, 3.1, 3.6, 6.6, 8.5, 8.1, 6.4, 3.6, 0.5, 0.0, -0.2, 0.0, 0.0, 1.0, 1.1, -1.4, -3.2, -2.4],
    [-0.1, -0.2, 2.0, 0.5, -0.2, 1.3, 2.4, 1.0, 0.2, 2.3, 2.1, -0.3, 0.2, 0.3, 0.3, 0.8, 3.9, 2.1, -0.5, 1.5],
]  # fmt: skip
CLEAR = [
    [0.8, 0.5, 1.9, 1.4, 1.3, 1.3, 1.2, 0.6, 1.0, 1.0, 0.3, 0.0, 0.4, 0.7, 0.9, -0.8, 1.5, 0.9, 1.1],
    [np.nan, 3.0, 3.8, 1.7, 1.3, 0.2, 0.2, -0.1, 1.0, 0.8, 0.0, -0.1, 0.3, 1.2, 1.1, 2.1, 2.3, np.nan],
]


@pytest.mark.parametrize("shown", [*NOISY, *CLEAR])
def test_straps_that_hardly_show_tell_of_no_bar(shown: list[float], monkeypatch: pytest.MonkeyPatch) -> None:
    """Contrasts of free bundles of the shared yards, and of covered ones of drawn yards."""
    shares = np.array(shown)
    monkeypatch.setattr(straps, "_shown_shares", lambda *_: (shares, np.arange(shares.size)))
    level_m = np.where(shares < 0.35, 0.01, 0.0)
    rise_m = straps.bare_rise(None, SimpleNamespace(cell_m=0.01), None, None, level_m)  # type: ignore[arg-type]
    assert rise_m == (0.01 if shown in CLEAR else 0.0)


@pytest.mark.parametrize(("yaw_deg", "roll_deg"), [(0.4, 0.0), (1.3, 25.0)])
@pytest.mark.parametrize("beam_m", [0.0, 0.08])
def test_flanks_in_coarse_cells_are_nothing_that_lies_there(
    yaw_deg: float, roll_deg: float, beam_m: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A flank off by one of 25 mm was as wide as an object must be. A beam's end on it is found."""
    monkeypatch.setattr(yard_maps, "CELL_M", 0.025)
    laid = Laid(0.0, 0.0, 0.2, yaw_deg, length_m=5.0, roll_deg=roll_deg)
    heights = draw([laid], (-1.0, 1.0), (-3.0, 3.0), 0.002)
    x = heights.x0_m + heights.cell_m * np.arange(heights.z_m.shape[1])
    y = heights.y0_m + heights.cell_m * np.arange(heights.z_m.shape[0])
    heights.z_m[(np.abs(y - 0.6) < beam_m / 2)[:, None] & (x > 0.03) & (x < 0.3)] = 0.4
    found = min(find_bundles(heights, SETTINGS), key=lambda one: abs(one.centre_m[0]))
    assert bool(said(found)) is (beam_m > 0)
