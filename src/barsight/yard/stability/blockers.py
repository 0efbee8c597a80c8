"""Find which bundles must be moved before another can be lifted, and so in which order a pile comes apart."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from barsight.yard.lift_settings import LiftSettings
from barsight.yard.stability.stability import Footing, leans_on, rests_against
from barsight.yard.types import Bundle

HIGHER_RATIO = 0.25
"""Minimum height of the upper bundle's underside over the lower one's, in widths of the narrower one."""
MEETS_RATIO = 0.05
"""Minimum overlap of outlines that meet, in widths of the narrower one."""


@dataclass(frozen=True)
class Blocked:
    """A bundle and the ids of those that must be moved before it: they lie on it, lean or rest against it."""

    bundle: int
    blockers: tuple[int, ...]


def find_blocked(
    bundles: tuple[Bundle, ...], standing: tuple[Footing, ...], settings: LiftSettings
) -> tuple[Blocked, ...]:
    """Find for each bundle, in the given order, those that must be moved before it."""
    by_id = {footing.bundle: footing for footing in standing}
    centres = np.array([b.centre_m[:2] for b in bundles]).reshape(-1, 2)
    reach = np.array([(b.length_m + b.width_m) / 2 for b in bundles])
    found = []
    for number, target in enumerate(bundles):
        away = np.linalg.norm(centres - centres[number], axis=1)
        near = (bundles[k] for k in np.flatnonzero(away < reach + reach[number]) if k != number)
        blockers = (
            other.id for other in near
            if lies_on(other, target) or rests_against(other, target)
            or leans_on(other, target, by_id[other.id], settings)
        )  # fmt: skip
        found.append(Blocked(target.id, tuple(blockers)))
    return tuple(found)


def lies_on(upper: Bundle, lower: Bundle) -> bool:
    """Check whether the outlines meet in plan view, and the underside of `upper` is well above `lower`'s."""
    width = min(upper.width_m, lower.width_m)
    if upper.bottom_z_m - lower.bottom_z_m <= HIGHER_RATIO * width:
        return False
    away = (upper.centre_m - lower.centre_m)[:2]
    both = [(bundle.axes, np.array([bundle.width_m, bundle.length_m]) / 2) for bundle in (upper, lower)]
    for axis in (*both[0][0], *both[1][0]):
        reach = sum(float(np.abs(own @ axis) @ half) for own, half in both)
        if abs(float(away @ axis)) >= reach - MEETS_RATIO * width:
            return False
    return True
