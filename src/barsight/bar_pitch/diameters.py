"""Measure the diameters of bars that aren't counted by their pitch in the pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from barsight.bar_pitch.profiles import PitchProfile, pitch_profiles
from barsight.bar_pitch.spectra import DIAMETERS_M, log_likelihood, log_spectrum
from barsight.core.arrays import Float64
from barsight.core.pose import Pose
from barsight.recording.rectified_pairs import RectifiedPairs
from barsight.yard.lift_settings import UPPER
from barsight.yard.types import Bundle, YardMap

_SHAPE_SIGMA, _SHAPE_SHARE = 0.06, 0.9
"""Sigma of a diameter's logarithm where bars show their shape in the map, and how often that holds."""
_MAX_SHAPE_SIGMA = 0.1
"""Of a diameter: one that is said to be surer is told by the bars' shape."""
_MIN_PLACES = 40
"""A profile needs so many places."""
_LOWER, _MIN_RATIO = 0.05, 0.02
"""Quantile of the lower bound, and the least that it lies under the mean, of that: diameters are compared
2 % apart."""


def measure_diameters(
    pairs: RectifiedPairs, poses: Mapping[int, Pose], heights: YardMap, bundles: Sequence[Bundle]
) -> tuple[Bundle, ...]:
    """Measure the bars' diameters of bundles whose bars aren't counted; see `with_pitch`.

    poses: reference_from_body by stamp of the frames that may be looked at.
    """
    open_ones = [k for k, bundle in enumerate(bundles) if bundle.bars is None]
    profiles = pitch_profiles(pairs, poses, heights, [bundles[k] for k in open_ones])
    out = list(bundles)
    for k, seen in zip(open_ones, profiles, strict=True):
        out[k] = with_pitch(bundles[k], seen)
    return tuple(out)


def with_pitch(bundle: Bundle, profiles: Sequence[PitchProfile]) -> Bundle:
    """Replace a diameter by the mean of its distribution given the pitch, and the bars' shape where they show
    it. One sigma is what the 5 % quantile lies under the mean, over 1.645: lifts count with that quantile.
    The same bundle where no picture shows enough of it.
    """
    if not profiles or profiles[0].levels.size < _MIN_PLACES:
        return bundle
    likely = log_likelihood(*log_spectrum(profiles))
    share = np.exp(likely - likely.max()) * _by_shape(bundle)
    share /= share.sum()
    mean = float(share @ DIAMETERS_M)
    lower = float(np.exp(np.interp(_LOWER, np.cumsum(share), np.log(DIAMETERS_M))))
    sigma = replace(bundle.sigma, bar_diameter_m=max(mean - lower, _MIN_RATIO * mean) / UPPER)
    return replace(bundle, bar_diameter_m=mean, sigma=sigma)


def _by_shape(bundle: Bundle) -> Float64:
    """Compute the prior (D,) of the diameters by the bars' shape in the map; flat where it doesn't show."""
    diameter, sigma = bundle.bar_diameter_m, bundle.sigma.bar_diameter_m
    flat = np.full(DIAMETERS_M.size, 1 / DIAMETERS_M.size)
    if not 0 < sigma <= _MAX_SHAPE_SIGMA * diameter:
        return flat
    shape = np.exp(-0.5 * (np.log(DIAMETERS_M / diameter) / _SHAPE_SIGMA) ** 2)
    return np.asarray(_SHAPE_SHARE * shape / max(float(shape.sum()), 1e-12) + (1 - _SHAPE_SHARE) * flat)
