"""The compiled inner loops of finding bundles against slow ones written plainly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from barsight.core.records.heights import HeightSource
from barsight.yard.bundles.fitting.gauss_newton import Heights, Rules, _normal_equations, fit_outline
from barsight.yard.bundles.fitting.growth import _row_states, _walk
from barsight.yard.bundles.fitting.outline import (
    STEP_M,
    add_weighted,
    make_outline,
    packing_axes,
    trace_with_changes,
)
from barsight.yard.bundles.fitting.outline_fit import ABOVE, AGREES, BELOW, MIXED, UNKNOWN
from barsight.yard.bundles.fitting.rotated_map import align_map
from barsight.yard.bundles.fitting.settings import BundleSettings
from barsight.yard.bundles.fitting.template_matching import _KNOWN, _SPREAD_M, _match, make_templates
from barsight.yard.bundles.set_packing import choose_readings
from barsight.yard.types import HeightMap

SMOOTHING_M = 0.006


def test_weighted_values_are_added_to_a_part_of_the_sums() -> None:
    sums = np.arange(5.0)
    add_weighted(sums[1:4], np.array([2.0, np.pi, -1.0]), 0.5)
    np.testing.assert_array_equal(sums, [0.0, 2.0, 2.0 + 0.5 * np.pi, 2.5, 4.0])


def test_an_outline_is_the_smoothed_upper_edge_of_its_bars() -> None:
    outline = make_outline(1, 0.09, 0.2, SMOOTHING_M)
    c, s = np.cos(0.2), np.sin(0.2)
    axes = 0.09 * packing_axes(1) @ np.array([[c, s], [-s, c]])
    u = STEP_M * (np.arange(outline.exact_m.size) - outline.exact_m.size // 2)
    inside = 0.045**2 - (u[:, None] - axes[:, 0]) ** 2
    exact = np.where(inside >= 0, axes[:, 1] + np.sqrt(inside.clip(0)), -np.inf).max(axis=1)
    there = np.isfinite(exact)
    np.testing.assert_allclose(outline.exact_m[there], exact[there], atol=1e-9)
    weight = np.exp(-0.5 * ((u[there][:, None] - u[there]) / SMOOTHING_M) ** 2)
    weight[np.abs(u[there][:, None] - u[there]) > 0.0185] = 0
    seen = (weight * exact[there]).sum(axis=1) / weight.sum(axis=1)
    np.testing.assert_allclose(outline.seen_m[there], seen, atol=1e-9)


def test_matching_gains_what_a_plain_comparison_gains() -> None:
    settings = BundleSettings(catalogue_mm=(60.0, 90.0))
    templates = make_templates(settings, 0.01)
    rng = np.random.default_rng(3)
    outline = make_outline(1, 0.09, 0.1, SMOOTHING_M)
    u = 0.01 * np.arange(120) - 0.6
    place = np.rint((u + outline.reach_m) / STEP_M).astype(int)
    inside = (place >= 0) & (place < outline.seen_m.size)
    profile = np.where(inside, 0.4 + outline.seen_m[place.clip(0, outline.seen_m.size - 1)], 0.2)
    profile = (profile + rng.normal(0, 0.004, u.size)).astype(np.float32)
    profile[rng.random(u.size) < 0.1] = np.nan
    classes = np.unique(templates.kinds[:, 0])
    of_class = np.searchsorted(classes, templates.kinds[:, 0])
    gain, height, which = _match(
        profile, templates.heights, templates.offsets, templates.lengths, of_class, classes.size, 0.015
    )
    best = np.full(gain.shape, -np.inf)
    for t, (first, n) in enumerate(zip(templates.offsets, templates.lengths, strict=True)):
        for column in range(max(-first, 0), min(u.size, u.size - n - first + 1)):
            score = plain_gain(profile[column + first : column + first + n], templates.heights[t, :n])
            best[of_class[t], column] = max(best[of_class[t], column], score)
    np.testing.assert_allclose(gain, best, rtol=1e-3, atol=1e-3)
    assert best[:, 55:66].max() > 15
    found = int(gain[1].argmax())
    assert abs(u[found]) < 0.015 and height[1, found] == pytest.approx(0.4, abs=0.005)
    assert templates.kinds[which[1, found], 1] == 0.09


def plain_gain(profile: np.ndarray, template: np.ndarray) -> float:
    rest = (profile - template).astype(np.float64)
    probes = rest[np.arange(5) * (rest.size - 1) // 4]
    known = np.isfinite(rest)
    if (
        known.mean() < _KNOWN
        or not np.isfinite(probes).any()
        or np.ptp(probes[np.isfinite(probes)]) > _SPREAD_M
    ):
        return -np.inf
    rest = rest[known]
    z = rest.clip(np.nanmin(probes) - 0.01, np.nanmax(probes) + 0.01).mean()
    for _ in range(2):
        near = np.abs(rest - z) < 0.0225
        z = rest[near].mean() if near.any() else z
    return float(np.maximum(1 - ((rest - z) / 0.015) ** 2, -1).sum())


def test_the_normal_equations_are_those_of_the_outlines_derivatives() -> None:
    rng = np.random.default_rng(5)
    values = np.array([0.013, 0.02, 0.3, -0.01, 0.1, 0.09])
    tables = trace_with_changes(packing_axes(1), 0.09, 0.1, SMOOTHING_M)
    z = (0.4 + rng.normal(0, 0.005, (40, 60))).astype(np.float32)
    z[rng.random(z.shape) < 0.1] = np.nan
    heights = Heights(z, np.full_like(z, 0.004), -0.3, 1.0, 0.01, 0, 39, 3, 1.2)
    gate, placing = 0.05, 0.004
    normal, right, moments = _normal_equations(heights, values, tables, gate, placing)
    rows, columns = np.mgrid[0:40:3, 0:60]
    along = 1.0 + 0.01 * rows.ravel() - 1.2
    cosine = 1 / np.hypot(1, values[1])
    across = (-0.3 + 0.01 * columns.ravel() - values[0] - values[1] * along) * cosine
    middle = tables.shape[1] // 2
    at = across / STEP_M + middle
    within = ((middle * STEP_M - 0.008 - np.abs(across)) / cosine / 0.01 + 0.5).clip(0, 1)
    usable = (within > 0) & np.isfinite(z[rows, columns].ravel())
    h, slope, by_roll, by_diameter = (np.interp(at, np.arange(tables.shape[1]), row) for row in tables)
    within *= (4.5 - np.abs(slope)).clip(0, 1)
    rest = z[rows, columns].ravel() - values[2] - values[3] * along - h
    jacobian = np.stack([
        -slope * cosine, -slope * cosine * along, np.ones_like(h), along, by_roll, by_diameter
    ])  # fmt: skip
    usable &= np.isfinite(jacobian).all(axis=0) & (np.abs(slope) < 4.5) & (np.abs(rest) < gate)
    jacobian, rest, slope = jacobian[:, usable], rest[usable], slope[usable]
    tukey = within[usable] * (1 - (rest / gate) ** 2) ** 2
    weight = tukey / (np.float32(0.004) ** 2 + (slope * placing) ** 2)
    np.testing.assert_allclose(normal, (jacobian * weight) @ jacobian.T, rtol=1e-4, atol=1e-3)
    np.testing.assert_allclose(right, (jacobian * weight) @ rest, rtol=1e-4, atol=1e-3)
    assert moments[0] == pytest.approx(tukey.sum(), rel=1e-5) and usable.sum() > 100


def drawn_heights(values: np.ndarray) -> Heights:
    """A grid of 40 rows about a bundle of seven bars without noise, a tenth of its cells unknown."""
    outline = make_outline(1, values[5], values[4], SMOOTHING_M)
    along = 0.01 * np.arange(40)[:, None] - 0.2
    across = (0.01 * np.arange(60) - 0.3 - values[0] - values[1] * along) / np.hypot(1, values[1])
    places = STEP_M * (np.arange(outline.seen_m.size) - outline.seen_m.size // 2)
    z = values[2] + values[3] * along + np.interp(across, places, outline.seen_m, np.nan, np.nan)
    z[np.random.default_rng(6).random(z.shape) < 0.1] = np.nan
    return Heights(z.astype(np.float32), np.full(z.shape, 0.004, np.float32), -0.3, 1.0, 0.01, 0, 39, 1, 1.2)


def rules(max_m: float) -> Rules:
    return Rules(
        packing_axes(1),
        3.006,
        np.ones(6, bool),
        12,
        0.05,
        0.004,
        SMOOTHING_M,
        1.0,
        (0.0, np.inf),
        (0.1, max_m),
    )


def test_a_fit_from_beside_comes_to_the_outline_that_was_drawn() -> None:
    values = np.array([0.013, 0.02, 0.3, -0.01, 0.1, 0.09])
    heights = drawn_heights(values)
    start = values + np.array([0.006, -0.01, 0.004, 0.01, 0.04, -0.004])
    held, found, _, moments, _ = fit_outline(heights, start, rules(0.4))
    assert held and moments[0] > 500
    np.testing.assert_allclose(found, values, atol=5e-4)
    free = np.arange(6) < 4
    start[~free] = values[~free]
    held, found, *_ = fit_outline(heights, start, rules(0.4)._replace(free=free))
    np.testing.assert_allclose(found, values, atol=5e-4)
    np.testing.assert_array_equal(found[~free], values[~free])
    assert not fit_outline(heights, start, rules(0.2))[0], "wider than allowed"
    few = heights._replace(z_m=np.where(np.arange(60) < 30, heights.z_m, np.nan)[:1].copy(), last=0)
    assert not fit_outline(few, start, rules(0.4))[0]


@pytest.mark.parametrize("seed", range(4))
def test_a_fit_of_noisy_heights_comes_to_rest(seed: int) -> None:
    """Undamped steps swing by millimetres for ever where the packing isn't quite the one that was drawn."""
    values = np.array([0.013, 0.0, 0.3, 0.0, 0.4, 0.09])
    heights = drawn_heights(values)
    noise = np.random.default_rng(seed).normal(0, 0.006, heights.z_m.shape[1]).astype(np.float32)
    heights = heights._replace(z_m=heights.z_m + noise)
    held, found, *_ = fit_outline(heights, values, rules(0.4)._replace(steps=20))
    held_too, later, *_ = fit_outline(heights, values, rules(0.4)._replace(steps=27))
    assert held and held_too
    np.testing.assert_allclose(later, found, atol=1e-4)


