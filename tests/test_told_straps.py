"""Straps with a bright middle, told from thin bars in drawn pictures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from barsight.bundle_pictures.told_straps import tell_straps
from barsight.yard.thin_lines import SURE_STRENGTH, find_thin_lines, with_thin_lines
from barsight.yard.types import Bundle, Doubt, DoubtKind, HeightMap
from drawn_pictures import TOP_M, Pictures, flat_map, looking_down
from lift_yards import record
from yard_maps import Laid

WIDTH_M, AT_M = 0.26, 0.2
POSES = looking_down(-0.3, 1) | looking_down(0.3, 2)


def crossed(
    wide_m: float, low_m: float, high_m: float, *, is_round: bool, besides: float = 20.0
) -> Callable[[np.ndarray], np.ndarray]:
    """Shade bars along Y, and something across them: flat, or lit from above as a round bar is."""

    def shade(places: np.ndarray) -> np.ndarray:
        u, v = places[..., 0], places[..., 1]
        level = np.where(np.abs(u) < WIDTH_M / 2, 45 + 45 * np.abs(np.sin(np.pi * u / 0.03)), besides)
        off = 2 * np.abs(v - AT_M) / wide_m
        across = 105 * np.sqrt(np.clip(1 - off**2, 0.05, 1)) if is_round else np.full(u.shape, 105.0)
        return np.where((off < 1) & (u > low_m) & (u < high_m), across, level)

    return shade


def photographed(shade: Callable[[np.ndarray], np.ndarray]) -> tuple[HeightMap, Bundle]:
    """Map a bundle with a photo, and describe it with the doubt that the photo raises."""
    heights = flat_map()
    y, x = np.meshgrid(heights.y_m, heights.x_m, indexing="ij")
    rough = np.random.default_rng(1).normal(0, 0.03, x.shape)
    tops = np.mean([shade(np.stack([x, y + part], -1)) for part in np.linspace(-4e-3, 4e-3, 5)], axis=0)
    heights = replace(heights, tops=np.clip(tops * np.exp(rough), 1, 255).astype(np.uint8))
    bundle = record(Laid(0.0, 0.0, TOP_M - WIDTH_M / 2, 0.0, length_m=2.0))
    bundle = with_thin_lines(replace(bundle, width_m=WIDTH_M, top_z_m=TOP_M), heights)
    (doubt,) = bundle.cover_doubts
    assert doubt.kind is DoubtKind.FAINT_LINE
    return heights, bundle


@pytest.mark.parametrize(
    ("wide_m", "low_m", "high_m", "is_round", "is_strap"),
    [
        (0.032, -WIDTH_M / 2, WIDTH_M / 2, False, True),
        (0.032, -WIDTH_M / 2, 0.19, False, False),
        (0.016, -0.16, 0.16, True, False),
        (0.016, -WIDTH_M / 2, WIDTH_M / 2, True, False),
        (0.032, -WIDTH_M / 2, WIDTH_M / 2, True, False),
    ],
    ids=["a strap", "goes on beyond a flank", "a bar", "a bar as long as the bundle is wide", "a thick one"],
)  # fmt: skip
def test_a_strap_is_flat_narrow_and_ends_at_the_flanks(
    wide_m: float, low_m: float, high_m: float, *, is_round: bool, is_strap: bool
) -> None:
    shade = crossed(wide_m, low_m, high_m, is_round=is_round)
    heights, bundle = photographed(shade)
    (one,) = tell_straps(Pictures(POSES, shade), POSES, heights, (bundle,))
    assert one.is_free is is_strap and (one.straps_m != ()) is is_strap
    lines = find_thin_lines(heights, one)
    assert lines is not None and (lines[0].excess_ratio < 1) is is_strap
    if is_strap:
        assert one.straps_m == pytest.approx((AT_M,), abs=0.02)


def test_where_what_lies_behind_is_as_bright_nothing_is_told() -> None:
    shade = crossed(0.032, -WIDTH_M / 2, WIDTH_M / 2, is_round=False, besides=105.0)
    heights, bundle = photographed(shade)
    (one,) = tell_straps(Pictures(POSES, shade), POSES, heights, (bundle,))
    assert one is bundle


def test_a_line_beside_a_told_strap_is_still_found() -> None:
    shade = crossed(0.032, -WIDTH_M / 2, WIDTH_M / 2, is_round=False)
    heights, bundle = photographed(shade)
    for at_m, is_found in ((AT_M, False), (AT_M + 0.1, True)):
        lines = find_thin_lines(heights, replace(bundle, straps_m=(at_m,)))
        assert lines is not None and lines[0].strength < SURE_STRENGTH
        assert (lines[0].excess_ratio >= 1) is is_found


def test_a_told_strap_leaves_in_doubt_what_may_lie_along() -> None:
    """The map rises along it, where it is unsure: no line's place is told, and a strap says nothing of it."""
    shade = crossed(0.032, -WIDTH_M / 2, WIDTH_M / 2, is_round=False)
    heights, bundle = photographed(shade)
    along = Doubt(DoubtKind.FAINT_LINE, "along it the map rises by 25 mm: a thin bar may lie over it")
    bundle = replace(bundle, cover_doubts=(along, *bundle.cover_doubts))
    (told,) = tell_straps(Pictures(POSES, shade), POSES, heights, (bundle,))
    assert told.straps_m and told.cover_doubts == (along,) and not told.is_free
