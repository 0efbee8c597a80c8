"""Define the records of heights: their source, contours, and the agreement with a reference."""

from __future__ import annotations

from dataclasses import dataclass

from barsight.core.arrays import Bool, Float64, UInt8


class HeightSource:
    """Codes of the source of a cell's height (band `source` of `height.tif`, `contour.csv`)."""

    UNKNOWN = 0
    VISION = 1
    LASER = 2
    FILLED = 3

    @classmethod
    def measured(cls, source: UInt8) -> Bool:
        """Mark the cells (...) that a sensor measured, by their codes (...)."""
        found: Bool = (source == cls.VISION) | (source == cls.LASER)
        return found


@dataclass(frozen=True, eq=False)
class Contour:
    """Heights along X at one y. x_m, y_m, z_m, sigma_m: (N,), NaN where unknown. source: (N,)
    `HeightSource`.
    """

    profile: int
    x_m: Float64
    y_m: Float64
    z_m: Float64
    sigma_m: Float64
    source: UInt8

    def __repr__(self) -> str:
        return f"<Contour {self.profile}: {self.x_m.size} points>"


@dataclass(frozen=True)
class AgreementIntervals:
    """95 % confidence intervals of a bias (mm), its limits of agreement and its slope over height (mm/m); NaN
    where there are too few samples. Named as in `Agreement`.

    effective_samples: number of independent samples that would estimate the mean equally well [Bayley 1946].
    smooth_loa_low, smooth_loa_high: limits of agreement, each uncertain by ± smooth_loa_half [Bland 1999].
    equivalence_mm: the smallest margin for which two one-sided tests at 5 % find the means equivalent
    [Schuirmann 1987]. vision_sd_mm: standard deviation that the reference's own sigma doesn't explain.
    within_95_pct: percentage of differences inside the 95 % interval that both sigmas predict.
    """

    smooth_samples: int
    effective_samples: float
    smooth_bias_mm: float
    smooth_bias_low_mm: float
    smooth_bias_high_mm: float
    smooth_loa_low_mm: float
    smooth_loa_high_mm: float
    smooth_loa_half_mm: float
    slope_mm_per_m: float
    slope_low_mm_per_m: float
    slope_high_mm_per_m: float
    equivalence_mm: float
    vision_sd_mm: float
    within_95_pct: float


@dataclass(frozen=True)
class Agreement(AgreementIntervals):
    """Agreement of a contour with a reference profile; all in mm but for the coverage.

    samples: compared points. coverage_pct: share of the reference's points that vision measured.
    bias is vision minus reference; loa_low, loa_high are Bland-Altman's 95 % limits of agreement. median and
    mae are of the absolute differences; smooth_mae is taken where the reference has no step over 30 mm within
    20 mm (NaN where it has steps everywhere): at a step the two methods may look past each other.
    x_shift_mm, z_shift_mm: how far the laser's profile lies along x and above where it fits best (NaN where
    too little is in common); time_shift_s: the delay of its clock that explains x_shift at the travel's
    speed. They are reported only: no other figure is corrected by them.
    """

    profile: int
    y_m: float
    samples: int
    coverage_pct: float
    bias_mm: float
    median_mm: float
    mae_mm: float
    smooth_mae_mm: float
    rmse_mm: float
    p95_mm: float
    max_mm: float
    loa_low_mm: float
    loa_high_mm: float
    x_shift_mm: float
    z_shift_mm: float
    time_shift_s: float
