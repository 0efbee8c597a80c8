"""Match a survey's bundles to known ones by place and dimensions, each at most once."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.optimize import linear_sum_assignment

from barsight.core.arrays import Bool, Float64
from barsight.yard.inventory.changes import (
    MIN_KNOWN,
    SAME_WIDTH_RATIO,
    displacement,
    displacement_along,
    heights_over,
)
from barsight.yard.types import Bundle, YardMap

SIGMAS = 4.0
"""Tolerance for two measured values to agree, in combined standard deviations."""
MAX_TURN_RAD = math.radians(6.0)
MOVED_M = 0.05
MOVED_RAD = math.radians(1.0)
_PLACE_SIGMA_M = 0.02
_YAW_SIGMA_RAD = math.radians(0.3)
"""Standard deviations of errors common to a whole survey (its place in the yard), beside the stated
sigmas.
"""
_MIN_LENGTH_TOLERANCE_M = 0.1
_LEFT_BEHIND = 100.0
"""Cost of finding a lifted bundle at the place it was lifted from."""
_NO_PAIR = 1e9

Finding = Literal["gone", "covered", "not-found", "unseen"]


@dataclass(frozen=True, eq=False)
class KnownBundle:
    """A bundle that other surveys saw.

    last: as last seen before this survey; later: as first seen after it. At least one is given. is_lifted:
    whether a lift has taken it since it was last seen; set_down: at the place where that lift laid it, None
    if that is unknown.
    """

    bundle_id: int
    last: Bundle | None
    later: Bundle | None
    stock_name: str | None
    is_lifted: bool = False
    set_down: Bundle | None = None

    @property
    def figures(self) -> Bundle:
        """Return the bundle as measured, regardless of its place."""
        found = self.last or self.later
        assert found is not None
        return found

    @property
    def places(self) -> tuple[tuple[Bundle, float], ...]:
        """Return the bundle at each place where it may be, with the cost of being there."""
        left_behind = _LEFT_BEHIND if self.is_lifted else 0.0
        listed = ((self.set_down, 0.0), (self.last, left_behind), (self.later, 0.0))
        return tuple((place, cost) for place, cost in listed if place is not None)


@dataclass(frozen=True, eq=False)
class FoundBundle:
    """A bundle as a survey found it. stock_name: from its stock list, None if the list names none."""

    bundle: Bundle
    stock_name: str | None


@dataclass(frozen=True)
class MatchedBundles:
    """Result of matching, by positions in `known` and `found`.

    found: the found bundle for each matched known one. findings: for the known ones that were not found.
    """

    found: dict[int, int]
    findings: dict[int, Finding]


def match_by_place(
    known: tuple[KnownBundle, ...], found: tuple[FoundBundle, ...], heights: YardMap
) -> MatchedBundles:
    """Match with the smallest sum of squared normalised differences. heights: the survey's map."""
    shape = (len(known), len(found))
    cost, is_taken = np.full(shape, _NO_PAIR), np.zeros(shape, np.bool_)
    for i, j in _near(known, found):
        cost[i, j], is_taken[i, j] = _place_cost(known[i], found[j])
    rows, columns = linear_sum_assignment(cost)
    pairs = {int(i): int(j) for i, j in zip(rows, columns, strict=True) if cost[i, j] < _NO_PAIR}
    findings = {
        i: _finding(one, heights, is_replaced=bool(is_taken[i].any()))
        for i, one in enumerate(known)
        if i not in pairs
    }
    return MatchedBundles(pairs, findings)


def _near(known: tuple[KnownBundle, ...], found: tuple[FoundBundle, ...]) -> list[tuple[int, int]]:
    """List the pairs whose centres are at most the longer bundle's length apart."""
    centre = np.array([other.bundle.centre_m[:2] for other in found]).reshape(-1, 2)
    length = np.array([other.bundle.length_m for other in found])
    pairs = []
    for i, bundle in enumerate(known):
        near = np.zeros(len(found), np.bool_)
        for place, _ in bundle.places:
            away = np.hypot(*(centre - place.centre_m[:2]).T)
            near |= away < np.maximum(length, place.length_m)
        pairs += [(i, int(j)) for j in np.flatnonzero(near)]
    return pairs


def _place_cost(known: KnownBundle, found: FoundBundle) -> tuple[float, bool]:
    """Compute a pair's cost (_NO_PAIR if it is none), and whether another bundle is at the known place."""
    best, is_taken = _NO_PAIR, False
    for place, extra_cost in known.places:
        if not _is_same_place(place, found.bundle):
            continue
        if _is_same_kind(known, found):
            best = min(best, _difference(place, found.bundle) + extra_cost)
        else:
            is_taken |= place is known.last
    return best, is_taken


def _is_same_place(before: Bundle, after: Bundle) -> bool:
    """Check that two bundles can't be side by side: less than half a width, and half a height, apart."""
    across, along, up, turn_rad = displacement(before, after)
    half = min(before.width_m, after.width_m) / 2
    is_open = any(before.ends_open) or any(after.ends_open)
    reach = (0.5 if is_open else 0.25) * max(before.length_m, after.length_m)
    return abs(across) < half and abs(up) < half and abs(along) < reach and abs(turn_rad) < MAX_TURN_RAD


