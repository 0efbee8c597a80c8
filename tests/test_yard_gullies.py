"""The orthophoto tells of bundles whose bars the surface doesn't show."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from barsight.yard.bundles import gully_shading
from barsight.yard.bundles.detection import find_bundles
from barsight.yard.bundles.fitting.outline import STEP_M, packing_axes, turned_packing
from barsight.yard.bundles.fitting.settings import BundleSettings
from barsight.yard.bundles.gully_shading import _rests, _shading
from yard_maps import Laid, draw, photographed

SETTINGS = BundleSettings()
LAID = [
    Laid(0.2, 0.0, 0.2, 0.4, 0.04, 19, roll_deg=4),
    Laid(0.7, 0.0, 0.2, -0.3, 0.02, 61, roll_deg=-6),
    Laid(1.2, 0.1, 0.2, 0.2, 0.02, 37, roll_deg=12),
    Laid(1.8, 0.0, 0.2, 0.6, 0.06, 7, roll_deg=25),
]


@pytest.mark.parametrize("aside", [0.0, 0.7])
def test_the_picture_tells_bars_that_the_surface_does_not_show(aside: float) -> None:
    heights = photographed(draw(LAID), LAID, aside)
    found = find_bundles(heights, SETTINGS)
    # Over the floor as they lie, more bars may hang below.
    assert [b.bars for b in found] == [None] * len(LAID)
    for bundle, one in zip(found, LAID, strict=True):
        sigma = bundle.sigma
        assert abs(bundle.bar_diameter_m - one.diameter_m) < min(
            3 * sigma.bar_diameter_m, 0.0015 + 0.03 * one.diameter_m
        )
        assert abs(bundle.width_m - one.width_m) < 0.012
        assert abs(bundle.top_z_m - one.top_z_m) < 0.004
        axes = np.array([bar.centre_m for bar in bundle.bar_axes])
        assert len(axes) == bundle.visible_bars
    blind = find_bundles(replace(heights, gray=None), SETTINGS)
    off = [b.bar_diameter_m / one.diameter_m - 1 for b, one in zip(blind, LAID, strict=True)]
    assert max(np.abs(off)) > 0.2


def test_a_picture_without_lines_counts_nothing() -> None:
    heights = photographed(draw(LAID), LAID)
    noise = np.random.default_rng(2).normal(120, 12, heights.z_m.shape).clip(1, 255).astype(np.uint8)
    blank = [(b.bars, b.width_m) for b in find_bundles(replace(heights, gray=noise), SETTINGS)]
    assert blank == [(b.bars, b.width_m) for b in find_bundles(replace(heights, gray=None), SETTINGS)]


def test_shading_is_that_of_the_highest_bar_blurred() -> None:
    diameter, roll, blur = 0.04, 0.2, 0.004
    above, aside = _shading(packing_axes(2), diameter, roll, blur)
    u = STEP_M * (np.arange(above.size) - above.size // 2)
    axes = turned_packing(2, diameter, roll)
    turned = 2 * (u[:, None] - axes[:, 0]) / diameter
    rise = np.sqrt(np.maximum(1 - turned**2, 0))
    height = np.where(np.abs(turned) <= 1, axes[:, 1] + rise * diameter / 2, -np.inf)
    best, there = height.argmax(axis=1), np.isfinite(height.max(axis=1))
    rows = np.arange(u.size)
    weight = np.exp(-0.5 * (np.arange(-12, 13) * STEP_M / blur) ** 2)
    for seen, values in ((above, rise), (aside, turned)):
        plain = np.convolve(np.where(there, values[rows, best], 0.0), weight / weight.sum(), mode="same")
        np.testing.assert_allclose(seen, plain, atol=1e-9)


def test_the_rest_is_that_of_a_plain_least_squares() -> None:
    rng = np.random.default_rng(4)
    places, levels = np.sort(rng.uniform(-0.08, 0.08, 60)), rng.normal(0, 1, 60)
    rest = _rests(
        places, levels, packing_axes(2), np.array([0.04]), np.array([0.1]), np.array([0.002]), 0.004
    )[0, 0]
    above, aside = _shading(packing_axes(2), 0.04, 0.1, 0.004)
    u = STEP_M * (np.arange(above.size) - above.size // 2)
    up, side = np.interp(places - 0.002, u, above), np.interp(places - 0.002, u, aside)
    q = places / np.abs(places).max()
    model = np.stack([np.ones(60), q, q * q, up, up * q, up * q * q, side], axis=1)
    _, plain, *_ = np.linalg.lstsq(model, levels, rcond=None)
    assert rest == pytest.approx(plain[0] / ((levels - levels.mean()) ** 2).sum(), rel=1e-3)


def test_a_bundle_that_does_not_converge_leaves_the_smoothing_to_the_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """One fits best at 11 mm; the other can't be fitted at 4 mm."""

    def refined(grid: str, fit: object, settings: BundleSettings) -> SimpleNamespace | None:
        if grid == "lost" and settings.smoothing_m < 0.005:
            return None
        return SimpleNamespace(rms_m=(1 + 1e4 * (settings.smoothing_m - 0.011) ** 2) ** 0.5)

    monkeypatch.setattr(gully_shading, "refine_outline", refined)
    found = [SimpleNamespace(grid=grid, fit=SimpleNamespace(rings=1), shades=1) for grid in ("kept", "lost")]
    assert gully_shading.estimate_smoothing(found, SETTINGS) == pytest.approx(0.011)
    assert gully_shading.estimate_smoothing(found[1:], SETTINGS) == SETTINGS.smoothing_m
