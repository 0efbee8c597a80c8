"""Move lifts, alarms and recordings from state to state, each step a row with author and time."""

from __future__ import annotations

from functools import cache
from typing import Any

from barsight.core.errors import InputError
from barsight.core.extras import extra
from barsight.store.audit import Entry
from barsight.store.tables import ALARM_STATES, ALARMS, LIFT_STATES, RECORDING_STATES

with extra("store"):
    from sqlalchemy import Connection, Select, Subquery, Table, func, select

LIFT_STEPS: dict[str | None, tuple[str, ...]] = {
    None: ("offered",),
    "offered": ("claimed", "expired"),
    "claimed": ("executing", "executed", "failed", "expired"),
    "executing": ("executed", "failed"),
    "executed": ("verified", "failed"),
}
"""States that may follow each state of a lift; none follows `failed`, `verified` and `expired`."""
ALARM_STEPS: dict[str | None, tuple[str, ...]] = {
    None: ("raised",),
    "raised": ("acknowledged", "cleared", "returned"),
    "acknowledged": ("cleared",),
    "returned": ("cleared",),
}
"""States that may follow each state of an alarm. `returned`: the cause has ended without an acknowledgement;
acknowledging the alarm then clears it (ISA-18.2).
"""
MISMATCHES = ("store-broken", "load-contradicts", "lift-beside", "lift-unrecorded", "lift-failed")
"""Codes of alarms after which the store may no longer match the yard."""
PRIORITIES = dict.fromkeys(MISMATCHES, 1) | {"calibration-changed": 1, "bundle-moved": 3, "survey-files": 3}
"""Priorities of alarms by code for page and plant, 1 is the highest; all others have 2."""
RECORDING_STEPS: dict[str | None, tuple[str, ...]] = {
    None: ("archived", "measured"),
    "archived": ("measured", "kept"),
    "measured": ("kept",),
    "kept": ("released",),
    "released": ("kept",),
}
"""States that may follow each state of a recording. `archived`: found by a fleet's plan; `kept`: not to be
deleted, for the reason in its note.
"""


def step_lift(opened: Entry, lift_id: int, state: str, note: str | None = None) -> None:
    """Move a lift to a state. Raises InputError if it may not follow the current state."""
    _step(opened, LIFT_STATES, "lift", lift_id, LIFT_STEPS, state, note)


def raise_alarm(opened: Entry, code: str, reason: str) -> int:
    """Raise an alarm and return its id."""
    alarm_id = opened.add(ALARMS, code=code, reason=reason)
    _step(opened, ALARM_STATES, "alarm", alarm_id, ALARM_STEPS, "raised", None)
    return alarm_id


def alarm_priority(code: str) -> int:
    """Return an alarm's priority, 1 to 3."""
    return PRIORITIES.get(code, 2)


def has_alarm(connection: Connection, code: str, reason: str) -> bool:
    """Check whether this alarm was ever raised."""
    query = select(ALARMS.c.id).where(ALARMS.c.code == code, ALARMS.c.reason == reason)
    return connection.execute(query).first() is not None


def last_raised_ns(connection: Connection, code: str) -> int | None:
    """Return when an alarm with this code was last raised, whatever its state now; None if never."""
    query = (
        select(func.max(ALARM_STATES.c.at_ns))
        .join(ALARMS, ALARMS.c.id == ALARM_STATES.c.alarm_id)
        .where(ALARMS.c.code == code, ALARM_STATES.c.state == "raised")
    )
    found: int | None = connection.execute(query).scalar_one()
    return found


def step_alarm(opened: Entry, alarm_id: int, state: str, note: str | None = None) -> None:
    """Acknowledge or clear an alarm. Raises InputError if that may not follow the current state."""
    _step(opened, ALARM_STATES, "alarm", alarm_id, ALARM_STEPS, state, note)


