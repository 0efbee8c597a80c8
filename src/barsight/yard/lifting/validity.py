"""Determine validity in time. Ages count from the frames' capture, never from the time of computing, and an
event in the yard since then forbids lifts around it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from barsight.core.arrays import Bool, Float64, Int64
from barsight.core.stamps import NS_PER_S, seconds_to_ns
from barsight.yard.axes import axes_of, corners, gap_between
from barsight.yard.events import YardEvent
from barsight.yard.lift_settings import LiftSettings
from barsight.yard.lifting.ground import Ground
from barsight.yard.lifting.travel_accuracy import Travel
from barsight.yard.magnet.description import Magnet
from barsight.yard.magnet.footprint import Placement
from barsight.yard.map_lookup import nearest_cells
from barsight.yard.placement.clearance import STRAY_FIELD_M
from barsight.yard.types import Bundle, HeightMap
from barsight.yard.vetoes import Check, check_max, check_min, check_true

PART_M, SQUARE_M = 0.04, 0.25
"""Maximum spacing (m) of the places of a lift that are checked, where passes differ and elsewhere."""
MAX_CLOCK_ERROR_NS = NS_PER_S
"""Maximum time (ns) by which frames may be ahead of this computer's clock."""


def is_ahead(stamp_ns: int | None, clock_ns: int) -> bool:
    """Check whether frames with this stamp are ahead of a clock."""
    return (stamp_ns or 0) - clock_ns > MAX_CLOCK_ERROR_NS


@dataclass(frozen=True)
class Validity:
    """Period, given by two stamps (ns, capture clock), in which a lift is valid.

    begun_ns: of the first frame that may have seen it, in the passes that the map shows there.
    """

    from_ns: int
    until_ns: int
    begun_ns: int


def validity(
    travel: Travel, place: Placement, magnet: Magnet, load: tuple[Bundle, ...], heights: HeightMap,
    settings: LiftSettings,
) -> Validity | None:  # fmt: skip
    """Find the validity of a lift: `max_age_s` from the time when the part it depends on that is oldest was
    last seen. None where no frame certainly saw the place itself.

    It depends on the outlines of magnet and load, both widened by the crane's tolerance and the range of the
    stray field. A part that no pass saw has no age of its own; other checks forbid the lift where it matters.
    """
    measured = np.flatnonzero(travel.measured)
    here = np.array([[place.x_m, place.y_m]])
    if not (_distances(travel.place_m[measured], here) < travel.sure_reach_m).any():
        return None
    wider = STRAY_FIELD_M + max(magnet.tolerance.x_m, magnet.tolerance.y_m)
    wider += math.radians(magnet.tolerance.yaw_deg) * max(magnet.size_m) / 2
    outlines = [(here[0], place.yaw_rad, *magnet.size_m)]
    outlines += [(b.centre_m[:2], b.yaw_rad, b.width_m, b.length_m) for b in load]
    grid = [_places_in(centre, yaw, width + 2 * wider, length + 2 * wider)
            for centre, yaw, width, length in outlines]  # fmt: skip
    seen_ns, begun_ns = _times_seen(travel, measured, np.concatenate([here, *grid]), heights).min(axis=1)
    return Validity(int(seen_ns), int(seen_ns) + seconds_to_ns(settings.max_age_s), int(begun_ns))


def _times_seen(travel: Travel, measured: Int64, at_m: Float64, heights: HeightMap) -> Int64:
    """Find the times (2, P) when the places (P, 2) that were seen were last and first seen. The last is that
    of the last frame that certainly saw it, otherwise of the first that may have, as the first is; all in the
    pass whose height the map has there. The first place must have been seen.
    """
    several, numbers = len(travel.pass_number) > 0, travel.passes[measured]
    newest = np.ones(len(at_m), np.int64)
    if several and heights.passes is not None:
        column, row, inside = nearest_cells(heights, at_m[:, 0], at_m[:, 1])
        newest = np.where(inside, heights.passes[row, column], 0).astype(np.int64)
        newest[0] = newest[0] or numbers.min()
    kept = _thinned(at_m, newest)
    at_m, newest = at_m[kept], newest[kept]
    span_m = float(_distances(at_m[:1], at_m).max())
    near = _distances(travel.place_m[measured], at_m[:1])[0] < travel.reach_m + span_m
    found = []
    for number in np.unique(newest[newest > 0]):
        stamps = travel.stamp_ns[measured[(numbers == number) & near]]
        if not len(stamps):
            found.append(np.repeat(travel.stamp_ns[measured[numbers <= number][:1]][None], 2, axis=0))
            continue
        places = travel.place_m[measured[(numbers == number) & near]]
        far = _distances(places, at_m[newest == number])
        last = np.where(far < travel.sure_reach_m, stamps, -1).max(axis=1)
        may = (far < travel.reach_m) | ~(far < travel.reach_m).any(axis=1, keepdims=True)
        first = np.where(may, stamps, stamps.max()).min(axis=1)
        found.append(np.stack([np.where(last >= 0, last, first), first]))
    return np.concatenate(found, axis=1)


def _thinned(at_m: Float64, newest: Int64) -> Int64:
    """Select the first place of each pass in every square of `SQUARE_M`."""
    column, row = np.floor(at_m / SQUARE_M).astype(np.int64).T
    key = ((row - row.min()) * (np.ptp(column) + 1) + column - column.min()) * 256 + newest
    return np.sort(np.unique(key, return_index=True)[1])


