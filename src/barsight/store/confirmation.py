"""Confirm offered lifts and report their outcome; end offers and confirmations together with their map."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from barsight.core.arrays import Float64
from barsight.core.errors import ConfigError, InputError
from barsight.core.extras import extra
from barsight.store.audit import Entry, entry, has_entry, newest_entry
from barsight.store.calibrations import why_invalid
from barsight.store.lift_records import find_beside, find_gap, find_outlines, raise_beside, why_outdated
from barsight.store.opening import Store
from barsight.store.promotion import counts
from barsight.store.states import has_alarm, has_standing, lift_state, newest_steps, raise_alarm, step_lift
from barsight.store.tables import LIFT_STATES, LIFTS, SURVEY_FACTS, SURVEY_VETOES, SURVEYS
from barsight.yard.lifting.validity import is_ahead
from barsight.yard.vetoes import VETOES

with extra("store"):
    from sqlalchemy import ColumnElement, Connection, Row, Select, select

OPEN = ("offered", "claimed", "executing")


class LateReportError(InputError):
    """A lift was reported after it had ended: it can't be recorded, but the alarm is."""


class BesideError(InputError):
    """A lift was reported as executed that was made beside its target; it is recorded as failed."""


@dataclass(frozen=True, eq=False)
class OpenLift:
    """An offered, claimed or executing lift. record: its JSON in lifts.json, without poles and checks."""

    lift_id: int
    survey_id: int
    map_id: str
    calibration_id: str
    state: str
    record: dict[str, Any]


def newest_survey(connection: Connection) -> Row[Any] | None:
    """Return the row of the survey with the newest frames, without its heights; None if there is none."""
    return connection.execute(_newest_query()).first()


@cache
def _newest_query() -> Select[Any]:
    order = (SURVEYS.c.captured_to_ns.desc(), SURVEYS.c.id.desc())
    return select(*SURVEY_FACTS).where(counts()).order_by(*order).limit(1)


def map_vetoes(connection: Connection, survey_id: int) -> list[dict[str, str]]:
    """List code and reason of the vetoes against all lifts of a survey."""
    query = select(SURVEY_VETOES).where(
        SURVEY_VETOES.c.survey_id == survey_id, SURVEY_VETOES.c.bundle_id.is_(None)
    )
    rows = connection.execute(query.order_by(SURVEY_VETOES.c.id)).all()
    return [{"code": row.code, "reason": row.reason} for row in rows]


def yard_clock_ns(connection: Connection, now_ns: int | None = None) -> int:
    """Return the yard's time: this computer's clock, or that of a simulated yard, which has run from the
    newest survey's last frame since that survey was added.
    """
    now_ns = time.time_ns() if now_ns is None else now_ns
    newest = newest_survey(connection)
    if newest is None or not newest.is_simulated:
        return now_ns
    return int(newest.captured_to_ns) + max(0, now_ns - int(newest.added_ns))


def open_lifts(connection: Connection) -> tuple[OpenLift, ...]:
    """List the offered, claimed or executing lifts in the order of their ids.

    Those of surveys that don't count are among them: whatever a fleet promotes, a crane may hold their load.
    """
    return _lifts(connection, _open_query())


def find_lifts(connection: Connection, which: ColumnElement[bool]) -> tuple[OpenLift, ...]:
    """Find lifts by a condition on LIFTS and their last state, in the order of their ids."""
    return _lifts(connection, _lift_query(which))


@cache
def _open_query() -> Select[Any]:
    return _lift_query(LIFT_STATES.c.state.in_(OPEN))


def _lift_query(which: ColumnElement[bool]) -> Select[Any]:
    """Build the query for lifts by a condition on their last state, in the order of their ids."""
    newest = newest_steps(LIFT_STATES, "lift")
    return (
        select(LIFTS, SURVEYS.c.map_id, SURVEYS.c.calibration_id, LIFT_STATES.c.state)
        .join(SURVEYS, SURVEYS.c.id == LIFTS.c.survey_id)
        .join(newest, newest.c.lift_id == LIFTS.c.id)
        .join(
            LIFT_STATES,
            (LIFT_STATES.c.lift_id == LIFTS.c.id) & (LIFT_STATES.c.step == newest.c.step),
        )
        .where(which)
        .order_by(LIFTS.c.id)
    )


def _lifts(connection: Connection, query: Select[Any]) -> tuple[OpenLift, ...]:
    rows = connection.execute(query).all()
    return tuple(
        OpenLift(r.id, r.survey_id, r.map_id, r.calibration_id, r.state, json.loads(r.record)) for r in rows
    )


def confirm_lift(store: Store, lift_id: int, map_id: str, who: str) -> None:
    """Confirm an offered lift on the map that the operator saw. Raises InputError if this isn't allowed."""

    def step(opened: Entry, lift: OpenLift) -> None:
        if lift.map_id != map_id:
            remedy = "look at the lift again before confirming it"
            raise InputError(f"lift {lift_id}", f"was offered on map {lift.map_id}, not {map_id}", remedy)
        note = f"map {lift.map_id}, calibration {lift.calibration_id}"
        step_lift(opened, lift_id, "claimed", note)

    _change(store, lift_id, who, "lift confirmed", step)


