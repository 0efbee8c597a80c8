"""Assess how the pile stands: its sides, what carries each bundle, what leans, how high stanchions rise.

From above only tops are seen. What a bundle stands on is inferred from what shows beside it: where the layer
below projects on one side by less than half a bundle, and on the other hardly at all, the bundle overhangs
the other side's edge by that much.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from barsight.core.arrays import Float64
from barsight.core.parallel import ordered_map
from barsight.yard.axes import high_side, turn_between
from barsight.yard.lift_settings import UPPER, LiftSettings
from barsight.yard.map_lookup import lookup_heights
from barsight.yard.types import Bundle, HeightMap, known_sigma
from barsight.yard.vetoes import Check, check_max, check_min, check_true

STEP_M, LOOK_M = 0.01, 1.5
"""Spacing (m) of the places beside a bundle that are looked at, and how far (m) they reach from its edge."""
STATIONS = 40
"""Number of such rows of places along a bundle."""
DUNNAGE_M = 0.3
"""Maximum thickness (m) of the dunnage between two layers."""
MIN_LEDGE_M = 0.03
"""Minimum width (m) of a ledge, and minimum difference of the ledges on both sides, that counts."""
MIN_KNOWN, MIN_PLACES = 0.3, 10
"""Minimum share of a place's stations that must have been seen, and minimum number of such places."""
FREE_RATIO = 1.2
"""Minimum drop beside a bundle, in its widths, that reaches below its support."""
SHOULDER_M = 0.06
"""Maximum distance (m) from a bundle's edge at which its own shoulder shows."""
FLANKED_M, FLANKED_RATIO = 0.15, 0.5
"""Maximum distance (m) from a bundle's edge of a neighbour in its layer beside which no edge of what carries
it is told; minimum height of the neighbour's surface over the bundle's underside, in widths: bundles that it
rests on without dunnage, side by side, reach 0.13 widths above it.
"""
LEVEL_M = 0.05
"""Height (m) over the lowest place beside a bundle, or over the floor, that counts as level with it."""
SHEER_M = 0.15
"""Distance (m) from a bundle's edge within which its side is called sheer."""
MAX_COLUMN_RATIO = 2.5
"""Maximum height of two bundles, one on the other, in widths."""
BESIDE_M = 0.3
"""Maximum gap (m) between a bundle and one that may slide onto it."""
TOUCH_M = 0.02
"""Maximum gap (m) between bundles that touch."""
RAISED_RATIO = 0.25
"""Minimum height, in widths, of a neighbour's underside above that of the bundle it rests against."""


@dataclass(frozen=True)
class Side:
    """Surface beside a bundle; NaN where unknown.

    drop_m: from its top to the lowest place within 1.5 m; run_m: from its edge to the beginning of that
    place; slope_deg: of the line between (90 is vertical); ledge_m: how far the layer below the bundle shows
    beyond its edge; known_share: of the places sampled; sheer_m: from its top to the lowest place within
    SHEER_M of its edge.
    """

    drop_m: float
    run_m: float
    slope_deg: float
    ledge_m: float
    known_share: float
    sheer_m: float = math.nan


@dataclass(frozen=True)
class Footing:
    """Support of a bundle. sides: towards low and high x (y, where it runs closer to X; see `high_side`).

    overhang_m: over the edge of what carries it, on overhang_side (-1 low, 1 high, 0 none), NaN where it
    isn't known; lean_deg: of the side below it. freeboard_m: height of the lowest stanchion beside it over
    its top, NaN where there is none. hidden_m: overhang if what carries it ends in a gap beside it that
    wasn't seen.
    """

    bundle: int
    sides: tuple[Side, Side]
    overhang_m: float
    overhang_side: int
    lean_deg: float
    freeboard_m: float
    hidden_m: float = 0.0


def mean_yaw(bundles: tuple[Bundle, ...]) -> float:
    """Average the bundles' yaws as axes, relative to the first one's."""
    first = bundles[0].yaw_rad
    return first + float(np.mean([turn_between(first, bundle.yaw_rad) for bundle in bundles]))


