"""Relate bundles to each other: which one lies on which, in which layer, and beside which."""

from __future__ import annotations

import numpy as np

from barsight.core.arrays import Float64
from barsight.yard.types import Bundle, Doubt, DoubtKind

_OVERLAP_M, _MARGIN_RATIO = 0.05, 0.2
"""Length (m) along a bundle from which a higher one covers it, and the depth to which that must reach over
its side, in widths of the narrower one.
"""
_TOUCH_M = 0.03
_DUNNAGE_M = 0.1
_HIGHER_RATIO = 0.4
_LOWER_RATIO = 0.15
"""Height tolerance, in mean widths: a bundle whose middle is lower by more is surely the lower one."""
_PARALLEL = 0.08
_INSIDE = 0.35
"""Distance from a bundle's axis, as a share of its width, within which no other bundle's middle can lie."""
_LEAVE_OPEN = frozenset({
    DoubtKind.COVERS_PART, DoubtKind.COVERED_END, DoubtKind.LIES_ACROSS, DoubtKind.THIN_BAR,
    DoubtKind.UNSEEN_FLANK, DoubtKind.WALL,
})  # fmt: skip
"""Doubts that leave open whether something lies on a bundle. A faint line across it, most often a strap,
only forbids its lift.

A hidden flank leaves it open from the second layer on, where bundles rest on each other's flanks. On the
floor, a higher neighbour that hides the lower part of a flank usually stands beside it.
"""
_MEET_M, _MEET_LENGTH_M = 0.02, 0.3
"""Overlap across (m) of two outlines, and its length along (m), from which they can't both be right: one
bundle may lie over the other.
"""


def find_layers(bundles: list[Bundle], floor_m: float | None) -> list[int]:
    """Find each bundle's layer by its height over the floor, or over the lowest bundle's underside where no
    floor was seen.

    The spacing of the layers is the lower quartile of those steps between undersides of bundles of about its
    width and heading that one bundle and its dunnage can make, otherwise the bundle's own height plus 0.1 m.
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
    """Check whether a bundle is about as wide and parallel: crossed bundles lie without dunnage."""
    parallel = abs(np.sin(one.yaw_rad - other.yaw_rad)) < _PARALLEL
    return bool(parallel and abs(other.width_m - one.width_m) < 0.15 * one.width_m)


def check_uncovered(
    bundle: Bundle, bundles: list[Bundle], layer: int
) -> tuple[bool | None, tuple[Doubt, ...]]:
    """Check whether no other bundle lies on this one, and list what does; None where it isn't known."""
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
    return _common_length(lower, upper, -_MARGIN_RATIO * min(lower.width_m, upper.width_m)) > _OVERLAP_M


def list_overlaps(bundle: Bundle, bundles: list[Bundle]) -> tuple[Doubt, ...]:
    """List other bundles that may lie over this one's flank: their outlines overlap, and their middles or
    tops are no lower. In plan view, two convex sections overlap where the widest place of one lies over that
    of the other.
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
    """List ids of the bundles that lie within 30 mm beside this one, at about its height."""
    return tuple(
        other.id
        for other in bundles
        if other.id != bundle.id
        and abs(other.centre_m[2] - bundle.centre_m[2]) < 0.7 * (other.width_m + bundle.width_m) / 2
        and _common_length(bundle, other, _TOUCH_M) > _OVERLAP_M
    )


def same_place(one: Bundle, other: Bundle) -> bool:
    """Check whether two bundles claim the same place: the middle of one lies well inside the other."""
    near = abs(one.centre_m[2] - other.centre_m[2]) < _INSIDE * min(one.width_m, other.width_m)
    return bool(near) and (_holds(one, other.centre_m) or _holds(other, one.centre_m))


def _holds(bundle: Bundle, place: Float64) -> bool:
    to_side, to_end = _beside(place[:2], bundle)
    return bool(to_side < _INSIDE * bundle.width_m and to_end < bundle.length_m / 2)


def _common_length(bundle: Bundle, other: Bundle, margin_m: float) -> float:
    """Compute the length of `bundle` over which it meets the other footprint, widened by
    margin_m per side.
    """
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
    """Compute distances of places (..., 2) from the bundle's axis, and along it from the bundle's middle."""
    c, s = np.cos(bundle.yaw_rad), np.sin(bundle.yaw_rad)
    offset = places - bundle.centre_m[:2]
    return np.abs(offset @ np.array([c, s])), np.abs(offset @ np.array([-s, c]))