def _is_same_kind(known: KnownBundle, found: FoundBundle) -> bool:
    """Compare names, length, width, bar diameter and section, each if both are known."""
    if known.stock_name and found.stock_name:
        return known.stock_name == found.stock_name
    before, after = known.figures, found.bundle
    a, b = before.sigma, after.sigma
    return (
        _is_same_length(before, after)
        and _agree(before.width_m, a.width_m, after.width_m, b.width_m)
        and _agree(before.bar_diameter_m, a.bar_diameter_m, after.bar_diameter_m, b.bar_diameter_m)
        and _agree(before.section_m2, a.section_m2, after.section_m2, b.section_m2)
    )


def _agree(before: float, sigma_before: float, after: float, sigma_after: float) -> bool:
    sigma = math.hypot(_known(sigma_before), _known(sigma_after))
    return not abs(after - before) > max(SAME_WIDTH_RATIO * before, SIGMAS * sigma)


def _is_same_length(before: Bundle, after: Bundle) -> bool:
    """Compare lengths; a bundle with an open end may be longer than seen."""
    sigma = math.hypot(_known(before.sigma.length_m), _known(after.sigma.length_m))
    tolerance = max(_MIN_LENGTH_TOLERANCE_M, SIGMAS * sigma)
    longer = after.length_m - before.length_m
    may_grow, may_shrink = any(before.ends_open), any(after.ends_open)
    return (may_grow or longer < tolerance) and (may_shrink or longer > -tolerance)


def _difference(before: Bundle, after: Bundle) -> float:
    """Sum squared differences over their variances: across, up, yaw, and along if all ends were seen."""
    across, along, up, turn_rad = displacement(before, after)
    a, b = before.sigma, after.sigma
    terms = [
        (across, a.lateral_m, b.lateral_m, _PLACE_SIGMA_M),
        (up, a.top_z_m, b.top_z_m, _PLACE_SIGMA_M),
        (turn_rad, a.yaw_rad, b.yaw_rad, _YAW_SIGMA_RAD),
        (after.width_m - before.width_m, a.width_m, b.width_m, _PLACE_SIGMA_M),
    ]
    if not (any(before.ends_open) or any(after.ends_open)):
        terms.append((along, a.along_m, b.along_m, _PLACE_SIGMA_M))
    return sum(value**2 / (_known(one) ** 2 + _known(two) ** 2 + more**2) for value, one, two, more in terms)


def _known(sigma: float) -> float:
    return sigma if math.isfinite(sigma) else 0.0


def _finding(known: KnownBundle, heights: YardMap, *, is_replaced: bool) -> Finding:
    """Determine why a bundle was not found, from the survey's map at its last place.

    A lifted bundle is gone only if the place where the lift laid it is also empty.
    """
    if known.last is None:
        return "unseen"
    finding = look_at(known.last, heights)
    if finding == "not-found" and is_replaced:
        finding = "gone"
    if known.set_down is None or finding == "unseen":
        return finding
    set_down_finding = look_at(known.set_down, heights)
    return finding if set_down_finding == "gone" else set_down_finding


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
    margin = max(0.3 * bundle.width_m, SIGMAS * _known(bundle.sigma.top_z_m))
    if (above[known] < -margin).mean() > 0.5:
        return "gone"
    return "covered" if (above[known] > margin).mean() > 0.5 else "not-found"


def match_carried(
    known: tuple[KnownBundle, ...], found: tuple[FoundBundle, ...], matched: MatchedBundles, new: list[int]
) -> dict[int, int]:
    """Pair gone bundles with new ones elsewhere, if each agrees with no other: by name, else by dimensions.

    new: positions in `found` at which a bundle may have been laid.
    """
    gone = [i for i, finding in matched.findings.items() if finding == "gone"]
    agree = np.array([[_is_carried(known[i], found[j]) for j in new] for i in gone], dtype=bool)
    agree = agree.reshape(len(gone), len(new))
    return {
        gone[i]: new[j]
        for i, j in np.argwhere(agree).tolist()
        if agree[i].sum() == 1 and agree[:, j].sum() == 1
    }


def _is_carried(known: KnownBundle, found: FoundBundle) -> bool:
    if known.stock_name and found.stock_name:
        return known.stock_name == found.stock_name
    all_seen = not (any(known.figures.ends_open) or any(found.bundle.ends_open))
    return all_seen and _is_same_kind(known, found)


def has_moved(before: Bundle, after: Bundle) -> bool:
    """Detect a move that is neither noise nor the settling of a pile."""
    across, _, up, turn_rad = displacement(before, after)
    along, sigma_along = displacement_along(before, after)
    a, b = before.sigma, after.sigma
    return any(
        abs(value) > max(least, SIGMAS * math.hypot(_known(one), _known(two)))
        for value, one, two, least in (
            (across, a.lateral_m, b.lateral_m, MOVED_M),
            (along, sigma_along, 0.0, MOVED_M),
            (up, a.top_z_m, b.top_z_m, MOVED_M),
            (turn_rad, a.yaw_rad, b.yaw_rad, MOVED_RAD),
        )
    )
