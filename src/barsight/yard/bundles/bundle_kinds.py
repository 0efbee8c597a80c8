"""Group bundles by kind: neighbours mostly hold the same bars, so clear readings settle ambiguous ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from barsight.core.arrays import Float64, Int64
from barsight.yard.bundles.fitting.outline_fit import DIAMETER, Fit
from barsight.yard.bundles.pack_edges import DOUBTFUL
from barsight.yard.lift_settings import UPPER
from barsight.yard.types import Bundle, Doubt, DoubtKind

_ALIKE_LOG = 0.08
"""Standard deviation of the logarithm of the diameters that are read for bars of one kind."""
_SHARPNESS = 12.0
_BONUS = 0.5
_PRIOR_RATIO = 0.015
"""Spread of the diameters of one kind of bar, as a fraction; a floor for the common diameter's sigma."""
_MIN_MEMBERS = 3
_SAME_WIDTH = 0.2
_UNLISTED_SIGMAS = 3.0
"""Distance, in sigmas, beyond which a measured diameter matches none in the catalogue."""
_ROLLED_RATIO = 0.01
"""Minimum sigma of a catalogue diameter, as a fraction of it: the tolerance of rolled bars (EN 10060)."""
_AS_WELL, _AS_WELL_SINGLE, _AS_WELL_THIN = 0.95, 0.85, 0.6


def reinforce_kinds(fits: list[Fit], weights: Float64, chosen: Int64, overlaps: Float64) -> Float64:
    """Raise each weight by up to a half, in proportion to how many places hold the same rings and diameter.

    overlaps: (chosen, N), share of each chosen reading's place that every reading claims. A place supports
    every kind that explains it nearly as well as the best one does.
    """
    if chosen.size == 0:
        return weights
    rings = np.array([fit.rings for fit in fits])
    diameter = np.log([fit.values[DIAMETER] for fit in fits])
    raised = weights.copy()
    speaks = np.where((overlaps > 0.5) & (weights > 0), np.maximum(weights, 0), 0.0)
    speaks = (speaks / speaks.max(axis=1, keepdims=True)) ** _SHARPNESS
    for k in range(len(fits)):
        alike = np.exp(-0.5 * ((diameter - diameter[k]) / _ALIKE_LOG) ** 2) * (rings == rings[k])
        company = float((speaks * alike).max(axis=1).mean())
        raised[k] *= 1 + _BONUS * company if weights[k] > 0 else 1
    return raised


def other_packings(
    fits: list[Fit], weights: Float64, chosen: Int64, overlaps: Float64, resolved_m: float
) -> list[int | None]:
    """Find for each chosen reading the rings of another packing that explains all places of its kind as well.

    weights: those before `reinforce_kinds`. "As well" means at most 5 % less over all these places together.
    A single bar must lead by 15 %, and bars thinner than resolved_m by 40 %, since a smoothed map favours
    them.
    """
    rings = np.array([fit.rings for fit in fits])
    width = np.array([fit.width_m for fit in fits])
    own = weights[chosen]
    best = np.zeros((chosen.size, int(rings.max(initial=0)) + 1))
    for row, k in enumerate(chosen):
        alike = (overlaps[row] > 0.5) & (np.abs(width - width[k]) < _SAME_WIDTH * width[k])
        for other in np.unique(rings[alike]):
            best[row, other] = max(weights[alike & (rings == other)].max(), 0.0)
    out: list[int | None] = []
    for k in chosen:
        same = np.array([_alike(fits[k], fits[j]) for j in chosen])
        share = best[same].sum(axis=0) / own[same].sum()
        share[rings[k]] = 0.0
        thin = fits[k].values[DIAMETER] < resolved_m
        limit = _AS_WELL_THIN if thin else _AS_WELL_SINGLE if rings[k] == 0 else _AS_WELL
        out.append(int(share.argmax()) if share.max() > limit else None)
    return out


def _alike(fit: Fit, other: Fit) -> bool:
    step = np.log(other.values[DIAMETER] / fit.values[DIAMETER])
    return other.rings == fit.rings and abs(step) < 2.5 * _ALIKE_LOG


def common_diameter(fit: Fit, others: list[Fit]) -> tuple[float, float] | None:
    """Compute the median diameter and its sigma of the fit's kind; None for fewer than three bundles."""
    alike = [other.values[DIAMETER] for other in others if _alike(fit, other)]
    if len(alike) < _MIN_MEMBERS:
        return None
    spread = 1.25 * np.std(alike) / np.sqrt(len(alike))
    middle = float(np.median(alike))
    return middle, float(np.hypot(_PRIOR_RATIO * middle, spread))


def listed_diameter(bundle: Bundle, catalogue_mm: tuple[float, ...]) -> Bundle:
    """Replace the diameter d of a bundle whose bars aren't counted by a mean of the catalogue's diameters c.

    The weights are exp(-(c - d)^2 / 2 sigma^2). The lower bound is the thinnest c whose weight, relative to
    the largest one, reaches that of a one-sided 95 % bound, however many thick ones the catalogue lists.
    A bundle that matches no listed diameter is doubtful.
    """
    diameter, sigma = bundle.bar_diameter_m, bundle.sigma.bar_diameter_m
    if not catalogue_mm or bundle.bars is not None or not sigma > 0:
        return bundle
    listed = 1e-3 * np.array(catalogue_mm)
    away = (listed - diameter) / sigma
    if np.abs(away).min() > _UNLISTED_SIGMAS:
        said = f"its bars look {1e3 * diameter:.0f} mm thick: the catalogue has none like them"
        return replace(
            bundle, confidence=min(bundle.confidence, DOUBTFUL),
            reasons=(*bundle.reasons, Doubt(DoubtKind.OTHER, said)),
        )  # fmt: skip
    likely = np.exp(-0.5 * away**2)
    mean = float(likely @ listed / likely.sum())
    thinnest = float(listed[likely >= np.exp(-0.5 * UPPER**2) * likely.max()].min())
    spread = max((mean - thinnest) / UPPER, _ROLLED_RATIO * mean)
    return replace(bundle, bar_diameter_m=mean, sigma=replace(bundle.sigma, bar_diameter_m=spread))
