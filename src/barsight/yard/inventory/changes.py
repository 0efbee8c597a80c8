"""Compare two measured yards: bundles moved, settled, taken or added, and how certain that is."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from barsight.core.arrays import Bool, Float64
from barsight.yard.inventory.matching import (
    MOVE_SIGMAS,
    SAME_PLACE_SIGMAS,
    Places,
    common_shift,
    displace,
    find_candidates,
    match_candidates,
)
from barsight.yard.map_lookup import lookup_heights
from barsight.yard.sections import part_about
from barsight.yard.types import Bundle, YardMap
from barsight.yard.weight import Mass, bundle_mass

Finding = Literal["gone", "covered", "not-found", "unseen"]
Kind = Literal["same", "moved", "settled", "taken", "added", "covered", "not-found", "not-seen"]
MAX_MOVE_M = 0.5
"""Maximum distance (m) across or along by which a bundle may have moved and still be the same."""
MIN_KNOWN = 0.5
"""Minimum share of a bundle's place that a map must have seen to tell that the bundle isn't there."""


@dataclass(frozen=True)
class Change:
    """The change of one bundle. old, new: its ids, None where it isn't present.

    across_mm, along_mm, up_mm, yaw_deg: new minus old beyond the shift of the whole yard, in the old bundle's
    axes; sigmas: of these four, from both measurements. z: the largest ratio of these to their sigmas. kg,
    sigma_kg: mass that was taken (negative) or added; NaN where unknown.
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
        """Check whether chance alone causes such a change in less than one case out of a thousand."""
        return self.kind in ("taken", "added") or self.z > MOVE_SIGMAS


@dataclass(frozen=True, eq=False)
class YardChanges:
    """The changes of the bundles: in the old ones' order, then the others. shift_m: (3,) by which the new
    yard as a whole lies off the old one, as an error of its frame does.
    """

    changes: tuple[Change, ...]
    shift_m: Float64


def compare_yards(
    old: tuple[Bundle, ...], old_heights: YardMap, new: tuple[Bundle, ...], new_heights: YardMap
) -> YardChanges:
    """Match the bundles of two maps of one yard and list the changes.

    A bundle is `taken` only where the new map shows its place empty or another one there, and `added` only
    where the old map does. Otherwise, the other map has not seen its place (`not-seen`), shows something
    higher there (`covered`), or something as high, without such a bundle (`not-found`).
    """
    before, after = Places.of(old), Places.of(new)
    found = find_candidates(before, after, MAX_MOVE_M)
    pairs = match_candidates(found)
    kept, partners = before.take(list(pairs)), after.take(list(pairs.values()))
    shift_m = common_shift(kept, partners)
    moves = displace(kept, partners, shift_m)
    changed = {
        i: _change(old[i], new[j], *figures)
        for (i, j), *figures in zip(pairs.items(), moves.values, moves.sigmas, moves.ratios, strict=True)
    }
    replaced = found.in_place & ~found.agree
    gone, came = set(found.before[replaced].tolist()), set(found.after[replaced].tolist())
    told: dict[Finding, Kind] = {"unseen": "not-seen", "covered": "covered", "not-found": "not-found"}
    changes = []
    for i, one in enumerate(old):
        if i not in pairs:
            kind = "taken" if i in gone else told.get(look_at(one, new_heights), "taken")
            changed[i] = _alone(kind, one.id, None, bundle_mass(one), -1)
        changes.append(changed[i])
    matched = set(pairs.values())
    for j, one in enumerate(new):
        if j not in matched:
            kind = "added" if j in came else told.get(look_at(one, old_heights), "added")
            changes.append(_alone(kind, None, one.id, bundle_mass(one), 1))
    return YardChanges(tuple(changes), shift_m)


def _change(before: Bundle, after: Bundle, values: Float64, sigmas: Float64, ratios: Float64) -> Change:
    """Describe a matched bundle's displacement across, along and up and in yaw, (4,) each."""
    across, along, lifted, turn = ratios.tolist()
    kind: Kind = "same"
    if max(across, along, turn) > MOVE_SIGMAS or (lifted > MOVE_SIGMAS and values[2] > 0):
        kind = "moved"
    elif lifted > MOVE_SIGMAS:
        kind = "settled"
    units = np.array([1e3, 1e3, 1e3, math.degrees(1)])
    across_mm, along_mm, up_mm, yaw_deg = (units * values).tolist()
    a, b, c, d = (units * sigmas).tolist()
    z = float(ratios.max())
    return Change(kind, before.id, after.id, across_mm, along_mm, up_mm, yaw_deg, (a, b, c, d), z, 0.0, 0.0)


def _alone(kind: Kind, old: int | None, new: int | None, mass: Mass, sign: int) -> Change:
    nan = math.nan
    return Change(kind, old, new, nan, nan, nan, nan, (nan,) * 4, nan, sign * mass.kg, mass.sigma_kg)


def heights_over(bundle: Bundle, heights: YardMap) -> Float64:
    """Look up a map's heights (40, 5) over a bundle's outline, along it and across; NaN where unseen."""
    u = np.linspace(-0.4, 0.4, 5) * bundle.width_m
    v = np.linspace(-0.45, 0.45, 40) * bundle.length_m
    vv, uu = np.meshgrid(v, u, indexing="ij")
    across, along = bundle.axes
    x, y = (bundle.centre_m[k] + uu * across[k] + vv * along[k] for k in (0, 1))
    rows, columns = (heights.cell_m * size for size in heights.shape)
    for at, first, length in ((x, heights.x0_m, columns), (y, heights.y0_m, rows)):
        if at.max() < first - heights.cell_m or at.min() > first + length:
            return np.full(x.shape, np.nan)  # nothing to read
    return lookup_heights(part_about(heights, x, y), x, y)


def look_at(bundle: Bundle, heights: YardMap) -> Finding:
    """Compare a map with a bundle at its place: the map is lower, higher, level or unknown there.

    Lower over most of its length means `gone`, higher `covered`, level `not-found`: something is there.
    """
    z = heights_over(bundle, heights)[:, 1:4]
    known: Bool = np.isfinite(z)
    if known.mean() < MIN_KNOWN:
        return "unseen"
    along: Float64 = np.linspace(-0.45, 0.45, len(z)) * bundle.length_m
    above = z - (bundle.top_z_m + along * math.tan(bundle.pitch_rad))[:, None]
    margin = max(0.3 * bundle.width_m, SAME_PLACE_SIGMAS * np.nan_to_num(bundle.sigma.top_z_m))
    if (above[known] < -margin).mean() > 0.5:
        return "gone"
    return "covered" if (above[known] > margin).mean() > 0.5 else "not-found"