def _distances(frames_m: Float64, at_m: Float64) -> Float64:
    """Compute the distances (P, N) of places (P, 2) from frames (N, 2)."""
    x, y = (at_m[:, None, k] - frames_m[None, :, k] for k in (0, 1))
    return np.asarray(np.hypot(x, y), np.float64)


def _places_in(centre_m: Float64, yaw_rad: float, width_m: float, length_m: float) -> Float64:
    """Lay out places (P, 2) over a rectangle, including its edges, at most `PART_M` apart."""
    v, u = (np.linspace(-size / 2, size / 2, math.ceil(size / PART_M) + 1) for size in (length_m, width_m))
    across, along = axes_of(yaw_rad)
    at_m = centre_m + v[:, None, None] * along + u[None, :, None] * across
    return np.asarray(at_m, np.float64).reshape(-1, 2)


def old_cells(ground: Ground, travel: Travel, now_ns: int, settings: LiftSettings) -> Bool:
    """Mark the coarse cells [y, x] that were last seen longer ago than `max_age_s`, by the same rule as a
    lift's validity, in squares of `SQUARE_M`. In a cell from several passes, the oldest one counts.
    """
    since_ns, measured = now_ns - seconds_to_ns(settings.max_age_s), np.flatnonzero(travel.measured)
    stamps = travel.stamp_ns[measured]
    if not (stamps < since_ns).any():
        return np.zeros(ground.top_m.shape, np.bool_)
    numbers = travel.passes[measured]
    passes, old = ground.oldest_passes(), np.ones(ground.top_m.shape, np.bool_)
    step = max(round(SQUARE_M / ground.cell_m), 1)
    rows, columns = ground.top_m.shape
    x_m, y_m = (
        first + ground.cell_m * (np.arange(0, count, step) + (step - 1) / 2)
        for first, count in ((ground.x0_m, columns), (ground.y0_m, rows))
    )
    for number in np.unique(numbers):
        own = measured[numbers == number]
        late, places = travel.stamp_ns[own] >= since_ns, travel.place_m[own]
        fresh = np.zeros((len(y_m), len(x_m)), np.bool_)
        for row, y in enumerate(y_m):
            far = _distances(places, np.column_stack([x_m, np.full(len(x_m), y)]))
            sure, may = far < travel.sure_reach_m, far < travel.reach_m
            may |= ~may.any(axis=1, keepdims=True)
            fresh[row] = np.where(sure.any(axis=1), (sure & late).any(axis=1), (~may | late).all(axis=1))
        whole = fresh.repeat(step, axis=0)[:rows].repeat(step, axis=1)[:, :columns]
        old &= ~((passes == number) & whole)
    return old


def age_checks(captured_to_ns: int | None, now_ns: int, settings: LiftSettings) -> list[Check]:
    """Check that the capture isn't too old, in the future or at an unknown time. Stamps in ns since 1970."""
    if captured_to_ns is None:
        reason = "the time when the place was last seen is unknown"
        return [check_true("map-too-old", "age of what was seen", None, reason)]
    age_ns, max_age_ns = now_ns - captured_to_ns, seconds_to_ns(settings.max_age_s)
    return [
        check_min(
            "map-from-the-future", "age by this computer's clock", age_ns / NS_PER_S,
            -MAX_CLOCK_ERROR_NS / NS_PER_S, "s",
            f"the last frame is {_span(-age_ns)} ahead of this computer's clock: synchronise the clocks",
        ),
        check_max(
            "map-too-old", "age of what was seen", age_ns / NS_PER_S, settings.max_age_s, "s",
            f"the place was last seen {_span(age_ns)} ago; the limit is {_span(max_age_ns)}",
        ),
    ]  # fmt: skip


def disturbed_checks(
    events: tuple[YardEvent, ...], place: Placement, magnet: Magnet, load: tuple[Bundle, ...],
    seen: Validity | None, settings: LiftSettings,
) -> list[Check]:  # fmt: skip
    """Check that no event occurred within reach of magnet and load since the frames that the map shows there
    began: heights from before and after it are fused.
    """
    outlines = [corners((place.x_m, place.y_m), place.yaw_rad, *magnet.size_m)]
    outlines += [bundle.corners_m for bundle in load]
    since = [event for event in events if seen is None or event.stamp_ns > seen.begun_ns]
    checks = []
    for event in since:
        away = min(gap_between(outline, event.corners_m) for outline in outlines)
        reason = (
            f"a {event.kind} at {event.x_m:.2f}, {event.y_m:.2f} m, {away:.2f} m away, came after the place "
            f"was first seen; at least {settings.disturbed_reach_m:g} m are needed: measure again"
        )
        what = f"distance to a {event.kind} since the place was first seen"
        checks.append(check_min("disturbed", what, away, settings.disturbed_reach_m, "m", reason))
    return sorted(checks, key=lambda check: check.value or 0.0)[:1]


def _span(duration_ns: int) -> str:
    minutes = duration_ns / NS_PER_S / 60
    for unit, length in (("days", 24 * 60.0), ("h", 60.0)):
        if minutes > 2 * length:
            return f"{minutes / length:.0f} {unit}"
    return f"{minutes:.0f} min" if minutes >= 2 else f"{60 * minutes:.0f} s"
