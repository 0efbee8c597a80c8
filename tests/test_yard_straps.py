"""Straps in drawn orthophotos: what they hold together, and when they tell nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from barsight.core.types import HeightSource
from barsight.yard.bundles.fitting.outline_fit import AGREES, Fit
from barsight.yard.bundles.fitting.rotated_map import align_map
from barsight.yard.bundles.seen_section import section_of_pack
from barsight.yard.bundles.straps import Pack, StrapSpan, contradicts, split_columns, strapped_pack
from barsight.yard.types import HeightMap

CELL = 0.01
LENGTH_M, WIDE_M = 5.0, 1.2


def drawn(
    packs: list[tuple[float, float, tuple[float, ...]]], rng: np.random.Generator, *, beside_m: float = 0.0
) -> HeightMap:
    """Draw round-topped packs (low x, high x, y of straps) on the floor, their grey levels with noise; straps
    are darker or brighter by a third. beside_m: height of what fills the rest."""
    x = CELL * np.arange(round(WIDE_M / CELL)) - WIDE_M / 2
    y = CELL * np.arange(round(LENGTH_M / CELL)) - LENGTH_M / 2
    z = np.full((len(y), len(x)), beside_m)
    grey = 60 * np.exp(rng.normal(0, 0.12, z.shape))
    for low, high, straps in packs:
        own = (x >= low) & (x < high)
        away = (x[own] - (low + high) / 2) / (high - low)
        z[:, own] = 0.3 - 0.3 * (2 * away) ** 4 * (high - low)
        for at in straps:
            rows = np.abs(y - at) < 0.016
            grey[np.ix_(rows, own)] *= rng.choice([0.5, 1.8], own.sum())
    z += rng.normal(0, 0.001, z.shape)
    shape = z.shape
    return HeightMap(
        float(x[0]), float(y[0]), CELL, z.astype(np.float32), np.full(shape, 0.003, np.float32),
        np.full(shape, 4, np.float32), np.full(shape, HeightSource.VISION, np.uint8),
        np.clip(grey, 1, 255).astype(np.uint8),
    )  # fmt: skip


def pack_at(heights: HeightMap, u_m: float, width_m: float = 0.2) -> Pack | None:
    """Look for straps over an outline about x = u_m that agrees with all rows."""
    sheet = align_map(heights, 0.0, 0.05)
    rows = sheet.z_m.shape[0]
    values = np.array([u_m, 0.0, 0.2, 0.0, 0.0, width_m / 3])
    state, gain = np.full(rows, AGREES, np.uint8), np.ones(rows, np.float32)
    fit = Fit(1, sheet.v0_m + CELL * rows / 2, values, np.zeros((6, 6)), 0, rows - 1, state, gain, 0.0, 0.0)
    return strapped_pack(heights, sheet, fit)


@pytest.mark.parametrize("seed", range(5))
def test_straps_tell_touching_bundles_apart(seed: int) -> None:
    rng = np.random.default_rng(seed)
    heights = drawn([(-0.25, 0.0, (-1.5, 0.1, 1.6)), (0.0, 0.22, (-1.1, 0.6, 2.0))], rng)
    for u, low, high in ((-0.15, -0.25, 0.0), (0.12, 0.0, 0.22)):
        pack = pack_at(heights, u)
        assert pack is not None and pack.sides_seen
        assert u + pack.low_m == pytest.approx(low, abs=1.6 * CELL)
        assert u + pack.high_m == pytest.approx(high, abs=1.6 * CELL)
        assert len(pack.span.rows_m) == 3


@pytest.mark.parametrize("seed", range(5))
def test_straps_in_line_leave_the_sides_open(seed: int) -> None:
    rows = (-1.5, 0.1, 1.6)
    heights = drawn([(-0.25, 0.0, rows), (0.0, 0.22, rows)], np.random.default_rng(seed))
    for u in (-0.15, 0.12):
        pack = pack_at(heights, u)
        assert pack is None or not pack.sides_seen


def test_a_flank_out_of_sight_is_not_seen() -> None:
    rng = np.random.default_rng(3)
    heights = drawn([(-0.2, 0.2, (-1.5, 0.1, 1.6))], rng)
    assert (whole := pack_at(heights, 0.0, 0.3)) is not None and whole.sides_seen
    x = heights.x0_m + CELL * np.arange(heights.shape[1])
    for hidden in ((x > 0.05), (x > 0.05) & (x < 0.15)):
        part = replace(heights, z_m=np.where(hidden, np.float32(np.nan), heights.z_m))
        pack = pack_at(part, -0.05, 0.3)
        assert pack is None or not pack.sides_seen


def test_straps_that_go_on_contradict_an_outline() -> None:
    span = StrapSpan(-0.14, 0.06, (1.0, 2.0), 0.0)
    pack = Pack(-0.15, 0.08, span, (-np.inf, 0.09), 0.1, False)
    assert "beyond its outline" in contradicts(pack, 0.2)
    assert "into its outline" in contradicts(pack, 0.26)
    assert contradicts(replace(pack, others_m=(-np.inf, np.inf)), 0.26) == ""


@pytest.mark.parametrize("over_m", [0.1, 0.18, 0.36, np.inf])
@pytest.mark.parametrize("width_m", [0.1, 0.25, 0.7])
def test_sections_of_packs_leave_room_for_doubt(width_m: float, over_m: float) -> None:
    section, sigma = section_of_pack(width_m, over_m)
    assert section > 1.645 * sigma > 0
    assert section + 1.645 * sigma <= 0.73 * (width_m + 0.02) * over_m + 1e-12


def test_what_goes_on_beside_a_strap_leaves_the_side_open() -> None:
    heights = drawn([(-0.1, 0.1, (-1.5, 0.1, 1.6))], np.random.default_rng(2), beside_m=0.25)
    pack = pack_at(heights, 0.0)
    assert pack is not None and not pack.sides_seen


def test_bars_without_straps_show_none() -> None:
    found = [pack_at(drawn([(-0.12, 0.12, ())], np.random.default_rng(seed)), 0.0) for seed in range(20)]
    assert found == [None] * 20


def test_a_place_belongs_to_the_straps_that_it_shares() -> None:
    contrast = np.full((200, 60), -1.2)
    contrast[[20, 100, 180], :25] = 3.0
    contrast[[60, 140], 25:] = 3.0
    contrast = np.maximum(contrast, np.roll(contrast, 1, axis=0))
    found = split_columns(contrast, 7, np.zeros(60, bool), np.zeros(60, bool))
    assert [(first, last) for first, last, _ in found] == [(0, 25), (25, 60)]
    assert [len(rows) for _, _, rows in found] == [3, 2]
