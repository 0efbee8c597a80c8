"""Note where a crane's magnet came down, took a load or put it down, and end the offers beside these places.

Places are the crane's readings, as of a lift's `crane_target`.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from barsight.core.arrays import Float64
from barsight.core.extras import extra
from barsight.store.audit import Entry, entry
from barsight.store.confirmation import OpenLift, end_beside, open_lifts, yard_clock_ns
from barsight.store.lift_records import find_gap, find_outlines
from barsight.store.opening import Store
from barsight.store.states import has_alarm, raise_alarm, step_lift
from barsight.store.tables import LIFT_STATES, LIFTS, SIGHTINGS, TOUCHES
from barsight.yard.events import corners
from barsight.yard.inventory.bundle_file import bundle_of

with extra("store"):
    from sqlalchemy import Connection, Row, Select, select

BESIDE = "lift-beside"
"""Code of the alarm after a magnet came down beside the target of its lift."""
ROUNDING_M = 1e-4
"""What a target and a reading may differ by, beyond the tolerance, as telegrams round both."""


@dataclass(frozen=True)
class Touch:
    """A place that a crane read. kind: `grip` (the magnet is down and on), `release` (it was turned off), or
    `contact` (it came down without being on).
    """

    kind: str
    x_m: float
    y_m: float
    z_m: float


def note_touch(store: Store, who: str, touch: Touch) -> None:
    """Note a touch, and end offers and confirmations within reach of what it may have moved.

    If a lift of this crane has begun and its load was taken elsewhere, the alarm `lift-beside` is raised, and
    the offers beside the lift's own place end too.
    """
    with store.reading() as connection:
        clock_ns = yard_clock_ns(connection)
    with entry(store, who, f"magnet: {touch.kind}", clock_ns) as opened:
        lift_id = _lift_of(opened.connection, who, touch)
        row_id = opened.add(
            TOUCHES, lift_id=lift_id, kind=touch.kind, x_m=touch.x_m, y_m=touch.y_m, z_m=touch.z_m,
            at_ns=clock_ns, who=who,
        )  # fmt: skip
        _end_within_reach(opened, select(TOUCHES).where(TOUCHES.c.id == row_id))
        for lift in open_lifts(opened.connection):
            if lift.lift_id == lift_id and lift.state == "executing":
                beside = find_beside(opened.connection, lift_id, is_reported=False)
                if beside is not None:
                    _raise_beside(opened, beside)
                    end_beside(opened, lift)


def end_touched(opened: Entry, since_ns: int) -> None:
    """End offers near the places that were touched after `since_ns`, the beginning of a map being added."""
    _end_within_reach(opened, select(TOUCHES).where(TOUCHES.c.at_ns >= since_ns))


def note_beside(store: Store, lift_id: int, who: str) -> str | None:
    """Return why a lift that is reported as executed wasn't made at its place, None if nothing says so; the
    alarm is raised, unless it was.
    """
    with store.reading() as connection:
        beside = find_beside(connection, lift_id, is_reported=True)
        clock_ns = yard_clock_ns(connection)
        is_raised = beside is None or has_alarm(connection, BESIDE, beside)
    if beside is not None and not is_raised:
        with entry(store, who, f"lift beside {lift_id}", clock_ns) as opened:
            _raise_beside(opened, beside)
    return beside


def find_beside(connection: Connection, lift_id: int, *, is_reported: bool) -> str | None:
    """Return where a lift's load was taken if it wasn't at its target, else None.

    The magnet must be there whenever it takes something, until it has put a load down elsewhere. is_reported:
    the lift is over, so that it must also have come down there, if it came down anywhere. None also if a load
    was put down that nobody saw taken.
    """
    record = _record(connection, lift_id)
    is_holding, elsewhere = False, None
    for row in _touches_of(connection, lift_id):
        is_there = is_at(record, row.x_m, row.y_m)
        if row.kind == "release" and not is_there:
            return None
        if row.kind == "release":
            is_holding = False  # nothing was taken away
        elif row.kind == "grip" and not is_there and not is_holding:
            return _words(lift_id, record, row)
        elif is_there:
            is_holding, is_reported = is_holding or row.kind == "grip", False
        else:
            elsewhere = row
    return _words(lift_id, record, elsewhere) if is_reported and elsewhere is not None else None


def was_at_target(connection: Connection, lift_id: int) -> bool:
    """Check whether a crane's readings tell that a lift's load was taken at its target."""
    record = _record(connection, lift_id)
    return any(
        row.kind != "release" and is_at(record, row.x_m, row.y_m) for row in _touches_of(connection, lift_id)
    )


def is_at(record: dict[str, Any], x_m: float, y_m: float, place: str = "target") -> bool:
    """Check whether a crane's readings lie within the tolerance of a lift's target, or of its set-down."""
    if record[place] is None:
        return False
    off_m, tolerance = _off(record, x_m, y_m, place), record["tolerance"]
    return all(abs(off_m[k]) <= tolerance[name] + ROUNDING_M for k, name in enumerate(("x_m", "y_m")))


def _off(record: dict[str, Any], x_m: float, y_m: float, place: str = "target") -> tuple[float, float]:
    # Records of an earlier version have no offset between the crane's readings and its magnet.
    wanted = record.get(f"crane_{place}") or record[place]
    return x_m - wanted["x_m"], y_m - wanted["y_m"]


def _words(lift_id: int, record: dict[str, Any], row: Row[Any]) -> str:
    off_m = math.hypot(*_off(record, row.x_m, row.y_m))
    what = "took a load" if row.kind == "grip" else "came down"
    return (
        f"lift {lift_id}: by the crane's readings the magnet {what} at x {row.x_m:.3f}, y {row.y_m:.3f} m, "
        f"{1e3 * off_m:.0f} mm beside the target: see what was moved, and survey before the next lift"
    )


def _raise_beside(opened: Entry, reason: str) -> None:
    if not has_alarm(opened.connection, BESIDE, reason):
        raise_alarm(opened, BESIDE, reason)


def _record(connection: Connection, lift_id: int) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(
        connection.execute(select(LIFTS.c.record).where(LIFTS.c.id == lift_id)).scalar_one()
    )
    return found


def _touches_of(connection: Connection, lift_id: int) -> Iterable[Row[Any]]:
    return connection.execute(
        select(TOUCHES).where(TOUCHES.c.lift_id == lift_id).order_by(TOUCHES.c.id)
    ).all()


def _lift_of(connection: Connection, who: str, touch: Touch) -> int | None:
    """Find the lift that a touch belongs to: the one whose load this crane took last, if it puts it down; the
    one that it has begun; or one that somebody claimed and makes at its target.
    """
    taken = [one for one in open_lifts(connection) if one.state != "offered"]
    claims = select(LIFT_STATES.c.lift_id, LIFT_STATES.c.who).where(
        LIFT_STATES.c.state == "claimed", LIFT_STATES.c.lift_id.in_([one.lift_id for one in taken])
    )
    by = {row.lift_id: row.who for row in connection.execute(claims).all()}
    grips = select(TOUCHES.c.lift_id).where(TOUCHES.c.who == who, TOUCHES.c.kind == "grip")
    held = connection.execute(grips.order_by(TOUCHES.c.id.desc()).limit(1)).scalar()
    found = [
        *([held] if held is not None and touch.kind == "release" else []),
        *(one.lift_id for one in taken if one.state == "executing" and by[one.lift_id] == who),
        *(one.lift_id for one in taken if is_at(one.record, touch.x_m, touch.y_m)),
    ]
    return found[0] if found else None


def _end_within_reach(opened: Entry, query: Select[Any]) -> None:
    """End offers and confirmations near touches, without those of the lift that a touch belongs to."""
    connection = opened.connection
    for row in connection.execute(query.order_by(TOUCHES.c.id)).all():
        if _is_as_planned(connection, row):
            continue
        moved: dict[int, list[Float64]] = {}
        for other in open_lifts(connection):
            if other.state == "executing" or other.lift_id == row.lift_id:
                continue
            if other.survey_id not in moved:
                moved[other.survey_id] = _moved(connection, row, other)
            reach_m = other.record.get("disturbed_reach_m")
            own = find_outlines(connection, other.lift_id, other.survey_id, other.record)
            if reach_m is None or find_gap(moved[other.survey_id], own) < reach_m:
                place = f"a magnet came down at x {row.x_m:.2f}, y {row.y_m:.2f} m ({row.kind})"
                step_lift(opened, other.lift_id, "expired", f"disturbed: {place}")


def _is_as_planned(connection: Connection, row: Row[Any]) -> bool:
    """Check whether a touch is where a lift that has begun tells it: its report ends the offers beside it."""
    begun = LIFT_STATES.c.lift_id == row.lift_id, LIFT_STATES.c.state == "executing"
    if row.lift_id is None or connection.execute(select(LIFT_STATES.c.id).where(*begun)).first() is None:
        return False
    record = _record(connection, row.lift_id)
    return is_at(record, row.x_m, row.y_m) or (
        row.kind == "release" and is_at(record, row.x_m, row.y_m, "set_down")
    )


def _moved(connection: Connection, row: Row[Any], other: OpenLift) -> list[Float64]:
    """Compute the outlines (4, 2) of what a touch may have moved, in the yard frame of another lift's map.

    That is the magnet, turned in any way, and the bundles below it; where a load was put down also the load,
    turned in any way: the longest of the bundles on which the magnet had come down, of all if those aren't
    known.
    """
    beam = other.record.get("beam") or {"width_m": 0.0, "length_m": 0.0}
    magnet_m = math.hypot(beam["width_m"], beam["length_m"])
    query = select(SIGHTINGS.c.record).where(SIGHTINGS.c.survey_id == other.survey_id)
    lying = [bundle_of(json.loads(record)) for record in connection.execute(query).scalars()]
    outlines = [
        corners((float(one.centre_m[0]), float(one.centre_m[1])), one.yaw_rad, one.width_m, one.length_m)
        for one in lying
    ]

    def square(place: Row[Any], side_m: float) -> Float64:
        off_m = _off(other.record, place.x_m, place.y_m)
        target = other.record["target"]
        return corners((target["x_m"] + off_m[0], target["y_m"] + off_m[1]), 0.0, side_m, side_m)

    def below(place: Row[Any]) -> list[int]:
        magnet = [square(place, magnet_m)]
        return [k for k, outline in enumerate(outlines) if find_gap(magnet, [outline]) == 0]

    moved = [square(row, magnet_m), *(outlines[k] for k in below(row))]
    if row.kind == "release":
        grips = select(TOUCHES).where(TOUCHES.c.who == row.who, TOUCHES.c.kind == "grip")
        newest = grips.where(TOUCHES.c.id < row.id).order_by(TOUCHES.c.id.desc()).limit(1)
        grip = connection.execute(newest).first()
        loads = (below(grip) if grip is not None else []) or range(len(lying))
        sides_m = (math.hypot(lying[k].width_m, lying[k].length_m) for k in loads)
        moved.append(square(row, max([magnet_m, *sides_m])))
    return moved
