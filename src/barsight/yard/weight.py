"""Estimate what a bundle weighs, and how certain that is."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from barsight.core.arrays import Float64
from barsight.yard.lift_settings import UPPER
from barsight.yard.types import Bundle, known_sigma

STEEL_KG_PER_M3 = 7850.0
COUNT_SIGMA_RATIO = 0.08
"""Standard deviation of the cross-section of counted bars that their outline leaves, as a fraction."""


@dataclass(frozen=True)
class Mass:
    """A mass in kg and its standard deviation; NaN where it isn't known."""

    kg: float
    sigma_kg: float

    @property
    def upper_kg(self) -> float:
        """Return the upper bound that holds in 95 % of cases."""
        return self.kg + UPPER * self.sigma_kg

    def __add__(self, other: Mass) -> Mass:
        """Add both masses and their sigmas: the errors are taken as common, which is conservative."""
        return Mass(self.kg + other.kg, self.sigma_kg + other.sigma_kg)


def bundle_section(bundle: Bundle) -> tuple[float, float]:
    """Compute the cross-section of steel and its sigma, m2: of the bars if counted, otherwise as seen."""
    diameter = bundle.bar_diameter_m
    if bundle.bars is None or not diameter > 0:
        return bundle.section_m2, bundle.sigma.section_m2
    section = bundle.bars * math.pi / 4 * diameter**2
    share = math.hypot(2 * bundle.sigma.bar_diameter_m / diameter, COUNT_SIGMA_RATIO)
    return section, section * share


def bundle_mass(bundle: Bundle) -> Mass:
    """Compute the mass as cross-section x length x 7850 kg/m3; NaN where either is unknown.

    For a bundle with an open end it is the mass of the visible part.
    """
    section, sigma = bundle_section(bundle)
    if not (section > 0 and bundle.length_m > 0):
        return Mass(math.nan, math.nan)
    kg = section * bundle.length_m * STEEL_KG_PER_M3
    return Mass(kg, kg * math.hypot(sigma / section, known_sigma(bundle.sigma.length_m) / bundle.length_m))


def load_centre(bundles: tuple[Bundle, ...]) -> Float64:
    """Compute the centre of mass (2,), x and y, of bundles that are lifted together, NaN without any:
    weighted by mass, or all by outline where a mass isn't known.
    """
    if not bundles:
        return np.full(2, np.nan)
    weights = np.array([bundle_mass(bundle).kg for bundle in bundles])
    if not np.isfinite(weights).all():
        weights = np.array([bundle.length_m * bundle.width_m**2 for bundle in bundles])
    centres = np.array([bundle.centre_m[:2] for bundle in bundles])
    return np.asarray(weights @ centres / weights.sum())
