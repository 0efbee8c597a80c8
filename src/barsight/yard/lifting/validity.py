"""Validity in time: ages count from the frames' capture, never from the time of computing; what happened in
the yard since then forbids around it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from barsight.core.stamps import NS_PER_S, seconds_to_ns
from barsight.yard.events import YardEvent, corners, gap_between
from barsight.yard.lift_settings import LiftSettings
from barsight.yard.lifting.travel_accuracy import Travel
from barsight.yard.magnet.description import Magnet
from barsight.yard.magnet.footprint import Placement
from barsight.yard.types import Bundle
from barsight.yard.vetoes import Check, check_max, check_min, check_true

MAX_CLOCK_ERROR_NS = NS_PER_S
"""Frames may be this much ahead of this computer's clock."""


@dataclass(frozen=True)
class Validity:
    """Stamps (ns, capture clock) between which a lift may be believed."""

    from_ns: int
    until_ns: int


def validity(travel: Travel, place: Placement, settings: LiftSettings) -> Validity | None:
    """Find the validity of a place: from the last frame that saw it, for `max_age_s`. None if none did."""
    near = np.linalg.norm(travel.place_m - (place.x_m, place.y_m), axis=1) < travel.sure_reach_m
    near &= travel.measured
    if not near.any():
        return None
    seen_ns = int(travel.stamp_ns[near].max())
    return Validity(seen_ns, seen_ns + seconds_to_ns(settings.max_age_s))


def age_checks(captured_to_ns: int | None, now_ns: int, settings: LiftSettings) -> list[Check]:
    """Check that what was captured isn't too old, of the future, or of nobody knows when. Stamps in ns since
    1970.
    """
    if captured_to_ns is None:
        reason = "when it was last seen is not known"
        return [check_true("map-too-old", "age of what was seen", None, reason)]
    age_ns, max_age_ns = now_ns - captured_to_ns, seconds_to_ns(settings.max_age_s)
    return [
        check_min(
            "map-from-the-future", "age by this computer's clock", age_ns / NS_PER_S,
            -MAX_CLOCK_ERROR_NS / NS_PER_S, "s",
            f"the last frame is {_span(-age_ns)} ahead of this computer's clock: set the clocks",
        ),
        check_max(
            "map-too-old", "age of the last frame that saw it", age_ns / NS_PER_S, settings.max_age_s, "s",
            f"the last frame that saw it is {_span(age_ns)} old, {_span(max_age_ns)} are allowed",
        ),
    ]  # fmt: skip


def disturbed_checks(
    events: tuple[YardEvent, ...], place: Placement, magnet: Magnet, load: tuple[Bundle, ...],
    seen: Validity | None, settings: LiftSettings,
) -> list[Check]:  # fmt: skip
    """Check that nothing happened within reach of magnet and load since the place was last seen."""
    size = magnet.beam.width_m, 2 * magnet.half_span_m
    outlines = [corners((place.x_m, place.y_m), place.yaw_rad, *size)]
    for bundle in load:
        x, y = bundle.centre_m[:2]
        outlines.append(corners((x, y), bundle.yaw_rad, bundle.width_m, bundle.length_m))
    since = [event for event in events if seen is None or event.stamp_ns > seen.from_ns]
    checks = []
    for event in since:
        away = min(gap_between(outline, event.corners_m) for outline in outlines)
        reason = (
            f"a {event.kind} at {event.x_m:.2f}, {event.y_m:.2f} m, {away:.2f} m from it, came after it was "
            f"last seen; {settings.disturbed_reach_m:g} m are needed: measure again"
        )
        what = f"distance from a {event.kind} since it was last seen"
        checks.append(check_min("disturbed", what, away, settings.disturbed_reach_m, "m", reason))
    return sorted(checks, key=lambda check: check.value or 0.0)[:1]


def _span(duration_ns: int) -> str:
    minutes = duration_ns / NS_PER_S / 60
    for unit, length in (("days", 24 * 60.0), ("h", 60.0)):
        if minutes > 2 * length:
            return f"{minutes / length:.0f} {unit}"
    return f"{minutes:.0f} min" if minutes >= 2 else f"{60 * minutes:.0f} s"