def test_rows_say_what_most_of_their_cells_do() -> None:
    values = np.array([0.013, 0.02, 0.3, -0.01, 0.1, 0.09])
    heights, agreement = drawn_heights(values), 0.012
    outline = make_outline(1, 0.09, 0.1, SMOOTHING_M)
    rng, z = np.random.default_rng(7), heights.z_m
    z += rng.normal(0, 0.004, z.shape).astype(np.float32)
    z[5:10] += 0.05
    z[10:15] -= 0.05
    z[15:20] += rng.choice([-0.05, 0.0, 0.0, 0.05], (5, 60)).astype(np.float32)
    z[20:25, ::4] = np.nan
    z[25:30, np.arange(60) % 5 > 0] = np.nan
    seen = outline.seen_m, outline.slope, outline.reach_m
    state, gain = _row_states(heights._replace(first=2, last=37), values, *seen, agreement)
    wanted, gains = np.zeros(40, int), np.zeros(40)
    for j in range(2, 38):
        along = 1.0 + 0.01 * j - 1.2
        across = (-0.3 + 0.01 * np.arange(60) - values[0] - values[1] * along) / np.hypot(1, values[1])
        k = np.floor((across + outline.reach_m) / STEP_M + 0.5).astype(int)
        inside = (np.abs(across) <= outline.reach_m) & (
            np.abs(outline.slope[k.clip(0, len(seen[0]) - 1)]) < 2
        )
        rest = z[j, inside] - values[2] - values[3] * along - outline.seen_m[k[inside]]
        known = rest[np.isfinite(rest)]
        agree, above, below = (
            (np.abs(known) <= agreement).sum(), (known > agreement).sum(), (known < -agreement).sum()
        )  # fmt: skip
        if known.size < 0.3 * inside.sum():
            wanted[j] = UNKNOWN
        elif agree >= 0.55 * known.size:
            wanted[j], gains[j] = AGREES, np.maximum(1 - (known / agreement) ** 2, -1).sum()
        elif above > below and above >= 0.4 * known.size:
            wanted[j] = ABOVE
        else:
            wanted[j] = BELOW if below >= 0.4 * known.size else MIXED
    np.testing.assert_array_equal(state, wanted)
    np.testing.assert_allclose(gain, gains, rtol=1e-4, atol=1e-4)
    assert set(wanted[2:38]) == {UNKNOWN, AGREES, ABOVE, BELOW, MIXED}


