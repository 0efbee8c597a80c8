"""Relate bundles: which lies on which, in which layer, and beside which."""

from __future__ import annotations

import numpy as np

from barsight.core.arrays import Float64
from barsight.yard.types import Bundle, Doubt, DoubtKind

_OVERLAP_M = 0.05
_TOUCH_M = 0.03
_DUNNAGE_M = 0.1
_HIGHER_RATIO = 0.4
_LOWER_RATIO = 0.15
"""A middle that lies lower by this share of the mean width is the lower one, whatever the widths err by."""
_PARALLEL = 0.08
_INSIDE = 0.35
"""Share of a bundle's width, to either side of its axis, within which no other bundle lies."""
_LEAVE_OPEN = frozenset({
    DoubtKind.COVERS_PART, DoubtKind.COVERED_END, DoubtKind.LIES_ACROSS, DoubtKind.THIN_BAR,
    DoubtKind.UNSEEN_FLANK, DoubtKind.WALL,
})  # fmt: skip
"""Doubts that leave open whether something lies on a bundle. A faint line across it, most often a strap,
only forbids its lift.

A hidden flank does so from the second layer on, where bundles rest on each other's flanks. On the floor a
higher neighbour that hides the lower part of a flank most often stands beside it."""
_MEET_M, _MEET_LENGTH_M = 0.02, 0.3
"""Two outlines that overlap by more, over this length, are not both right: one may lie over the other."""


def find_layers(bundles: list[Bundle], floor_m: float | None) -> list[int]:
    """Find each bundle's layer by its height over the floor (the lowest bundle's underside where none was
    seen).

    The distance of the layers is the smallest step between the undersides of bundles of its width and heading
    that one bundle and its dunnage can make, else the bundle's own height and 0.1 m.
    """
    bottoms = np.array([b.bottom_z_m for b in bundles])
    layers = []
    for bundle, bottom in zip(bundles, bottoms, strict=True):
        height = bundle.top_z_m - bottom
        alike = np.array([_is_alike(bundle, b) for b in bundles])
        steps = np.abs(np.subtract.outer(bottoms[alike], bottoms[alike])).ravel()
        steps = steps[(steps > 0.8 * height) & (steps < height + 0.35)]
        pitch = float(np.percentile(steps, 25)) if steps.size else height + _DUNNAGE_M
        ground = floor_m if floor_m is not None else float(bottoms.min())
        under = max(pitch - height, 0.0) if floor_m is not None else 0.0
        layers.append(max(round((bottom - ground - under) / pitch), 0))
    return layers


def _is_alike(one: Bundle, other: Bundle) -> bool:
    """Check for a bundle as wide, and no crossed one: these lie without dunnage."""
    parallel = abs(np.sin(one.yaw_rad - other.yaw_rad)) < _PARALLEL
    return bool(parallel and abs(other.width_m - one.width_m) < 0.15 * one.width_m)


def check_uncovered(
    bundle: Bundle, bundles: list[Bundle], layer: int
) -> tuple[bool | None, tuple[Doubt, ...]]:
    """Check whether no other lies on the bundle, and why not; None where what covers it isn't known."""
    covers = [other.id for other in bundles if other.id != bundle.id and _lies_on(other, bundle)]
    if covers:
        return False, (Doubt(DoubtKind.OTHER, f"bundle {', '.join(map(str, covers))} lies on it"),)
    kinds = {doubt.kind for doubt in bundle.reasons}
    if kinds & _LEAVE_OPEN or (layer > 0 and DoubtKind.HIDDEN_FLANK in kinds):
        return None, ()
    return True, ()


def _lies_on(upper: Bundle, lower: Bundle) -> bool:
    """Check whether `upper` is higher and its footprint covers a place on `lower`."""
    if upper.centre_m[2] - lower.centre_m[2] < _HIGHER_RATIO * (upper.width_m + lower.width_m) / 2:
        return False
    return _common_length(lower, upper, -0.2 * lower.width_m) > _OVERLAP_M


def list_overlaps(bundle: Bundle, bundles: list[Bundle]) -> tuple[Doubt, ...]:
    """List other bundles whose outlines overlap this one's and whose middles or tops lie no lower: they may
    lie over its flank. In plan view two convex sections overlap where one's widest place is above the
    other's.
    """
    ids = [str(other.id) for other in bundles if other.id != bundle.id and _overlaps(other, bundle)]
    if not ids:
        return ()
    outlines = f"its outline and that of bundle {', '.join(ids)}"
    return (Doubt(DoubtKind.OVERLAP, f"{outlines} overlap: one may lie over the other"),)


def _overlaps(other: Bundle, bundle: Bundle) -> bool:
    lower_m = _LOWER_RATIO * (other.width_m + bundle.width_m) / 2
    rises_m = max(other.centre_m[2] - bundle.centre_m[2], other.top_z_m - bundle.top_z_m)
    return rises_m > -lower_m and _common_length(bundle, other, -_MEET_M) > _MEET_LENGTH_M


def list_neighbours(bundle: Bundle, bundles: list[Bundle]) -> tuple[int, ...]:
    """List ids of the bundles that lie no more than 30 mm beside it, at about its height."""
    return tuple(
        other.id
        for other in bundles
        if other.id != bundle.id
        and abs(other.centre_m[2] - bundle.centre_m[2]) < 0.7 * (other.width_m + bundle.width_m) / 2
        and _common_length(bundle, other, _TOUCH_M) > _OVERLAP_M
    )


def same_place(one: Bundle, other: Bundle) -> bool:
    """Check whether both claim to fill one place: the middle of either lies well inside the other."""
    near = abs(one.centre_m[2] - other.centre_m[2]) < _INSIDE * min(one.width_m, other.width_m)
    return bool(near) and (_holds(one, other.centre_m) or _holds(other, one.centre_m))


def _holds(bundle: Bundle, place: Float64) -> bool:
    to_side, to_end = _beside(place[:2], bundle)
    return bool(to_side < _INSIDE * bundle.width_m and to_end < bundle.length_m / 2)


def _common_length(bundle: Bundle, other: Bundle, margin_m: float) -> float:
    """Compute the length of `bundle` over which the two footprints, grown by margin_m in all, meet."""
    skew = abs(np.sin(bundle.yaw_rad - other.yaw_rad))
    reach = (other.width_m + bundle.width_m + skew * bundle.length_m) / 2 + max(margin_m, 0.0)
    if _beside(bundle.centre_m[:2], other)[0] > reach:
        return 0.0
    along = np.arange(-bundle.length_m / 2, bundle.length_m / 2, 0.02)
    across = np.array([-0.5, -0.25, 0.0, 0.25, 0.5]) * bundle.width_m
    c, s = np.cos(bundle.yaw_rad), np.sin(bundle.yaw_rad)
    centre = bundle.centre_m[:2]
    places = centre + along[:, None, None] * np.array([-s, c]) + across[None, :, None] * np.array([c, s])
    to_side, to_end = _beside(places, other)
    meets = (to_side < other.width_m / 2 + margin_m) & (to_end < other.length_m / 2)
    return 0.02 * float(meets.any(axis=1).sum())


def _beside(places: Float64, bundle: Bundle) -> tuple[Float64, Float64]:
    """Compute distances of (..., 2) places from the bundle's axis and, along it, from its middle."""
    c, s = np.cos(bundle.yaw_rad), np.sin(bundle.yaw_rad)
    offset = places - bundle.centre_m[:2]
    return np.abs(offset @ np.array([c, s])), np.abs(offset @ np.array([-s, c]))
