"""Widen the sigma of an outline that may not be the bundle's: irregular bundles aren't hexagons, and others
are measured in part.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from barsight.yard.bundles.fitting.outline_fit import DIAMETER, FittedOutline
from barsight.yard.bundles.section.flanks import Flanks
from barsight.yard.lift_settings import UPPER
from barsight.yard.types import Bundle, BundleSigma, Doubt, DoubtKind

_WIDTH_RATIOS, _WIDTH_SIGMAS = (0.03, 0.12), (1.5, 2.0)
"""Errors of the width, in widths and in sigmas of a height; each where the pictures show the packing, and
where they don't. A map's sigma rises with the size of its pixels, and so does the growth of its edges.
"""
_SECTION_RATIO = 0.5
"""Error of the width as a fraction of the difference between the seen section's width and the outline's."""
_TOP_SIGMAS, _YAW_SIGMAS = 0.8, 0.4
"""Errors of the top's height and of the ends' lateral places, in sigmas of a height."""
_RESOLVED_M = 0.07
"""Minimum diameter (m) of bars whose shape shows in a map."""
DIAMETER_RATIOS = 0.06, 0.45, 0.6
"""Errors of a diameter, as fractions of it: where bars show their shape, where they are too thin for that,
and where another packing fits as well or many bars may look like one.
"""

_UNENDED_RATIO = 0.4
"""Error, in widths, of a side on which nothing shows where the bundle ends: it may be one of two outlines
that share a bundle.
"""


def widen_unended(bundle: Bundle, sides: int) -> Bundle:
    """Widen the sigma of a bundle by the number of sides on which nothing shows where it ends."""
    off_m = _UNENDED_RATIO * math.sqrt(sides) * bundle.width_m
    sigma = replace(
        bundle.sigma,
        width_m=math.hypot(bundle.sigma.width_m, off_m),
        lateral_m=math.hypot(bundle.sigma.lateral_m, off_m / 2),
    )
    return replace(bundle, sigma=sigma) if sides else bundle


def widen_unseen(bundle: Bundle, flanks: Flanks | None, max_width_m: float) -> Bundle:
    """Widen the sigma of a bundle that may go on, up to the maximum width of one, beside a flank where
    nothing was measured, as at the map's end. Its section isn't known.
    """
    if flanks is None or not flanks.unbounded:
        return bundle
    said = f"nothing was measured beside its {' and '.join(flanks.unbounded)} flank: it may be wider"
    wider_m = max(max_width_m - bundle.width_m, 0.0) / UPPER
    sigma = replace(
        bundle.sigma,
        width_m=float(np.hypot(bundle.sigma.width_m, wider_m)),
        lateral_m=float(np.hypot(bundle.sigma.lateral_m, wider_m / 2)),
        section_m2=np.nan,
    )
    reasons = (*bundle.reasons, Doubt(DoubtKind.MAY_GO_ON, said))
    return replace(bundle, bars=None, section_m2=np.nan, sigma=sigma, reasons=reasons)


def widen_sigma(
    sigma: BundleSigma,
    one: FittedOutline,
    seen_width_m: float | None,
    length_m: float,
    *,
    is_one_of_two: bool,
) -> BundleSigma:
    """Add the errors of a hexagon that is fitted to another outline.

    seen_width_m: width of the part that is seen, as bounded by its straps if they bound it. is_one_of_two:
    another packing fits as well. Where one edge is off, the middle is off by half as much.
    """
    fit, shown = one.fit, one.shades is not None
    ratio, sigmas = (parts[0 if shown else 1] for parts in (_WIDTH_RATIOS, _WIDTH_SIGMAS))
    section = 0.0 if seen_width_m is None else _SECTION_RATIO * abs(seen_width_m - fit.width_m)
    wide = float(np.linalg.norm([ratio * fit.width_m, sigmas * fit.sigma_m, section]))
    turned = 0.0 if shown else _YAW_SIGMAS * fit.sigma_m / max(length_m, fit.width_m)
    diameter, (shown_ratio, thin, unsettled) = float(fit.values[DIAMETER]), DIAMETER_RATIOS
    spread = shown_ratio if diameter >= _RESOLVED_M else thin
    if is_one_of_two or fit.rings == 0:
        spread = unsettled
    return replace(
        sigma,
        width_m=float(np.hypot(sigma.width_m, wide)),
        lateral_m=float(np.hypot(sigma.lateral_m, wide / 2)),
        top_z_m=float(np.hypot(sigma.top_z_m, _TOP_SIGMAS * fit.sigma_m)),
        yaw_rad=float(np.hypot(sigma.yaw_rad, turned)),
        bar_diameter_m=max(sigma.bar_diameter_m, spread * diameter),
    )
