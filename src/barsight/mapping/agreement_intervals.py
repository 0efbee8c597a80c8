"""Estimate the confidence intervals of an agreement at smooth places: samples along a profile are
autocorrelated, so fewer of them count as independent.
"""

from __future__ import annotations

import numpy as np
from scipy.special import stdtrit

from barsight.core.arrays import Bool, Float64
from barsight.core.linalg.robust import SIGMAS_95
from barsight.core.records.heights import AgreementIntervals

MIN_SAMPLES = 8
"""Minimum number of samples for which confidence intervals are computed."""
ROUNDS = 10
MIN_ALONE = 1.5
"""So many independent samples any series has: of fewer, the spread about their mean says nothing."""


def effective_samples(series: Float64) -> float:
    """Count the independent samples that would estimate the mean of a series equally well; NaN marks gaps.

    series: (N,) evenly spaced. The sum of autocorrelations ends at the first pair of lags whose sum isn't
    positive, and each pair counts at most as much as the one before it [Geyer 1992]. Autocorrelations about
    the series' own mean are too small by that mean's variance, which is added back.
    """
    known = np.isfinite(series)
    count = int(known.sum())
    if count < MIN_SAMPLES:
        return float(count)
    centred = np.where(known, series - series[known].mean(), 0.0)
    if not centred.any():
        return float(count)
    size = 1 << int(np.ceil(np.log2(2 * series.size)))
    products = np.fft.irfft(np.abs(np.fft.rfft(centred, size)) ** 2, size)[: series.size]
    pairs = np.rint(np.fft.irfft(np.abs(np.fft.rfft(known.astype(float), size)) ** 2, size)[: series.size])
    lags = np.arange(count // 2)
    lags = lags[pairs[lags] > 0]
    seen = products[lags] / pairs[lags] * count / products[0]
    weight, alone = np.where(lags == 0, 1.0, 2 * pairs[lags] / count), float(count)
    for _ in range(ROUNDS):
        rho = seen + (1 - seen) / alone
        terms = (weight * rho)[: 2 * (lags.size // 2)].reshape(-1, 2).sum(axis=1)
        ended = np.flatnonzero(terms <= 0)
        terms = np.minimum.accumulate(terms[: ended[0]] if ended.size else terms)
        alone = max(count / max(float(terms.sum()), 1.0), MIN_ALONE)
    return alone


def agreement_intervals(
    difference_m: Float64, reference_m: Float64, sigma_m: Float64, reference_sigma_m: float, places: Bool
) -> AgreementIntervals:
    """Compute the confidence intervals of differences (N,), evenly spaced along a profile, m, at the marked
    places.

    difference_m: NaN where there is none. reference_m: (N,) heights. sigma_m: (N,) of the heights that are
    compared with the reference; reference_sigma_m: NaN if unknown, which is treated as 0. places: (N,) True
    where a difference counts.
    """
    used = places & np.isfinite(difference_m)
    series = np.where(used, 1e3 * difference_m, np.nan)
    d, count = series[used], int(used.sum())
    if count < MIN_SAMPLES:
        return AgreementIntervals(count, *[float("nan")] * 13)
    alone = effective_samples(series)
    bias, spread = float(d.mean()), float(d.std() / np.sqrt(1 - 1 / alone))
    free = max(alone - 1, 1.0)
    standard = spread / np.sqrt(alone)
    half, one_sided = (float(stdtrit(free, share)) * standard for share in (0.975, 0.95))
    slope, slope_half = _slope(series, reference_m + difference_m / 2, used)
    laser = 0.0 if np.isnan(reference_sigma_m) else reference_sigma_m
    stated = 1e3 * np.hypot(sigma_m[used], laser)
    return AgreementIntervals(
        count, alone, bias, bias - half, bias + half, bias - SIGMAS_95 * spread, bias + SIGMAS_95 * spread,
        float(stdtrit(free, 0.975)) * spread * float(np.sqrt(1 / alone + SIGMAS_95**2 / (2 * free))),
        slope, slope - slope_half, slope + slope_half, abs(bias) + one_sided,
        float(np.sqrt(max(spread**2 - (1e3 * laser) ** 2, 0.0))),
        100 * float(np.mean(np.abs(d) <= SIGMAS_95 * stated)),
    )  # fmt: skip


def _slope(series: Float64, mean_m: Float64, used: Bool) -> tuple[float, float]:
    """Fit the slope of the difference over the mean of both (proportional bias): mm/m, and half its 95 %
    interval.

    The variance is increased for the residuals' autocorrelation. NaN where all heights are alike.
    """
    height = mean_m[used] - mean_m[used].mean()
    square = float(height @ height)
    if square < 1e-6 * height.size:
        return float("nan"), float("nan")
    d = series[used]
    slope = float(height @ d) / square
    rest = np.full_like(series, np.nan)
    rest[used] = d - d.mean() - slope * height
    alone = effective_samples(rest)
    free = max(alone - 2, 1.0)
    variance = float(rest[used] @ rest[used]) / max(d.size - 2, 1) / square * d.size / alone
    return slope, float(stdtrit(free, 0.975)) * float(np.sqrt(variance))
