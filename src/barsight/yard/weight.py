"""Estimate what a bundle weighs, and how sure that is."""

from __future__ import annotations

import math
from dataclasses import dataclass

from barsight.yard.lift_settings import UPPER
from barsight.yard.types import Bundle

STEEL_KG_PER_M3 = 7850.0
FILLED, FILLED_SIGMA = 0.76, 0.015
"""Steel's share of the circle around a hexagonal bundle: 0.778 for 7 bars, 0.753 for 61."""


@dataclass(frozen=True)
class Mass:
    """kg and one standard deviation; NaN where it can't be told."""

    kg: float
    sigma_kg: float

    @property
    def upper_kg(self) -> float:
        """Return a bound that holds in 95 % of cases."""
        return self.kg + UPPER * self.sigma_kg

    def __add__(self, other: Mass) -> Mass:
        """Add both; their errors are taken as common, which is the careful sum."""
        return Mass(self.kg + other.kg, self.sigma_kg + other.sigma_kg)


def bundle_mass(bundle: Bundle) -> Mass:
    """Compute steel's section x length x 7850 kg/m3; NaN where width or length is unknown.

    The section is the bars' number times one bar's where the number is known, else a share of the circle
    around the bundle. Of a bundle with an open end it is the mass of what was seen.
    """
    width, diameter, sigma = bundle.width_m, bundle.bar_diameter_m, bundle.sigma
    if not (width > 0 and diameter > 0 and bundle.length_m > 0):
        return Mass(math.nan, math.nan)
    if bundle.bars > 0:
        section = bundle.bars * math.pi / 4 * diameter**2
        share = 2 * sigma.bar_diameter_m / diameter
    else:
        section = FILLED * math.pi / 4 * width**2
        share = math.hypot(2 * sigma.width_m / width, FILLED_SIGMA / FILLED)
    kg = section * bundle.length_m * STEEL_KG_PER_M3
    longer = sigma.length_m / bundle.length_m if math.isfinite(sigma.length_m) else 0.0
    return Mass(kg, kg * math.hypot(share, longer))
