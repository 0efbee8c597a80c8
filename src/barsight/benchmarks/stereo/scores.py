"""Score a disparity map against the truth with Middlebury's measures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from barsight.core.arrays import Bool, Float32
from barsight.core.records.disparity import Disparity


@dataclass(frozen=True)
class StereoScore:
    """Percentages refer to the pixels with known truth; a missing disparity counts as bad.

    bad05, bad1, bad2: wrong by more than 0.5, 1 and 2 px, of all known pixels. counted_bad05, counted_bad1,
    counted_bad2: the same of the scene's scored pixels. average_px, median_px: mean and median absolute error
    over the known pixels that have a disparity. coverage_pct, counted_coverage_pct: pixels that have a
    disparity. within1_pct, within2_pct: of the scored pixels that have one, those with errors within 1 and 2
    of their sigma.
    """

    bad05_pct: float
    bad1_pct: float
    bad2_pct: float
    counted_bad05_pct: float
    counted_bad1_pct: float
    counted_bad2_pct: float
    average_px: float
    median_px: float
    coverage_pct: float
    counted_coverage_pct: float
    within1_pct: float
    within2_pct: float


def score_disparity(disparity: Disparity, truth_px: Float32, counted: Bool) -> StereoScore:
    """Score against truth_px (NaN where unknown); counted: (H, W) bool, the scene's scored pixels.

    A figure is NaN if there are no pixels to compute it from.
    """
    known = np.isfinite(truth_px)
    visible = counted & known
    has = np.isfinite(disparity.disparity_px)
    error = np.abs(disparity.disparity_px - truth_px)
    error[~has] = np.inf
    met = error[known & has]
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = (error / disparity.sigma_px)[visible & has]
    return StereoScore(
        bad05_pct=_percent(error > 0.5, known),
        bad1_pct=_percent(error > 1, known),
        bad2_pct=_percent(error > 2, known),
        counted_bad05_pct=_percent(error > 0.5, visible),
        counted_bad1_pct=_percent(error > 1, visible),
        counted_bad2_pct=_percent(error > 2, visible),
        average_px=float(met.mean(dtype=np.float64)) if met.size else float("nan"),
        median_px=float(np.median(met)) if met.size else float("nan"),
        coverage_pct=_percent(has, known),
        counted_coverage_pct=_percent(has, visible),
        within1_pct=100 * float((ratio <= 1).mean()) if ratio.size else float("nan"),
        within2_pct=100 * float((ratio <= 2).mean()) if ratio.size else float("nan"),
    )


def _percent(which: Bool, among: Bool) -> float:
    count = int(np.count_nonzero(among))
    return 100 * int(np.count_nonzero(which & among)) / count if count else float("nan")
