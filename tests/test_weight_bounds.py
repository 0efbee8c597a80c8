"""Upper bounds of masses."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

import yard_maps
from barsight.yard.bundles.detection import find_bundles
from barsight.yard.bundles.fitting.settings import BundleSettings
from barsight.yard.lift_settings import UPPER
from barsight.yard.types import Bundle, BundleSigma
from barsight.yard.weight import bundle_mass, bundle_section
from lift_yards import laid, map_of


@pytest.mark.parametrize("sigma_m", [math.nan, math.inf])
def test_unknown_sigma_of_a_length_is_no_exact_length(sigma_m: float) -> None:
    def bundle(length_sigma_m: float) -> Bundle:
        sigma = BundleSigma(0.003, 0.02, 0.0006, length_sigma_m, 0.006, 0.003, 0.001)
        one = Bundle(
            0, np.array([0, 0, 0.0]), 0.0, 0.0, 0.5, np.zeros((2, 3)), (False, False), 0.2, 0.2, 0.05, 7, 0,
            0, True, (), sigma, 1.0, 0.9, (),
        )  # fmt: skip
        return replace(one, bars=None, section_m2=0.01, sigma=replace(sigma, section_m2=0.0005))

    assert bundle_mass(bundle(sigma_m)).upper_kg > 1.005 * bundle_mass(bundle(0.0)).upper_kg


@pytest.mark.parametrize("cell_m", [0.01, 0.02, 0.025])
@pytest.mark.parametrize("stock", [{}, {"diameter_m": 0.05, "bars": 19}, {"diameter_m": 0.2, "bars": 1}])
def test_a_mass_does_not_fall_with_the_size_of_the_cells(
    stock: dict[str, float], cell_m: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Edges counted as grown by a cell made an upper mass 12 % too small with cells of 20 mm."""
    monkeypatch.setattr(yard_maps, "CELL_M", cell_m)
    one = laid(0.0, 0.19, yaw_deg=0.4, **stock)
    (told,) = find_bundles(map_of([one]), BundleSettings())
    section_m2, sigma_m2 = bundle_section(told)
    true_m2 = one.bars * np.pi / 4 * one.diameter_m**2
    assert section_m2 - UPPER * sigma_m2 < true_m2 < 1.005 * (section_m2 + UPPER * sigma_m2)
    assert one.length_m - 0.06 < told.length_m < one.length_m + 0.02


@pytest.mark.parametrize(("diameter_m", "yaw_deg", "seed"), [(0.08, 1.3, 1), (0.1, 1.3, 3)])
def test_one_bar_that_was_read_as_many_thin_ones_may_be_solid(
    diameter_m: float, yaw_deg: float, seed: int
) -> None:
    """A pack of thin bars as wide has 16 % less steel; at most as much was stated."""
    one = laid(0.0, diameter_m / 2 + 0.05, diameter_m=diameter_m, bars=1, yaw_deg=yaw_deg)
    (told,) = find_bundles(map_of([one], seed=seed), BundleSettings())
    section_m2, sigma_m2 = bundle_section(told)
    assert told.bar_diameter_m < 0.03
    assert np.pi / 4 * diameter_m**2 < section_m2 + UPPER * sigma_m2