def footings(heights: HeightMap, bundles: tuple[Bundle, ...], settings: LiftSettings) -> tuple[Footing, ...]:
    """Assess how each bundle stands, in the bundles' order."""
    return tuple(ordered_map(lambda bundle: _footing(heights, bundle, settings), bundles))


def _footing(heights: HeightMap, bundle: Bundle, settings: LiftSettings) -> Footing:
    profiles = [_profile(heights, bundle, sign) for sign in (-1, 1)]
    low, high = (_side(profile, bundle) for profile in profiles)
    deep = [side.drop_m > FREE_RATIO * bundle.width_m for side in (low, high)]
    beside = [_beside_m(profile, bundle) for profile in profiles]
    overhang, side, lean, hidden = math.nan, 0, 0.0, 0.0
    if bundle.layer > 0 and all(deep):
        for sign, outer, inner in ((-1, low, high), (1, high, low)):
            # A map blurs both edges alike: what shows equally on both sides doesn't reveal a shift.
            shift = inner.ledge_m - outer.ledge_m
            gap_m, inner_gap_m = beside if sign < 0 else beside[::-1]
            if outer.ledge_m >= MIN_LEDGE_M or inner_gap_m is not None:
                continue
            if gap_m is not None:
                is_edge = shift >= MIN_LEDGE_M and inner.ledge_m < 0.5 * bundle.width_m + MIN_LEDGE_M
                hidden = inner.ledge_m if gap_m >= MIN_LEDGE_M and is_edge else hidden
            elif shift < MIN_LEDGE_M - STEP_M / 2:
                overhang = 0.0 if math.isnan(overhang) else overhang
            elif inner.ledge_m < 0.5 * bundle.width_m + MIN_LEDGE_M:
                overhang, side = inner.ledge_m, sign
                lean = math.degrees(math.atan2(inner.run_m, inner.drop_m))
    tops = [
        z - bundle.top_z_m
        for x, y, z in settings.stanchions
        if _distance(bundle, x, y) < settings.beside_stanchion_m
    ]
    return Footing(bundle.id, (low, high), overhang, side, lean, min(tops, default=math.nan), hidden)


def _beside_m(profile: Float64, bundle: Bundle) -> float | None:
    """Find whether something well above the bundle's underside stands close beside it before a place below
    its support is seen, as a bundle of its own layer does, and how much (m) wasn't seen between them; None
    where nothing does. Where all is seen, what carries both goes on there.
    """
    z = np.where(profile[:, 1] >= MIN_KNOWN, profile[:, 0], np.nan)
    falls = np.flatnonzero(z <= _below_support(bundle))
    end = min(int(falls[0]) if falls.size else len(z), round(FLANKED_M / STEP_M) + 1)
    first = round(SHOULDER_M / STEP_M)
    high = np.flatnonzero(z[first:end] > bundle.top_z_m - (1 - FLANKED_RATIO) * bundle.width_m)
    return float(np.isnan(z[: first + int(high[0])]).sum()) * STEP_M if high.size else None


def _below_support(bundle: Bundle) -> float:
    """Return the height (m) below which a surface is none of the layer that carries the bundle."""
    return max(bundle.top_z_m - 1.5 * bundle.width_m - DUNNAGE_M / 2, LEVEL_M)


