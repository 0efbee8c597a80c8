"""Find in the map which bundles' surface certainly lies within a pole's reach, and which ends beside it.

An outline's sides are as uncertain as what was fitted, and it is widest far under the faces. The surface says
more: what is seen under a face is reached, wherever the bundle ends, and what is seen to sink below the reach
before it comes to the pole isn't.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from barsight.core.arrays import Float64
from barsight.yard.magnet.description import Magnet, Tolerance
from barsight.yard.magnet.footprint import BundleTable, Grip, Placement
from barsight.yard.magnet.reach import DEEPER_M, MAX_SKEW, parts_beside
from barsight.yard.magnet.resting_plane import ALL, SEEN, U, Z, profiles
from barsight.yard.types import Bundle, HeightMap

SLIGHT = 1e-5
"""Probability of a wrong count from which a bundle's surface is looked at."""
_SEEN_RATIO = 0.5
"""Minimum share of the cells of a place that must have been seen."""
_MIDDLE_M, _BEYOND_M = 0.03, 0.02
"""Minimum distance (m) of a bundle's middle from what a pole reaches for its surface to be followed towards
it, and the distance (m) beyond its outline up to which that is done.
"""
_TOP_RATIO = 0.5
"""Minimum share of an outline's half width over which the surface must show: the top row of a hexagon of bars
is more than half as wide as its middle row.
"""
_STEEP = 0.5, 1.0
"""Minimum slope of a flank that goes out of sight, and the maximum with which it is taken to fall on."""
_LAST_M = 0.01
"""Maximum height (m) over a pole's reach at which a flank may go out of sight."""


def seen_clearances(
    held: Grip, heights: HeightMap, place: Placement, magnet: Magnet, tolerance: Tolerance,
    table: BundleTable, face_z_m: Float64, reached: Float64,
) -> Float64:  # fmt: skip
    """Compute by how much (B, P) each pole certainly reaches the gripped bundles, and misses the others, as
    their surface shows; -inf where it doesn't show all along the pole, or doesn't matter to the count.

    tolerance: of the crane's set-down; a hard bound. face_z_m: (P,) height of each pole's face. reached: (P,
    4) of `reach.reached_strips`.
    """
    clear = np.full((len(table.bundles), len(reached)), -np.inf)
    reach_z_m, faces = face_z_m - magnet.reach_m, _faces(place, magnet, tolerance)
    for number, bundle in enumerate(table.bundles):
        if held.flips[number] <= SLIGHT or abs(math.sin(bundle.yaw_rad - place.yaw_rad)) > MAX_SKEW:
            continue
        looked = _looked(bundle, place, reached, is_gripped=number in held.gripped)
        if looked:
            half_m = bundle.width_m / 2
            clear[number] = _clearances(looked, half_m, heights, place, reach_z_m, faces)
    return clear


def _faces(place: Placement, magnet: Magnet, tolerance: Tolerance) -> Float64:
    """List the faces (P, 3), m: middle across, half the width, and how far aside the crane may set it."""
    along, across, length, width = magnet.pole_table.T
    turned = math.radians(tolerance.yaw_deg) * (np.abs(along) + length / 2)
    return np.column_stack([across, width / 2, turned + float(tolerance.along(place.across))])


@dataclass(frozen=True)
class _Look:
    """A part of a pole beside which a bundle is looked at. cut: (4,) along, across, length and width of the
    strip, of a gripped bundle the middle half of its outline, of another one from its middle towards the
    pole. side: 1 where it lies on the high side, -1 where on the low one, 0 where it is gripped. clear_m:
    distance of its middle from what the pole reaches.
    """

    pole: int
    cut: tuple[float, float, float, float]
    side: float
    clear_m: float


def _looked(bundle: Bundle, place: Placement, reached: Float64, *, is_gripped: bool) -> list[_Look]:
    """List the parts beside which a bundle is looked at, of all poles beside which it lies."""
    looked = list[_Look]()
    for number, pole in enumerate(reached):
        for low, high, beside in parts_beside(bundle, place, pole):
            along, away = (low + high) / 2, abs(beside - pole[1]) - pole[3] / 2
            side = 0.0 if is_gripped else math.copysign(1.0, beside - pole[1])
            half = bundle.width_m / 2
            span = half if is_gripped else max(min(away, half + _BEYOND_M), _MIDDLE_M)
            cut = along, beside - side * span / 2, high - low, span
            looked.append(_Look(number, cut, side, away))
    return looked


def _clearances(
    looked: list[_Look], half_m: float, heights: HeightMap, place: Placement, reach_z_m: Float64,
    faces: Float64,
) -> Float64:  # fmt: skip
    """Compute the values (P,) of one bundle; see `seen_clearances`. half_m: half its width. faces: of
    `_faces`.
    """
    clear = np.full(reach_z_m.size, np.inf)
    shapes, points = profiles(heights, place, np.array([look.cut for look in looked]))
    first = 0
    for look, (across, along) in zip(looked, shapes, strict=True):
        own = points[first : first + across * along].reshape(across, along, -1)[:, 0]
        first += across * along
        over = np.where(own[:, SEEN] >= _SEEN_RATIO * own[:, ALL], own[:, Z], np.nan) - reach_z_m[look.pole]
        if look.side == 0:
            middle, half, slack = faces[look.pole]
            middles = middle + slack * np.array([[-1.0], [0.0], [1.0]])
            found = half - np.abs(own[over >= 0, U] - middles).min(axis=1, initial=np.inf).max()
        elif look.clear_m <= _MIDDLE_M:
            found = -np.inf
        else:
            inwards = over[::-1] if look.side > 0 else over
            found = look.clear_m - _end(inwards + DEEPER_M, look.cut[3] / across, half_m)
        clear[look.pole] = min(clear[look.pole], found)
    return np.where(np.isinf(clear), -np.inf, clear)


def _end(over: Float64, step_m: float, half_m: float) -> float:
    """Find how far from a bundle's middle its surface sinks out of reach; inf where that isn't seen.

    over: (N,) heights over the lowest place that is reached, from the middle outwards, step_m apart, NaN
    where unknown. half_m: half the outline's width.
    """
    (high,) = np.nonzero(over >= 0)
    if not high.size:
        return math.inf if np.isnan(over).any() else 0.0
    last = int(high[-1])
    at = (last + 0.5) * step_m
    beyond = over[last + 1 :]
    if not beyond.size or (np.isnan(beyond).any() and at < _TOP_RATIO * half_m):
        return math.inf
    if np.isfinite(beyond[0]):
        return at + step_m
    if last < 2 or over[last] > _LAST_M + DEEPER_M:
        return math.inf
    slope = (over[last - 2] - over[last]) / (2 * step_m)
    return at + float(over[last]) / min(float(slope), _STEEP[1]) if slope >= _STEEP[0] else math.inf
