"""Compare two measured yards: bundles moved, settled, taken or added, and how certain that is."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.optimize import linear_sum_assignment

from barsight.core.arrays import Float64
from barsight.yard.axes import turn_between
from barsight.yard.map_lookup import lookup_heights
from barsight.yard.sections import part_about
from barsight.yard.types import UNKNOWN_SIGMA_M, UNKNOWN_SIGMA_RAD, Bundle, YardMap
from barsight.yard.weight import Mass, bundle_mass

Kind = Literal["same", "moved", "settled", "taken", "added", "not-seen"]
MAX_MOVE_M, SAME_WIDTH_RATIO = 0.5, 0.15
"""Maximum distance (m) between an old and a new bundle that may be one, and of their widths, as a share."""
SIGNIFICANT = 2.576
"""Number of sigmas that chance exceeds in one case out of a hundred."""
MIN_KNOWN = 0.5
"""Minimum share of a bundle's place that a map must have seen to tell that the bundle isn't there."""
_NO_PAIR = 1e6


@dataclass(frozen=True)
class Change:
    """The change of one bundle. old, new: its ids, None where it isn't present.

    across_mm, along_mm, up_mm, yaw_deg: new minus old, in the old bundle's axes; sigmas: of these four, from
    both measurements. z: the largest ratio of across, up and yaw to its sigma (also of along where both ends
    were seen). kg, sigma_kg: mass that was taken (negative) or added; NaN where unknown.
    """

    kind: Kind
    old: int | None
    new: int | None
    across_mm: float
    along_mm: float
    up_mm: float
    yaw_deg: float
    sigmas: tuple[float, float, float, float]
    z: float
    kg: float
    sigma_kg: float

    @property
    def significant(self) -> bool:
        """Check whether chance alone causes such a change in less than one case out of a hundred."""
        return self.kind in ("taken", "added") or self.z > SIGNIFICANT


def compare_yards(
    old: tuple[Bundle, ...], old_heights: YardMap, new: tuple[Bundle, ...], new_heights: YardMap
) -> tuple[Change, ...]:
    """Match the bundles of two maps of one yard and list the changes: in the old ones' order, then the added.

    A bundle that is gone is `taken` only where the new map saw its place, and a new one `added` only where
    the old map did; otherwise it is `not-seen`.
    """
    pairs = _match(old, new)
    changes = []
    for k, before in enumerate(old):
        if k in pairs:
            changes.append(_change(before, new[pairs[k]]))
        else:
            seen = _seen(before, new_heights)
            changes.append(_alone("taken" if seen else "not-seen", before.id, None, bundle_mass(before), -1))
    matched = set(pairs.values())
    for k, after in enumerate(new):
        if k not in matched:
            seen = _seen(after, old_heights)
            changes.append(_alone("added" if seen else "not-seen", None, after.id, bundle_mass(after), 1))
    return tuple(changes)


def _match(old: tuple[Bundle, ...], new: tuple[Bundle, ...]) -> dict[int, int]:
    """Match indices in `new` to those in `old`: smallest total distance, none longer than MAX_MOVE_M."""
    if not old or not new:
        return {}
    cost = np.full((len(old), len(new)), _NO_PAIR)
    for i, before in enumerate(old):
        for j, after in enumerate(new):
            across, along, up, _ = displacement(before, after)
            same = abs(after.width_m - before.width_m) < SAME_WIDTH_RATIO * before.width_m
            open_end = any(before.ends_open) or any(after.ends_open)
            way = math.hypot(across, 0.0 if open_end else along, 2 * up)
            if same and way < MAX_MOVE_M and abs(along) < before.length_m / 2:
                cost[i, j] = way
    rows, columns = linear_sum_assignment(cost)
    return {int(i): int(j) for i, j in zip(rows, columns, strict=True) if cost[i, j] < _NO_PAIR}


def displacement(before: Bundle, after: Bundle) -> tuple[float, float, float, float]:
    """Compute the displacement across, along, up (at the top; m) and in yaw (rad), in the
    old bundle's axes.
    """
    across, along = (before.axes @ (after.centre_m - before.centre_m)[:2]).tolist()
    turned = turn_between(before.yaw_rad, after.yaw_rad)
    return across + along * math.tan(turned) / 2, along, after.top_z_m - before.top_z_m, turned


def displacement_along(before: Bundle, after: Bundle) -> tuple[float, float]:
    """Compute the displacement along the old bundle's axis and its sigma (m): that of the middle where all
    ends were seen, otherwise that of an end that was seen both times; 0 where there is none.
    """
    along = displacement(before, after)[1]
    if not (any(before.ends_open) or any(after.ends_open)):
        return along, math.hypot(before.sigma.along_m, after.sigma.along_m)
    # Along X, a small turn swaps which end is the low one.
    swapped = math.cos(after.yaw_rad - before.yaw_rad) < 0
    for end, then in ((0, int(swapped)), (1, int(not swapped))):
        if not (before.ends_open[end] or after.ends_open[then]):
            away = after.ends_m[then, :2] - before.ends_m[end, :2]
            return float(before.axes[1] @ away), math.hypot(_end_sigma(before, end), _end_sigma(after, then))
    return 0.0, 0.0


def _end_sigma(bundle: Bundle, end: int) -> float:
    own = bundle.ends_sigma_m[end]
    if math.isfinite(own):
        return own
    parts = (bundle.sigma.along_m, bundle.sigma.length_m / 2)
    return math.hypot(*(part for part in parts if math.isfinite(part)))


def _change(before: Bundle, after: Bundle) -> Change:
    across, _, up, turned = displacement(before, after)
    along, sigma_along = displacement_along(before, after)
    a, b = before.sigma, after.sigma
    sigmas = (
        math.hypot(a.lateral_m, b.lateral_m), sigma_along,
        math.hypot(a.top_z_m, b.top_z_m), math.hypot(a.yaw_rad, b.yaw_rad),
    )  # fmt: skip
    turn = _ratio(turned, sigmas[3], UNKNOWN_SIGMA_RAD)
    ratios = (_ratio(across, sigmas[0]), _ratio(along, sigmas[1]), turn)
    lifted = _ratio(up, sigmas[2])
    kind: Kind = "same"
    if max(ratios) > SIGNIFICANT or (lifted > SIGNIFICANT and up > 0):
        kind = "moved"
    elif lifted > SIGNIFICANT:
        kind = "settled"
    millimetres = (1e3 * sigmas[0], 1e3 * sigmas[1], 1e3 * sigmas[2], math.degrees(sigmas[3]))
    return Change(
        kind, before.id, after.id, 1e3 * across, 1e3 * along, 1e3 * up, math.degrees(turned), millimetres,
        max(*ratios, lifted), 0.0, 0.0,
    )  # fmt: skip


def _ratio(value: float, sigma: float, unknown: float = UNKNOWN_SIGMA_M) -> float:
    """Compute the ratio of a value to its sigma; an unknown sigma counts as `unknown`."""
    sigma = unknown if math.isnan(sigma) else sigma
    return abs(value) / sigma if sigma > 0 else 0.0


def _alone(kind: Kind, old: int | None, new: int | None, mass: Mass, sign: int) -> Change:
    nan = math.nan
    return Change(kind, old, new, nan, nan, nan, nan, (nan,) * 4, nan, sign * mass.kg, mass.sigma_kg)


def _seen(bundle: Bundle, heights: YardMap) -> bool:
    """Check whether a map saw the place of a bundle found in the other map."""
    return bool(np.isfinite(heights_over(bundle, heights)).mean() >= MIN_KNOWN)


def heights_over(bundle: Bundle, heights: YardMap) -> Float64:
    """Look up a map's heights (40, 5) over a bundle's outline, along it and across; NaN where unseen."""
    u = np.linspace(-0.4, 0.4, 5) * bundle.width_m
    v = np.linspace(-0.45, 0.45, 40) * bundle.length_m
    vv, uu = np.meshgrid(v, u, indexing="ij")
    across, along = bundle.axes
    x, y = (bundle.centre_m[k] + uu * across[k] + vv * along[k] for k in (0, 1))
    return lookup_heights(part_about(heights, x, y), x, y)