def _profile(heights: HeightMap, bundle: Bundle, sign: int) -> Float64:
    """Compute the seen cells' median height and their share (N, 2), from the edge outwards every STEP_M."""
    out = bundle.width_m / 2 + np.arange(0, LOOK_M, STEP_M)
    along = np.linspace(-0.45, 0.45, STATIONS) * bundle.length_m
    side, axis = sign * high_side(bundle.yaw_rad), bundle.axes[1]
    x, y = (bundle.centre_m[k] + out[:, None] * side[k] + along[None] * axis[k] for k in (0, 1))
    z = lookup_heights(heights, x, y) - along[None] * np.tan(bundle.pitch_rad)
    known = np.isfinite(z)
    filled = np.where(known, z, np.inf)
    ordered = np.sort(filled, axis=1)
    count = known.sum(axis=1)
    middle = ordered[np.arange(len(out)), np.maximum(count - 1, 0) // 2]
    return np.stack([np.where(count > 0, middle, np.nan), count / STATIONS], axis=1)


def _side(profile: Float64, bundle: Bundle) -> Side:
    z, known = profile[:, 0], profile[:, 1] >= MIN_KNOWN
    share = float(profile[:, 1].mean())
    if known.sum() < MIN_PLACES:
        return Side(math.nan, math.nan, math.nan, math.nan, share)
    # The bundle's own shoulder and its neighbour's may show in the first centimetres.
    z = np.where(known, z, np.nan)
    lowest = float(np.nanmin(z))
    drop = bundle.top_z_m - lowest
    run = float(np.flatnonzero(np.nan_to_num(z, nan=np.inf) <= lowest + LEVEL_M)[0]) * STEP_M
    slope = math.degrees(math.atan2(drop, run))
    shows = np.flatnonzero(~(np.nan_to_num(z, nan=-np.inf) > _below_support(bundle)))
    ledge = float(shows[0] if shows.size else len(z)) * STEP_M
    near = z[: round(SHEER_M / STEP_M) + 1]
    sheer = bundle.top_z_m - float(np.nanmin(near)) if np.isfinite(near).any() else math.nan
    return Side(drop, run, slope, ledge, share, sheer)


def _distance(bundle: Bundle, x: float, y: float) -> float:
    """Compute the distance (m) in plan view from a place to the bundle's outline."""
    away = np.abs(bundle.axes @ ((x, y) - bundle.centre_m[:2]))
    beyond = away - (bundle.width_m / 2, bundle.length_m / 2)
    return float(np.linalg.norm(np.maximum(beyond, 0)))


def footing_checks(
    target: Bundle, bundles: tuple[Bundle, ...], standing: tuple[Footing, ...], settings: LiftSettings
) -> list[Check]:
    """Check for reasons in the pile not to lift this bundle."""
    by_id = {footing.bundle: footing for footing in standing}
    own, mm = by_id[target.id], 1e3
    over = own.overhang_m if own.overhang_side else 0.0
    limit = settings.max_overhang_ratio * target.width_m
    checks = [
        check_max(
            "no-support", "distance of the support's end from the bundle's edge", mm * over,
            mm * target.width_m / 2, "mm",
            f"what carries it ends {mm * over:.0f} mm before its edge: its middle is unsupported",
        )
    ]  # fmt: skip
    if checks[0].result == "passed":
        checks.append(
            check_max(
                "overhanging", "overhang beyond the edge of what carries it", mm * over, mm * limit,
                "mm", f"it extends {mm * over:.0f} mm beyond what carries it; the limit is "
                f"{mm * limit:.0f} mm", sigma=mm * known_sigma(target.sigma.width_m / 2) if over else 0.0,
                sigmas=UPPER,
            )
        )  # fmt: skip
    if own.hidden_m > limit:
        reason = (
            f"it extends {mm * own.hidden_m:.0f} mm beyond what carries it if that ends beside it, where "
            f"nothing was seen; the limit is {mm * limit:.0f} mm"
        )
        checks.append(check_true("overhanging", "what carries it doesn't end out of sight", None, reason))
    checks.append(
        check_max(
            "unstable-side", "lean of the side of the pile below it", own.lean_deg, settings.max_lean_deg,
            "deg", f"the side of the pile below it leans by {own.lean_deg:.1f} deg; "
            f"the limit is {settings.max_lean_deg:g} deg",
        )
    )  # fmt: skip
    checks += _column_checks(target, own)
    if not math.isnan(own.freeboard_m):
        checks.append(
            check_min(
                "over-stanchion", "height of the lowest stanchion beside it above its top",
                mm * own.freeboard_m, mm * settings.min_freeboard_m, "mm",
                f"the stanchion beside it is {mm * own.freeboard_m:.0f} "
                f"mm above its top; {mm * settings.min_freeboard_m:.0f} mm are needed",
                sigma=mm * known_sigma(target.sigma.top_z_m),
            )
        )  # fmt: skip
    return [*checks, *_neighbour_checks(target, bundles, by_id, settings)]


def _neighbour_checks(
    target: Bundle, bundles: tuple[Bundle, ...], footings: dict[int, Footing], settings: LiftSettings
) -> list[Check]:
    """Check that no neighbour leans over this bundle or rests against it."""
    checks, mm = list[Check](), 1e3
    for other in bundles:
        leaning = footings[other.id]
        if lies_over_edge_of(other, target, leaning):
            reason = f"bundle {other.id} extends {mm * leaning.overhang_m:.0f} mm over the edge on this side"
            checks += [
                check_max("unstable-side", f"bundle {other.id} {what}", value, most, unit, reason)
                for what, value, most, unit in (
                    ("over the edge on this side", mm * leaning.overhang_m,
                     mm * settings.max_overhang_ratio * other.width_m, "mm"),
                    ("leaning to this side", leaning.lean_deg, settings.max_lean_deg, "deg"),
                )
            ]  # fmt: skip
        if other.id in target.neighbours:
            checks.append(
                check_true(
                    "unstable-side", f"bundle {other.id} beside it stands by itself",
                    not rests_against(other, target), f"bundle {other.id} rests against it from above",
                )
            )  # fmt: skip
    return checks


def _column_checks(target: Bundle, own: Footing) -> list[Check]:
    """Check that the support of a bundle shows on at least one side: a wall falls vertically on both sides,
    and so does a pile no wider than its highest bundle. Empty where a side is unknown.
    """
    sheer = min(own.sides[0].sheer_m, own.sides[1].sheer_m)
    if math.isnan(own.sides[0].sheer_m + own.sides[1].sheer_m):
        return []
    most, mm = MAX_COLUMN_RATIO * target.width_m + DUNNAGE_M, 1e3
    sigma = math.hypot(
        MAX_COLUMN_RATIO * known_sigma(target.sigma.width_m), known_sigma(target.sigma.top_z_m)
    )
    return [
        check_max(
            "unstable-side", "vertical drop on both its sides", mm * sheer, mm * most, "mm",
            f"both its sides drop by {mm * sheer:.0f} mm, more than the {mm * most:.0f} mm of two bundles "
            "on dunnage: nothing that carries it is visible, as with a wall", sigma=mm * sigma,
            sigmas=UPPER,
        )
    ]  # fmt: skip


def leans_on(other: Bundle, target: Bundle, footing: Footing, settings: LiftSettings) -> bool:
    """Check whether `other`, of this footing, overhangs or leans too far over the edge beside `target`."""
    over = footing.overhang_m > settings.max_overhang_ratio * other.width_m
    return (over or footing.lean_deg > settings.max_lean_deg) and lies_over_edge_of(other, target, footing)


def lies_over_edge_of(other: Bundle, target: Bundle, footing: Footing) -> bool:
    """Check whether `other`, which has this footing, overhangs the edge beside which `target` lies."""
    if other.id == target.id or not footing.overhang_side or not _beside(target, other):
        return False
    away = target.centre_m[:2] - other.centre_m[:2]
    return bool(footing.overhang_side * (away @ high_side(other.yaw_rad)) > 0)


def rests_against(other: Bundle, target: Bundle) -> bool:
    """Check whether `other`, one of the neighbours that touch `target`, has its underside well above that of
    `target`, and its axis no further away than that of a bundle that touches it.
    """
    if other.id not in target.neighbours:
        return False
    raised = other.bottom_z_m - target.bottom_z_m
    sideways = abs(float((other.centre_m - target.centre_m)[:2] @ high_side(target.yaw_rad)))
    reach = (other.width_m + target.width_m) / 2 + TOUCH_M
    apart = math.hypot(sideways, float(other.centre_m[2] - target.centre_m[2]))
    return raised > RAISED_RATIO * min(other.width_m, target.width_m) and apart < reach


def _beside(one: Bundle, other: Bundle) -> bool:
    """Check whether the outlines are within BESIDE_M of each other sideways and overlap along."""
    beside, beyond = gaps_between(one, other)
    return beside < BESIDE_M and beyond < 0


def gaps_between(one: Bundle, other: Bundle) -> tuple[float, float]:
    """Compute the gaps (m) between two outlines, across and along the first one; negative is an overlap."""
    beside, beyond = np.abs(one.axes @ (other.centre_m - one.centre_m)[:2]).tolist()
    return beside - (one.width_m + other.width_m) / 2, beyond - (one.length_m + other.length_m) / 2
