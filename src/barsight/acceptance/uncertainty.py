"""Combine parts of an uncertainty: standard uncertainty, degrees of freedom, coverage factor, expanded U."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf

import numpy as np
from scipy.stats import t as student

COVERAGE = 0.9545
"""Coverage probability of U, for which k = 2 with a normal distribution."""


@dataclass(frozen=True)
class UncertaintyPart:
    """One part of an uncertainty.

    sigma: standard uncertainty in the quantity's unit. distribution: normal, rectangular or t.
    degrees_of_freedom: inf for an exactly known sigma. measured_by: where the value comes from.
    """

    source: str
    sigma: float
    distribution: str = "normal"
    degrees_of_freedom: float = inf
    measured_by: str = ""


@dataclass(frozen=True)
class CombinedUncertainty:
    """A combined uncertainty.

    sigma: standard uncertainty. degrees_of_freedom: effective number [Welch 1947]. coverage: factor k for
    95.45 %. expanded: U = k sigma.
    """

    sigma: float
    degrees_of_freedom: float
    coverage: float
    expanded: float


def combine(parts: Sequence[UncertaintyPart]) -> CombinedUncertainty:
    """Combine independent parts by GUM: variances added, degrees of freedom by Welch and Satterthwaite."""
    variances = np.array([part.sigma**2 for part in parts])
    sigma = float(np.sqrt(variances.sum()))
    quotient = sum(
        part.sigma**4 / part.degrees_of_freedom for part in parts if np.isfinite(part.degrees_of_freedom)
    )
    free = sigma**4 / quotient if quotient > 0 else inf
    coverage = float(student.ppf((1 + COVERAGE) / 2, free))
    return CombinedUncertainty(sigma, free, coverage, coverage * sigma)