def acknowledge_alarm(opened: Entry, alarm_id: int, note: str | None = None) -> None:
    """Acknowledge an alarm, or clear it if its cause has ended; alarms alike in code and reason whose cause
    has ended are cleared with it. Raises InputError for an alarm that can't be acknowledged.
    """
    is_returned = alarm_state(opened.connection, alarm_id) == "returned"
    step_alarm(opened, alarm_id, "cleared" if is_returned else "acknowledged", note)
    own = select(ALARMS.c.code, ALARMS.c.reason).where(ALARMS.c.id == alarm_id)
    code, reason = opened.connection.execute(own).one()
    alike = _standing_query().where(
        ALARMS.c.code == code, ALARMS.c.reason == reason, ALARM_STATES.c.state == "returned"
    )
    for row in opened.connection.execute(alike).all():
        step_alarm(opened, row.id, "cleared", note)


def step_recording(opened: Entry, recording_id: int, state: str, note: str | None = None) -> None:
    """Move a recording to a state. Raises InputError if it may not follow the current state."""
    _step(opened, RECORDING_STATES, "recording", recording_id, RECORDING_STEPS, state, note)


def recording_state(connection: Connection, recording_id: int) -> str | None:
    """Return a recording's state, None if there is no such recording."""
    return _last(connection, RECORDING_STATES, "recording", recording_id)[1]


def lift_state(connection: Connection, lift_id: int) -> str | None:
    """Return a lift's state, None if there is no such lift."""
    return _last(connection, LIFT_STATES, "lift", lift_id)[1]


def alarm_state(connection: Connection, alarm_id: int) -> str | None:
    """Return an alarm's state, None if there is no such alarm."""
    return _last(connection, ALARM_STATES, "alarm", alarm_id)[1]


def standing_alarms(connection: Connection) -> list[tuple[str, str, str]]:
    """List code, reason and state of the alarms that aren't cleared, the newest first."""
    return [(row.code, row.reason, row.state) for row in connection.execute(_standing_query()).all()]


def has_standing(connection: Connection, code: str) -> bool:
    """Check whether an alarm with this code stands whose cause hasn't ended."""
    return any(one == code and state != "returned" for one, _, state in standing_alarms(connection))


@cache
def _standing_query() -> Select[Any]:
    newest = newest_steps(ALARM_STATES, "alarm")
    return (
        select(ALARMS.c.id, ALARMS.c.code, ALARMS.c.reason, ALARM_STATES.c.state)
        .join(ALARM_STATES, ALARM_STATES.c.alarm_id == ALARMS.c.id)
        .join(newest, (newest.c.alarm_id == ALARMS.c.id) & (newest.c.step == ALARM_STATES.c.step))
        .where(ALARM_STATES.c.state != "cleared")
        .order_by(ALARMS.c.id.desc())
    )


def newest_steps(table: Table, owner: str) -> Subquery:
    """Build the query for the number of each owner's last step."""
    key = table.c[f"{owner}_id"]
    return select(key, func.max(table.c.step).label("step")).group_by(key).subquery()


def _last(connection: Connection, table: Table, owner: str, number: int) -> tuple[int, str | None]:
    """Find an owner's last step and state."""
    found = connection.execute(
        select(table.c.step, table.c.state)
        .where(table.c[f"{owner}_id"] == number)
        .order_by(table.c.step.desc())
        .limit(1)
    ).first()
    return (0, None) if found is None else (int(found[0]), str(found[1]))


def _step(
    opened: Entry, table: Table, owner: str, number: int, steps: dict[str | None, tuple[str, ...]],
    state: str, note: str | None,
) -> None:  # fmt: skip
    count, present = _last(opened.connection, table, owner, number)
    if state not in steps.get(present, ()):
        allowed = ", ".join(steps.get(present, ())) or "nothing"
        problem = f"is {state} already" if state == present else f"is {present}: {state} can't follow"
        raise InputError(f"{owner} {number}", problem, f"what can follow is {allowed}")
    values = {f"{owner}_id": number, "step": count + 1, "state": state, "who": opened.who, "note": note}
    opened.add(table, at_ns=opened.at_ns, **values)