def begin_lift(store: Store, lift_id: int, who: str) -> None:
    """Begin a confirmed lift, once. Raises InputError if it may not begin, or if another one has begun."""

    def step(opened: Entry, lift: OpenLift) -> None:
        for other in open_lifts(opened.connection):
            if other.state == "executing":
                raise InputError(
                    f"lift {other.lift_id}", "has begun", "report it as executed or failed first"
                )
        step_lift(opened, lift_id, "executing")

    _change(store, lift_id, who, "lift begun", step)


def take_lift(
    store: Store, lift_id: int, who: str, alarm: tuple[str, str] | None = None, note: str | None = None
) -> None:
    """Report a confirmed lift as executed; this ends nearby offers and confirmations.

    A lift that the crane's readings place beside its target is recorded as failed, with the alarm
    `lift-beside` (BesideError). alarm: code and reason of one to raise with it. Raises InputError if the lift
    can't be recorded; if it was confirmed and has ended, an alarm is raised and all end (LateReportError).
    """
    with store.reading() as connection:
        beside = find_beside(connection, lift_id, is_reported=True)
        is_known = beside is not None and lift_state(connection, lift_id) == "failed"

    def step(opened: Entry, lift: OpenLift) -> None:
        if beside is None:
            step_lift(opened, lift_id, "executed", note)
        else:
            step_lift(opened, lift_id, "failed", f"it was reported as executed; {beside}")
            raise_beside(opened, lift_id, beside)
        end_beside(opened, lift)
        if alarm is not None:
            raise_alarm(opened, *alarm)

    try:
        if not is_known:
            _change(store, lift_id, who, "lift executed", step)
    except InputError:
        _note_unrecorded(store, lift_id, who, "executed")
        raise
    if beside is not None:
        raise BesideError(f"lift {lift_id}", beside, "it is recorded as failed")


def _note_unrecorded(store: Store, lift_id: int, who: str, reported: str) -> None:
    """Record, once, that a lift was made after its confirmation had ended: raise an alarm, end all offers and
    confirmations. Raises LateReportError, which says so; returns if there is nothing to record.

    reported: `executed` or `failed`. A lift that was never confirmed, or was reported before, isn't recorded.
    """
    with store.reading() as connection:
        query = select(LIFT_STATES.c.state).where(LIFT_STATES.c.lift_id == lift_id)
        states = set(connection.execute(query).scalars())
        clock_ns = yard_clock_ns(connection)
    if "claimed" not in states or states & {"executed", reported}:
        return
    did = "failed" if reported == "failed" else "was executed"
    with entry(store, who, f"lift unrecorded {lift_id}", clock_ns) as opened:
        state = lift_state(opened.connection, lift_id) or "unknown"
        if state in OPEN:
            raise InputError(f"lift {lift_id}", f"is {state}", "report it again")
        alarm = f"lift {lift_id} {did} and is {state}, unrecorded: survey before the next lift"
        if not has_alarm(opened.connection, "lift-unrecorded", alarm):
            raise_alarm(opened, "lift-unrecorded", alarm)
            end_offers(opened, f"disturbed: lift {lift_id} {did} and isn't recorded")
    raise LateReportError(
        f"lift {lift_id}", f"is {state}, it can't be recorded", "survey before the next lift"
    )


def end_lift(store: Store, lift_id: int, state: str, who: str, note: str, tells_begin: bool = False) -> None:
    """Decline an offer, withdraw a confirmation (`expired`), or report that a confirmed lift `failed`.

    A lift that fails after it has begun may have moved something: nearby offers and confirmations end. It is
    assumed to have begun unless `who` reports beginnings (tells_begin), as cranes do.
    """
    if state not in ("expired", "failed"):
        raise ConfigError(f"a lift does not end as {state!r}")
    if not note.strip():
        raise ConfigError("say why, for the audit log")

    def step(opened: Entry, lift: OpenLift) -> None:
        is_assumed = (lift.state, state) == ("claimed", "failed") and not tells_begin
        if is_assumed:
            step_lift(opened, lift_id, "executing")
        step_lift(opened, lift_id, state, note)
        if is_assumed or lift.state == "executing":
            end_beside(opened, lift)

    try:
        _change(store, lift_id, who, f"lift {state}", step)
    except InputError:
        if state == "failed" and not tells_begin:
            _note_unrecorded(store, lift_id, who, state)
        raise


def end_offers(opened: Entry, reason: str) -> None:
    """End all offers and confirmations; a lift that has begun stays open until it is reported."""
    for lift in open_lifts(opened.connection):
        if lift.state != "executing":
            step_lift(opened, lift.lift_id, "expired", reason)


