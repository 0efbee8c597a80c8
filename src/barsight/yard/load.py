"""What a bundle weighs, and how sure that is."""

from __future__ import annotations

import math
from dataclasses import dataclass

from barsight.yard.contact import UPPER
from barsight.yard.types import Bundle

STEEL_KG_PER_M3 = 7850.0


@dataclass(frozen=True)
class Mass:
    """kg and one standard deviation; NaN where it can't be told."""

    kg: float
    sigma_kg: float

    @property
    def upper_kg(self) -> float:
        """A bound that holds in 95 % of cases."""
        return self.kg + UPPER * self.sigma_kg

    def __add__(self, other: Mass) -> Mass:
        """Both together; their errors are taken as common, which is the careful sum."""
        return Mass(self.kg + other.kg, self.sigma_kg + other.sigma_kg)


def mass_of(bundle: Bundle) -> Mass:
    """Bars x section x length x 7850 kg/m3; NaN where the bars' number or diameter is unknown.

    Of a bundle with an open end it is the mass of what was seen. The number of bars comes from the outline,
    so its uncertainty is that of the width, twice; a single bar is a single bar.
    """
    if bundle.bars < 1 or not bundle.bar_diameter_m > 0 or not bundle.length_m > 0:
        return Mass(math.nan, math.nan)
    section = math.pi / 4 * bundle.bar_diameter_m**2
    kg = bundle.bars * section * bundle.length_m * STEEL_KG_PER_M3
    sigma = bundle.sigma
    outline = 2 * sigma.width_m / bundle.width_m if bundle.bars > 1 else 0.0
    share = math.hypot(
        2 * sigma.bar_diameter_m / bundle.bar_diameter_m, sigma.length_m / bundle.length_m, outline
    )
    return Mass(kg, kg * share)
