"""Measure the diameter of bars that can't be counted by their pitch in the pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from barsight.bundle_pictures.profiles import WINDOW_M, PitchProfile
from barsight.bundle_pictures.spectra import DIAMETERS_M, fit_diameters, log_spectrum
from barsight.core.arrays import Float64
from barsight.yard.bundles.irregular import DIAMETER_RATIOS
from barsight.yard.lift_settings import UPPER
from barsight.yard.placement.load import is_one_bar
from barsight.yard.types import Bundle

_SHAPE_SIGMA, _, _ONE_BAR_SIGMA = DIAMETER_RATIOS
_SHAPE_SHARE = 0.9
"""Share of the diameters found by the bars' shape in the map that are right within their sigma."""
_MAX_SHAPE_SIGMA = 0.1
"""Maximum sigma, per diameter, of a diameter that the bars' shape in the map determines."""
_MIN_PLACES = 40
"""Minimum number of samples in a profile."""
_LOWER, _MAX_LOWER_RATIO = 0.05, 0.75
"""Quantile used as lower bound, and the bound's maximum ratio to the mean where only the pitch is known:
packs, finishes and light differ from those of the training set.
"""
_FINER_RATIO = 0.5
"""Minimum ratio of the pitch's 95 % quantile to the diameter of what is detected as one bar; below it the bar
is many thin ones. Where the pitch is less fine, the single bar is unsure: its gloss and scratches have a
pitch too.
"""
_MAX_MISFIT = 1.5
"""Maximum misfit of a spectrum to a diameter that explains it; 1 % of drawn packs exceed it."""
_MIN_POWER_LOG = -6.0
"""Minimum logarithm of the highest power: drawn packs have -4.3 and more, noise on a smooth face -8.5."""


def with_pitch(bundle: Bundle, profiles: Sequence[PitchProfile]) -> Bundle:
    """Replace a diameter by the mean of its posterior, given the pitch and the bars' shape where it shows.

    One sigma is the distance from the mean to the 5 % quantile, over 1.645, because lifts use that quantile.
    What was detected as one bar keeps its diameter unless the pitch is far finer. Returns the same bundle
    where no picture shows enough of it, its axis is too uncertain, or no diameter explains the spectrum.
    """
    if not profiles or profiles[0].levels.size < _MIN_PLACES:
        return bundle
    if bundle.sigma.yaw_rad * WINDOW_M > profiles[0].pixel_m:
        return bundle
    level, length_m = log_spectrum(profiles)
    likely, misfit = fit_diameters(level, length_m)
    if np.nanmax(level) < _MIN_POWER_LOG or misfit[likely.argmax()] > _MAX_MISFIT:
        return bundle
    share = np.exp(likely - likely.max()) * _by_shape(bundle)
    share /= share.sum()
    mean = float(share @ DIAMETERS_M)
    lower, upper = np.exp(np.interp([_LOWER, 1 - _LOWER], np.cumsum(share), np.log(DIAMETERS_M)))
    told = bundle.bar_diameter_m
    if is_one_bar(bundle) and upper > _FINER_RATIO * told:
        spread = bundle.sigma.bar_diameter_m
        return _told(bundle, told, spread if upper >= told else max(spread, _ONE_BAR_SIGMA * told))
    most = 1 - UPPER * _SHAPE_SIGMA if _shows_shape(bundle) else _MAX_LOWER_RATIO
    return _told(bundle, mean, (mean - min(float(lower), most * mean)) / UPPER)


def _told(bundle: Bundle, diameter_m: float, sigma_m: float) -> Bundle:
    return replace(
        bundle, bar_diameter_m=diameter_m, sigma=replace(bundle.sigma, bar_diameter_m=sigma_m)
    )  # fmt: skip


def _shows_shape(bundle: Bundle) -> bool:
    """Check whether the bars' shape in the map determines their diameter."""
    return 0 < bundle.sigma.bar_diameter_m <= _MAX_SHAPE_SIGMA * bundle.bar_diameter_m


def _by_shape(bundle: Bundle) -> Float64:
    """Compute the prior (D,) of the diameters from the bars' shape in the map; flat where it doesn't show."""
    flat = np.full(DIAMETERS_M.size, 1 / DIAMETERS_M.size)
    if not _shows_shape(bundle):
        return flat
    shape = np.exp(-0.5 * (np.log(DIAMETERS_M / bundle.bar_diameter_m) / _SHAPE_SIGMA) ** 2)
    return np.asarray(_SHAPE_SHARE * shape / max(float(shape.sum()), 1e-12) + (1 - _SHAPE_SHARE) * flat)
