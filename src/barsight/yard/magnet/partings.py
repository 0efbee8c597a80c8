"""Find in the map which bundles a deep gully separates from what the poles reach."""

from __future__ import annotations

import math

import numpy as np

from barsight.core.arrays import Bool, Float64
from barsight.core.linalg.robust import nan_medians
from barsight.yard.magnet.footprint import BundleTable, Grip, Placement
from barsight.yard.magnet.reach import ALONG_M, MAX_SKEW, parts_beside
from barsight.yard.magnet.seen_edges import SLIGHT
from barsight.yard.map_lookup import lookup_heights
from barsight.yard.types import Bundle, HeightMap

_DEEP_M, _DEEP_RATIO = 0.1, 0.4
"""Minimum depth (m) of a gully that separates two bundles, and the same in widths of the wider one: in 3757
simulated packs no gully is deeper than 86 mm or 0.39 of the width.
"""
_STEP_M = 0.005
_SEEN_RATIO = 0.5
"""Minimum share of a part along a pole that must have been seen for its median to count."""


def without_parted(
    held: Grip, heights: HeightMap, place: Placement, table: BundleTable, reached: Float64
) -> Grip:
    """Remove from the count's uncertainty the bundles that are certainly separated from all that the poles
    reach.

    reached: (P, 4) of `reach.reached_strips`. Only a gully that was seen separates; places out of sight don't
    count.
    """
    if len(held.gripped) != 1:
        return held
    load, flips = table.bundles[held.gripped[0]], held.flips.copy()
    for number, other in enumerate(table.bundles):
        if (
            flips[number] > SLIGHT
            and number not in held.gripped
            and _parted(load, other, heights, place, reached)
        ):
            flips[number] = 0.0
    return Grip(held.gripped, float(np.prod(1 - flips)), flips)


def _parted(load: Bundle, other: Bundle, heights: HeightMap, place: Placement, reached: Float64) -> bool:
    """Check that a gully runs between every pole's reach and another bundle, over its whole length.

    One that lies beside no pole, such as behind the load, has no gully beside it.
    """
    if any(abs(math.sin(bundle.yaw_rad - place.yaw_rad)) > MAX_SKEW for bundle in (load, other)):
        return False
    deep = max(_DEEP_M, _DEEP_RATIO * max(load.width_m, other.width_m))
    is_beside = False
    for pole in reached:
        if pole[2] == 0 or pole[3] == 0:
            continue
        for low, high, beside in parts_beside(other, place, pole):
            is_beside = True
            v = np.arange(low, high + ALONG_M / 2, ALONG_M)
            if not _gully(_profile(heights, place, v, pole[1], beside), pole[3] / 2, deep):
                return False
    return is_beside


def _profile(heights: HeightMap, place: Placement, along_m: Float64, from_m: float, to_m: float) -> Float64:
    """Compute median heights along the beam at places _STEP_M apart across it, from one to another; NaN where
    too little was seen.
    """
    across = from_m + np.sign(to_m - from_m) * np.arange(0.0, abs(to_m - from_m), _STEP_M)
    at = (
        np.array([place.x_m, place.y_m])
        + along_m[:, None, None] * place.along
        + across[None, :, None] * place.across
    )
    z = lookup_heights(heights, at[..., 0], at[..., 1])
    seen: Bool = np.isfinite(z)
    enough = seen.mean(axis=0) >= _SEEN_RATIO
    level = np.full(across.size, np.nan)
    if enough.any():
        level[enough] = nan_medians(z[:, enough])
    return level


def _gully(level: Float64, half_m: float, deep_m: float) -> bool:
    """Check that, beyond half_m from its beginning, a profile sinks by deep_m under both of its sides."""
    first = math.ceil(half_m / _STEP_M)
    known = np.where(np.isfinite(level), level, -np.inf)
    if first >= len(known) or not np.isfinite(level[:first]).any():
        return False
    before = np.maximum.accumulate(known)
    behind = np.maximum.accumulate(known[::-1])[::-1]
    sunken = np.minimum(before, behind) - level
    return bool(np.nanmax(sunken[first:], initial=0.0) >= deep_m)
