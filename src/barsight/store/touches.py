"""Note where a crane's magnet came down, took a load or put it down, and end the offers beside these places.

Places are the crane's readings, as of a lift's `crane_target`.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from typing import Any

from barsight.core.arrays import Float64
from barsight.core.extras import extra
from barsight.store.audit import Entry, entry
from barsight.store.confirmation import (
    OpenLift,
    end_beside,
    end_offers,
    find_lifts,
    open_lifts,
    yard_clock_ns,
)  # fmt: skip
from barsight.store.lift_records import (
    find_beside,
    find_gap,
    find_outlines,
    is_at,
    lift_record,
    off_target,
    raise_beside,
)  # fmt: skip
from barsight.store.opening import Store
from barsight.store.states import last_raised_ns, step_lift
from barsight.store.tables import LIFT_STATES, LIFTS, SIGHTINGS, TOUCHES
from barsight.yard.axes import corners
from barsight.yard.inventory.bundle_file import bundle_of

with extra("store"):
    from sqlalchemy import Connection, Row, Select, select


TOUCH_KINDS = ("grip", "release", "contact", "on")


@dataclass(frozen=True)
class Touch:
    """A place that a crane read. kind: `grip` (the magnet is down and on), `release` (it was turned off),
    `contact` (it came down without being on), or `on` (it was turned on higher than where a lift takes its
    load: what lies there is higher than was told, or it was turned on early).
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
                    raise_beside(opened, lift.lift_id, beside)
                    end_beside(opened, lift)


def end_disturbed(opened: Entry, since_ns: int) -> None:
    """End offers near lifts and touches that moved something after `since_ns`, the beginning of a map being
    added; all after a lift that isn't recorded, as its place is unknown.
    """
    unrecorded_ns = last_raised_ns(opened.connection, "lift-unrecorded")
    if unrecorded_ns is not None and unrecorded_ns >= since_ns:
        end_offers(opened, "disturbed: a lift that isn't recorded was reported after this map was begun")
    moving = select(LIFT_STATES.c.lift_id).where(
        LIFT_STATES.c.state.in_(("executing", "executed")), LIFT_STATES.c.at_ns >= since_ns
    )
    begun = LIFT_STATES.c.lift_id.in_(select(LIFT_STATES.c.lift_id).where(LIFT_STATES.c.state == "executing"))
    late = LIFT_STATES.c.state == "failed", LIFT_STATES.c.at_ns >= since_ns
    failed = select(LIFT_STATES.c.lift_id).where(*late, begun)
    for lift in find_lifts(opened.connection, LIFTS.c.id.in_(moving) | LIFTS.c.id.in_(failed)):
        end_beside(opened, lift)
    _end_within_reach(opened, select(TOUCHES).where(TOUCHES.c.at_ns >= since_ns))


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
        if row.kind == "on" or _is_as_planned(connection, row):
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
    record = lift_record(connection, row.lift_id)
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
        off_m = off_target(other.record, place.x_m, place.y_m)
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