def test_a_bundle_goes_on_over_short_gaps_only() -> None:
    state = np.array([1, 1, 0, 0, 1, 2, 1, 1, 3, 3, 1, 1], np.uint8)
    runs = np.array([2.0, 0.0, 1.0, 1.0, 1.0])
    assert _walk(state, 6, -1, 0, runs) == 0
    assert _walk(state, 6, -1, 2, runs) == 4
    assert _walk(state, 6, 1, 11, runs) == 7, "two rows below are too many"
    assert _walk(state, 6, 1, 11, runs + 1) == 11
    assert _walk(np.tile([1, 4], 5).astype(np.uint8), 0, 1, 9, runs) == 8, "each gap counts by itself"


def test_a_turned_sheet_holds_the_nearest_measured_cells() -> None:
    rng = np.random.default_rng(8)
    z = rng.normal(size=(31, 22)).astype(np.float32)
    source = rng.choice([0, 1, 1, 1, 3], z.shape).astype(np.uint8)
    heights = HeightMap(-0.4, 2.1, 0.01, z, z + 1, z + 2, source)
    grid = align_map(heights, 0.4)
    row, column = np.indices(grid.z_m.shape)
    uv = np.column_stack([grid.u0_m + 0.01 * column.ravel(), grid.v0_m + 0.01 * row.ravel()])
    x, y = grid.to_map(uv).T
    i, j = np.rint((y - 2.1) / 0.01).astype(int), np.rint((x + 0.4) / 0.01).astype(int)
    inside = (i >= 0) & (j >= 0) & (i < 31) & (j < 22)
    i, j = np.where(inside, i, 0), np.where(inside, j, 0)
    measured = inside & (source[i, j] == HeightSource.VISION)
    np.testing.assert_array_equal(grid.z_m.ravel(), np.where(measured, z[i, j], np.float32(np.nan)))
    np.testing.assert_array_equal(grid.sigma_m.ravel(), np.where(measured, z[i, j] + 1, np.float32(np.nan)))
    np.testing.assert_array_equal(grid.views.ravel(), np.where(measured, z[i, j] + 2, np.float32(np.nan)))
    later = align_map(replace(heights, passes=source), 0.4)
    np.testing.assert_array_equal(later.views.ravel(), np.where(measured, np.inf, np.nan))
    assert 200 < measured.sum() < inside.sum() < inside.size


def test_the_set_that_weighs_most_is_chosen_and_no_place_twice() -> None:
    claims = [np.array([1, 2, 3]), np.array([3, 4, 5]), np.array([5, 6]), np.array([9]), np.array([9])]
    assert choose_readings(np.array([3.0, 5.0, 3.0, 1.0, 2.0]), claims).tolist() == [0, 2, 4]
    assert choose_readings(np.array([3.0, 7.0, 3.0, 1.0, -2.0]), claims).tolist() == [1, 3]
    assert choose_readings(np.array([3.0]), claims[:1]).tolist() == [0]
