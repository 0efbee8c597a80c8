"""Combine parts of an uncertainty: standard uncertainty, degrees of freedom, coverage, expanded U."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf

import numpy as np
from scipy.stats import t as student

COVERAGE = 0.9545
"""Probability that U covers: k = 2 for a normal distribution."""


@dataclass(frozen=True)
class UncertaintyPart:
    """One part: its source, standard uncertainty in the quantity's unit, its distribution (normal,
    rectangular, t), degrees of freedom (inf: known), and what measured it.
    """

    source: str
    sigma: float
    distribution: str = "normal"
    degrees_of_freedom: float = inf
    measured_by: str = ""


@dataclass(frozen=True)
class CombinedUncertainty:
    """sigma: standard uncertainty. degrees_of_freedom: effective ones [Welch 1947]. coverage: k for 95.45 %.
    expanded: U = k sigma.
    """

    sigma: float
    degrees_of_freedom: float
    coverage: float
    expanded: float


def combine(parts: Sequence[UncertaintyPart]) -> CombinedUncertainty:
    """Combine independent parts by GUM: squares added, degrees of freedom by Welch and Satterthwaite."""
    variances = np.array([part.sigma**2 for part in parts])
    sigma = float(np.sqrt(variances.sum()))
    quotient = sum(
        part.sigma**4 / part.degrees_of_freedom for part in parts if np.isfinite(part.degrees_of_freedom)
    )
    free = sigma**4 / quotient if quotient > 0 else inf
    coverage = float(student.ppf((1 + COVERAGE) / 2, free))
    return CombinedUncertainty(sigma, free, coverage, coverage * sigma)
