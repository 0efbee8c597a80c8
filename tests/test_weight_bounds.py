"""Upper bounds of masses."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from barsight.yard.types import Bundle, BundleSigma
from barsight.yard.weight import bundle_mass


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