def end_beside(opened: Entry, lift: OpenLift) -> None:
    """End offers and confirmations within reach of anything that a lift may have moved."""

    def outlines(one: OpenLift) -> list[Float64]:
        return find_outlines(opened.connection, one.lift_id, one.survey_id, one.record)

    moved = outlines(lift)
    for other in open_lifts(opened.connection):
        reach_m = other.record.get("disturbed_reach_m")
        if other.state != "executing" and (reach_m is None or find_gap(moved, outlines(other)) < reach_m):
            note = f"disturbed: lift {lift.lift_id} came near its place, or near where its load would be put"
            step_lift(opened, other.lift_id, "expired", note)


def forbid(store: Store, code: str, reason: str, who: str) -> None:
    """Add a veto against the newest map: its offers and confirmations end, a lift that has begun stays open
    until it is reported. Raises ConfigError.
    """
    if code not in VETOES:
        raise ConfigError(f"{code!r} is not a veto; the reference of codes lists them")
    with store.reading() as connection:
        clock_ns = yard_clock_ns(connection)
    with entry(store, who, f"veto {code}", clock_ns) as opened:
        newest = newest_survey(opened.connection)
        if newest is None:
            raise ConfigError("there is no survey to forbid lifts of")
        opened.add(SURVEY_VETOES, survey_id=newest.id, code=code, reason=reason)
        end_offers(opened, f"{code}: {reason}")


def expire_stale(store: Store, who: str) -> int:
    """End offers and confirmations with an outdated map or an invalid calibration, and all if this computer's
    clock or the store was set back; return their number, without those that end with the store's state.
    """
    _end_lost(store, who)
    set_back_s, stale = store.clock.look(), {}
    with store.reading() as connection:
        clock_ns = yard_clock_ns(connection)
        is_due = bool(_stale(connection, clock_ns, set_back_s))
    if is_due:
        with entry(store, who, "lifts expired", clock_ns) as opened:
            stale = _stale(opened.connection, clock_ns, set_back_s)
            for lift_id, reason in stale.items():
                step_lift(opened, lift_id, "expired", reason)
    store.clock.settle()
    return len(stale)


def _end_lost(store: Store, who: str) -> None:
    """End all offers, and raise an alarm, if the log lacks a row that this process has seen: a backup, or a
    server that lagged behind, took the store's place, and lifts that were made since are offered again.
    """
    seen = store.log.newest  # before the transaction, which then must have it
    with store.reading() as connection:
        newest, is_whole = newest_entry(connection), has_entry(connection, seen)
        clock_ns = yard_clock_ns(connection)
    if not is_whole:
        with entry(store, who, "store set back", clock_ns) as opened:
            lost = f"the store was set back, row {seen[0]} of its log is gone: survey before the next lift"
            raise_alarm(opened, "lift-unrecorded", lost)
            end_offers(opened, "disturbed: the store was set back, which lifts were made isn't known")
    store.log.note(newest)


def _change(store: Store, lift_id: int, who: str, what: str, step: Callable[[Entry, OpenLift], None]) -> None:
    """Change a lift's state in one transaction with the check that it is still valid."""
    expire_stale(store, who)
    with store.reading() as connection:
        clock_ns = yard_clock_ns(connection)
    with entry(store, who, f"{what} {lift_id}", clock_ns) as opened:
        found = {lift.lift_id: lift for lift in open_lifts(opened.connection)}
        stale = _stale(opened.connection, clock_ns)
        if lift_id not in found or lift_id in stale:
            state = stale.get(lift_id) or lift_state(opened.connection, lift_id) or "unknown"
            raise InputError(f"lift {lift_id}", f"is {state}", "look at the present offers")
        step(opened, found[lift_id])


def _stale(connection: Connection, clock_ns: int, set_back_s: float = 0.0) -> dict[int, str]:
    """Return why offers and confirmations are no longer valid, by id. set_back_s: `WallClock.set_back_s`."""
    newest = newest_survey(connection)
    reasons = {}
    invalid = "" if newest is None else why_invalid(connection, newest.calibration_id, clock_ns)
    outdated = "" if newest is None else why_outdated(Path(newest.folder), newest.files)
    is_broken = has_standing(connection, "store-broken")
    for lift in open_lifts(connection):
        until_ns = lift.record["valid_until_ns"]
        if lift.state == "executing":
            continue
        if newest is not None and lift.survey_id != newest.id:
            reasons[lift.lift_id] = "expired: a newer map came"
        elif is_broken:
            reasons[lift.lift_id] = "expired: store-broken: rows of the store were changed outside Barsight"
        elif set_back_s:
            back = f"this computer's clock was set back by {set_back_s:.0f} s: ages aren't known"
            reasons[lift.lift_id] = f"expired: map-too-old: {back}"
        elif until_ns is None or until_ns < clock_ns:
            reasons[lift.lift_id] = "expired: map-too-old: it was valid for a limited time"
        elif newest is not None and is_ahead(newest.captured_to_ns, clock_ns):
            reasons[lift.lift_id] = "expired: map-from-the-future: the frames are ahead of this clock"
        elif invalid or outdated:
            told = f"calibration-changed: {invalid}" if invalid else f"disturbed: {outdated}"
            reasons[lift.lift_id] = f"expired: {told}"
    return reasons
