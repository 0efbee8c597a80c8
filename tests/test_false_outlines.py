"""Outlines that fit what is no bundle: the top bar of a pack, a wall with lines on it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from barsight.yard.bundles.doubts import list_wall_doubts, rate_confidence
from barsight.yard.bundles.fitting.outline import bundle_width
from barsight.yard.bundles.fitting.outline_fit import AGREES, Fit, FittedOutline
from barsight.yard.bundles.fitting.rotated_map import align_map
from barsight.yard.bundles.reading import Reading
from barsight.yard.bundles.section.flanks import Flanks
from barsight.yard.bundles.section.pack_sides import PackSide
from barsight.yard.bundles.section.packs import Pack
from barsight.yard.bundles.section.straps import StrapSpan
from barsight.yard.bundles.strapped_bundles import doubted_if_narrow, held_by_straps
from barsight.yard.types import Doubt, DoubtKind
from lift_yards import record
from yard_maps import Laid, draw

STRAPPED_BAR = Doubt(DoubtKind.STRAPPED_BAR, "straps cross what looks like one bar: it may be the top one")


@pytest.mark.parametrize(("bar_m", "is_doubted"), [(0.08, True), (0.016, False)])
def test_one_bar_that_straps_cross_is_a_part_of_a_bundle(bar_m: float, *, is_doubted: bool) -> None:
    """The top one of five bars, on which a bundle lay, was told as one free bar with 99 %. Where the pictures
    show thin bars, what looks like one bar is a round pack of these.
    """
    one = replace(record(Laid(0.0, 0.0, 0.2, 0.0)), width_m=0.08, bar_diameter_m=bar_m, section_m2=0.005)
    told = doubted_if_narrow(replace(one, bars=None, reasons=(STRAPPED_BAR,)))
    assert (told.confidence < 0.5) == is_doubted == bool(np.isnan(told.section_m2))
    assert (STRAPPED_BAR in told.reasons) == is_doubted


@pytest.mark.parametrize(
    ("side", "diameter_m", "rings", "expected"),
    [
        (PackSide.OPEN, np.nan, 0, True),
        (PackSide.SEEN, np.nan, 0, False),
        (PackSide.OPEN, 0.02, 0, False),
        (PackSide.OPEN, np.nan, 2, False),
    ],
)
def test_straps_over_one_bar_without_dark_lines_are_told(
    side: PackSide, diameter_m: float, rings: int, *, expected: bool
) -> None:
    span = StrapSpan(-0.03, 0.03, ((1.0, 1.0), (2.0, 2.0)), 0.0)
    pack = Pack(-0.04, 0.04, span, (-np.inf, np.inf), 0.1, (side, side), diameter_m)
    bundle = record(Laid(0.0, 0.0, 0.2, 0.0), bars=None)
    held = held_by_straps(bundle, bundle.sigma, replace(reading_of(rings, 0.08), pack=pack), None, 0.0)
    assert any(doubt.kind is DoubtKind.STRAPPED_BAR for doubt in held.reasons) == expected


@pytest.mark.parametrize(
    ("rings", "rival_m", "weight", "is_sure"),
    [(0, 0.2, 1.2, False), (0, 0.2, 0.6, True), (0, 0.05, 1.2, True), (2, 0.2, 1.2, True)],
)
def test_one_bar_of_what_a_wider_outline_explains_better_is_doubtful(
    rings: int, rival_m: float, weight: float, *, is_sure: bool
) -> None:
    """Each of the bars on top of a pack fits an outline of one bar."""
    wider = reading_of(2, rival_m).found
    reading = replace(reading_of(rings, 0.08), weight=1.0, rival=wider, rival_weight=weight)
    assert (rate_confidence(reading, reading.found.fit.state) >= 0.5) == is_sure


@pytest.mark.parametrize(
    ("falls_m", "rises_m", "is_wall"),
    [
        ((0.007, 0.010), (-np.inf, -0.004), True),
        ((0.007, 0.030), (-np.inf, -0.004), False),
        ((0.007, 0.010), (-np.inf, 0.05), False),
        ((0.0, 0.010), (np.nan, -0.004), False),
    ],
)
def test_straps_on_a_wall_make_no_bundle_of_it(
    falls_m: tuple[float, float], rises_m: tuple[float, float], *, is_wall: bool
) -> None:
    """Two lines on a wall of 120 mm by 1.1 m looked like straps, and it was told as a free bundle. A flank
    beside something higher, or beside which nothing was measured, shows nothing.
    """
    flanks = Flanks(0.12, falls_m, rises_m, are_flat=False, ended=(True, True))
    doubts = list_wall_doubts(replace(reading_of(2, 0.12), flanks=flanks), None, 1.1, 0.0)
    assert bool(doubts) == is_wall


def reading_of(rings: int, width_m: float) -> Reading:
    """Return the reading of an outline that agrees with all of its rows, without straps."""
    state, gain = np.full(200, AGREES, np.uint8), np.zeros(200, np.float32)
    values = np.array([0, 0, 0.2, 0, 0, width_m / bundle_width(rings, 1.0)])
    fit = Fit(rings, 0.0, values, np.zeros((6, 6)), 0, 199, state, gain, 0.002, 0.002)
    grid = align_map(draw([Laid(0.0, 0.0, 0.2, 0.0)]), 0.0, 0.05)
    return Reading(FittedOutline(grid, fit), 0.0, None, 0.0, None)
