"""Widen the sigma of an outline that is not surely the bundle's: irregular bundles are no hexagons."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from barsight.yard.bundles.fitting.outline_fit import DIAMETER, FittedOutline
from barsight.yard.types import BundleSigma

_WIDTH_RATIOS, _WIDTH_SIGMAS = (0.03, 0.12), (1.5, 2.0)
"""Of the width, and of a height's sigma: error of the width where the pictures show the packing, and where
not. A map's sigma rises with the size of its pixels, by which its edges grow."""
_SECTION_RATIO = 0.5
"""Of what the width of the section that is seen differs from the outline's."""
_TOP_SIGMAS, _YAW_SIGMAS = 0.8, 0.4
"""Of a height's sigma: error of the top, and of the ends' places sideways."""
_RESOLVED_M = 0.07
"""Bars from this diameter on show their shape in a map."""
DIAMETER_RATIOS = 0.06, 0.45, 0.6
"""Of a diameter: its error where bars show their shape, where they are thinner, and where another packing
fits as well or many bars may look like one."""


def widen_sigma(
    sigma: BundleSigma,
    one: FittedOutline,
    seen_width_m: float | None,
    length_m: float,
    *,
    is_one_of_two: bool,
) -> BundleSigma:
    """Add what a hexagon fitted to another outline leaves open. seen_width_m: of what is seen, by its straps
    where they bound it. is_one_of_two: another packing fits as well.

    Where one edge is off, the middle is off by half as much.
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
