"""Estimate a diameter from the power spectrum of a bundle's gray levels.

Bars side by side are as far apart as they are thick, or closer where some are partly hidden. So the spectrum
S over the frequency f rises towards f d = 1 and falls steeply beyond. Its mean over f d was learnt from drawn
packs (benchmarks/pitch_spectra.py).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
from scipy import ndimage

from barsight.bundle_pictures.profiles import STEP_M, PitchProfile
from barsight.core.arrays import Float64, frozen

FREQUENCIES = np.arange(6.0, 141.0)
"""Frequencies (F,), per m, of a spectrum."""
DIAMETERS_M = np.exp(np.arange(np.log(0.008), np.log(0.14), 0.02))
"""Candidate diameters (D,)."""
CLASSES = 0.13, 0.26
"""Limits, in diameter over width, between the classes with a mean spectrum of their own. The fewer bars a
profile crosses, the wider are its peaks.
"""
LOG_RATIOS = np.log(0.08) + 0.12 * np.arange(36)
"""Logarithms (R,) of f d at which mean spectra are known."""
_HIGH_PASS_M = 0.04
_FLOOR = 2e-5
"""Power added to a spectrum before its logarithm."""
_HIGHEST = 0.5
"""Highest frequency used, in cycles per pixel."""
_DEGREES = 4.0
"""Degrees of freedom of Student's t distribution of a spectrum's logarithm."""
_APART, _TEMPERATURE = 1.5, 0.5
"""Separation of independent frequencies, times the profile's length; exponent of the likelihood, for the
errors that all frequencies share.
"""
_MAX_WIDTHS = 1.2
"""Maximum diameter, relative to the length of a profile."""


def power_spectrum(profiles: Sequence[PitchProfile]) -> Float64:
    """Compute the mean power spectrum (F,) of profiles (N,) of equal length, with a Hann window h:
    S(f) = |sum_k h_k l_k exp(-2 pi i f u_k)|^2 / sum_k h_k^2.
    """
    levels = np.array([profile.levels for profile in profiles])
    levels = levels - ndimage.gaussian_filter1d(levels, _HIGH_PASS_M / STEP_M, axis=1, mode="nearest")
    window = np.hanning(levels.shape[1])
    levels = window * (levels - (levels @ window / window.sum())[:, None])
    turns = np.exp(-2j * np.pi * FREQUENCIES[:, None] * STEP_M * np.arange(levels.shape[1]))
    power = np.abs(levels @ turns.T) ** 2 / (window**2).sum()
    return np.asarray(power.mean(axis=0), np.float64)


def log_spectrum(profiles: Sequence[PitchProfile]) -> tuple[Float64, float]:
    """Compute the logarithm of the power spectrum, corrected for the averaging by pixels of size p,
    S / sinc(f p)^4, and the profiles' length, m. NaN at frequencies that the pixels don't resolve.
    """
    pixel_m = float(np.median([profile.pixel_m for profile in profiles]))
    shown = np.maximum(np.sinc(FREQUENCIES * pixel_m) ** 4, 0.02)
    level = np.log((power_spectrum(profiles) + _FLOOR) / shown)
    return np.where(_HIGHEST / pixel_m > FREQUENCIES, level, np.nan), STEP_M * profiles[0].levels.size


def fit_diameters(level: Float64, length_m: float) -> tuple[Float64, Float64]:
    """Compute the log-likelihood and the misfit of each diameter (D,).

    log S = a + m(f d) + s(f d) t, with the mean m and scale s of the class of d, t from Student's
    distribution, and a free. The misfit is the mean negative logarithm of the distribution: 0.5 is usual.
    """
    known = np.isfinite(level)
    classes = np.searchsorted(CLASSES, DIAMETERS_M / length_m, side="right")
    mean, scale = (table[classes, np.arange(DIAMETERS_M.size)][:, known] for table in _tables())
    apart, weight = level[known] - mean, scale**-2
    apart = (apart - (apart * weight).sum(axis=1, keepdims=True) / weight.sum(axis=1, keepdims=True)) / scale
    terms = (_DEGREES + 1) / 2 * np.log1p(apart**2 / _DEGREES)
    likely = -(terms + np.log(scale)).sum(axis=1) * length_m / _APART * _TEMPERATURE
    return np.where(_MAX_WIDTHS * length_m < DIAMETERS_M, -np.inf, likely), terms.mean(axis=1)


@cache
def _tables() -> tuple[Float64, Float64]:
    """Interpolate the mean and scale (C, D, F) of a spectrum's logarithm, by class, diameter and
    frequency.
    """
    at = np.log(DIAMETERS_M[:, None] * FREQUENCIES)
    mean, scale = (
        np.array([np.interp(at, LOG_RATIOS, one[k]) for one in MEAN_SPECTRA]) for k in range(2)
    )  # fmt: skip
    return frozen(mean), frozen(scale)


MEAN_SPECTRA = tuple(
    (np.array(mean), np.array(scale)) for mean, scale in (
        ((
            -0.83, -0.83, -0.82, -0.81, -0.96, -0.97, -0.84, -0.72, -0.67, -0.66, -0.65, -0.66,
            -0.60, -0.54, -0.56, -0.55, -0.47, -0.45, -0.33, -0.11, 0.27, 0.81, 0.80, -0.63,
            -1.70, -2.16, -2.29, -1.71, -1.55, -1.55, -1.55, -1.55, -1.55, -1.55, -1.55, -1.55,
        ), (
            0.76, 0.76, 0.78, 0.74, 0.56, 0.48, 0.46, 0.41, 0.40, 0.45, 0.51, 0.58,
            0.61, 0.56, 0.55, 0.59, 0.63, 0.70, 0.85, 1.03, 1.09, 1.06, 1.14, 1.23,
            1.10, 0.91, 0.90, 1.19, 1.35, 1.36, 1.36, 1.36, 1.36, 1.36, 1.36, 1.36,
        )),
        ((
            -1.55, -1.55, -1.55, -1.55, -1.55, -1.55, -1.52, -1.41, -1.31, -1.18, -1.12, -0.99,
            -0.88, -0.82, -0.80, -0.82, -0.86, -0.79, -0.48, -0.07, 0.38, 0.90, 0.94, 0.18,
            -1.24, -2.03, -2.14, -1.84, -2.53, -3.13, -2.82, -2.86, -3.46, -3.49, -4.08, -4.24,
        ), (
            0.60, 0.60, 0.60, 0.60, 0.60, 0.59, 0.59, 0.58, 0.60, 0.58, 0.49, 0.41,
            0.40, 0.40, 0.46, 0.59, 0.69, 0.81, 0.96, 1.08, 1.06, 0.95, 0.95, 0.93,
            0.96, 0.88, 0.86, 0.96, 0.85, 0.78, 0.80, 0.69, 0.54, 0.49, 0.63, 0.71,
        )),
        ((
            -2.00, -2.00, -2.00, -2.00, -2.00, -2.00, -2.00, -2.00, -2.00, -2.00, -2.00, -1.99,
            -1.95, -1.73, -1.42, -1.14, -0.84, -0.53, -0.21, 0.06, 0.27, 0.40, 0.39, 0.15,
            -0.35, -1.00, -1.48, -1.73, -1.97, -2.36, -2.31, -2.35, -2.92, -3.18, -3.72, -3.82,
        ), (
            0.55, 0.55, 0.55, 0.55, 0.55, 0.55, 0.55, 0.55, 0.55, 0.55, 0.55, 0.54,
            0.52, 0.44, 0.40, 0.40, 0.40, 0.40, 0.40, 0.40, 0.40, 0.40, 0.40, 0.40,
            0.59, 0.78, 0.81, 0.77, 0.69, 0.62, 0.55, 0.54, 0.54, 0.49, 0.46, 0.43,
        )),
    )
)  # fmt: skip
"""Mean (R,) and scale (R,) of a spectrum's logarithm at LOG_RATIOS, by class: of 433 bundles of drawn yards,
seeds 1505 to 1619 (`benchmarks/pitch_spectra.py learn`)."""
