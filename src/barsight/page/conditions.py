"""Find conditions that need an operator or engineer, and raise, return and clear their alarms (ISA-18.2)."""

from __future__ import annotations

import json
import time
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from barsight.core.errors import Failed, InputError
from barsight.core.extras import extra
from barsight.page.live import LiveHealth
from barsight.result_folder import changed_inputs, read_summary
from barsight.store.audit import entry, verify_chain
from barsight.store.calibrations import why_invalid
from barsight.store.confirmation import newest_survey, yard_clock_ns
from barsight.store.history import identity_name, why_ahead
from barsight.store.opening import Store
from barsight.store.promotion import counts
from barsight.store.states import alarm_state, raise_alarm, step_alarm
from barsight.store.tables import (
    ABSENCES,
    ALARM_STATES,
    ALARMS,
    LIFT_BUNDLES,
    LIFT_STATES,
    SIGHTINGS,
    SURVEYS,
)  # fmt: skip

with extra("store"):
    from sqlalchemy import CompoundSelect, Connection, Row, func, select

ALARM_CODES = {
    "store-broken": "The audit log of the store doesn't hold: rows were changed outside Barsight.",
    "calibration-changed": "The newest map's calibration was changed since, or isn't valid any more.",
    "map-from-the-future": "This computer's clock was set back: surveys count as older than the newest one.",
    "survey-files": "The newest survey's folder is gone or lacks files.",
    "lift-failed": "A lift was reported as done or failed, and its bundle still lies there.",
    "bundle-gone": "A bundle is gone that no lift has taken.",
    "bundle-moved": "A bundle lies elsewhere, and no lift has carried it.",
    "live-stopped": "The live run writes no health any more.",
    "live-degraded": "The live run lacks a sensor or a process that lifts need.",
}
"""Alarms that the page's server raises itself: meaning by code."""
WHO = "barsight serve"
Condition = tuple[str, str]
"""Code and reason of an alarm."""


def find_conditions(connection: Connection, live: LiveHealth | None) -> set[Condition]:
    """Find all current conditions except those of the audit log."""
    found: set[Condition] = set()
    newest = newest_survey(connection)
    if newest is not None:
        found |= _file_conditions(newest) | _yard_conditions(connection, newest)
        clock_ns = yard_clock_ns(connection)
        reason = why_invalid(connection, newest.calibration_id, clock_ns)
        found |= {("calibration-changed", reason)} if reason else set()
        ahead = why_ahead(newest.captured_to_ns, clock_ns)
        found |= {("map-from-the-future", ahead)} if ahead else set()
    if live is not None and live.problem is not None:
        found.add(live.problem)
    return found


def find_chain_condition(connection: Connection) -> set[Condition]:
    """Verify the audit log; return its condition if it is invalid."""
    chain = verify_chain(connection)
    return {("store-broken", chain.reason)} if isinstance(chain, Failed) else set()


def is_there(path: Path) -> bool:
    """Tell whether a file is there; one on a share that is away isn't."""
    try:
        return path.is_file()
    except OSError:
        return False


def _file_conditions(newest: Row[Any]) -> set[Condition]:
    folder = Path(newest.folder)
    lost = [name for name in sorted(json.loads(newest.files)) if not is_there(folder / name)]
    if lost:
        return {("survey-files", f"{folder}: {', '.join(lost)} not there")}
    try:
        changed = changed_inputs(read_summary(folder))
    except (InputError, OSError) as error:
        return {("survey-files", str(error))}
    return {("calibration-changed", changed)} if changed else set()


def _yard_conditions(connection: Connection, newest: Row[Any]) -> set[Condition]:
    """Compare the newest survey with what the lifts did."""
    found: set[Condition] = set()
    gone = select(ABSENCES.c.bundle_id).where(ABSENCES.c.survey_id == newest.id, ABSENCES.c.kind == "gone")
    moved = select(SIGHTINGS.c.bundle_id).where(
        SIGHTINGS.c.survey_id == newest.id, SIGHTINGS.c.change == "moved"
    )
    lifted = _lifted_since_seen(connection, newest.captured_to_ns, gone.union(moved))
    for code, query in (("bundle-gone", gone), ("bundle-moved", moved)):
        for number in connection.execute(query).scalars().all():
            if number not in lifted:
                found.add((code, identity_name(number)))
    failed = select(LIFT_STATES).where(
        LIFT_STATES.c.state == "failed", LIFT_STATES.c.at_ns >= newest.captured_to_ns
    )
    for row in connection.execute(failed).all():
        found.add(("lift-failed", f"lift {row.lift_id}: {row.note}"))
    return found


def _lifted_since_seen(connection: Connection, before_ns: int, asked: CompoundSelect[Any]) -> set[int]:
    """Find which of the bundles asked about a lift, of one or several, has taken since the last survey before
    a time that saw them began.
    """
    earlier = (
        select(SIGHTINGS.c.bundle_id, func.max(SURVEYS.c.captured_from_ns).label("from_ns"))
        .join(SURVEYS)
        .where(SIGHTINGS.c.bundle_id.in_(asked), SURVEYS.c.captured_to_ns < before_ns, counts())
        .group_by(SIGHTINGS.c.bundle_id)
    )
    seen = {row.bundle_id: row.from_ns for row in connection.execute(earlier)}
    executed = (
        select(LIFT_BUNDLES.c.bundle_id, LIFT_STATES.c.at_ns)
        .join(LIFT_STATES, LIFT_STATES.c.lift_id == LIFT_BUNDLES.c.lift_id)
        .where(LIFT_BUNDLES.c.bundle_id.in_(asked), LIFT_STATES.c.state == "executed")
    )
    return {row.bundle_id for row in connection.execute(executed) if row.at_ns >= seen.get(row.bundle_id, 0)}


def settle_alarms(
    store: Store, present: set[Condition], judged: set[str], seen: Mapping[str, set[str]]
) -> bool:
    """Raise an alarm for each new condition, and return or clear those whose condition has ended.

    judged: codes that were checked. seen: reasons that may have ended, by code; all those of a code that it
    lacks. Returns whether anything was changed.
    """
    with store.reading() as connection:
        if _changes(connection, present, judged, seen) == ([], []):
            return False
    with entry(store, WHO, "alarms", time.time_ns()) as opened:
        new, ended = _changes(opened.connection, present, judged, seen)
        for code, reason in new:
            raise_alarm(opened, code, reason)
        for number in ended:
            is_raised = alarm_state(opened.connection, number) == "raised"
            step_alarm(opened, number, "returned" if is_raised else "cleared", "the cause is gone")
    return True


def _changes(
    connection: Connection, present: set[Condition], judged: set[str], seen: Mapping[str, set[str]]
) -> tuple[list[Condition], list[int]]:
    """Find conditions without an active alarm, and alarms whose condition has ended."""
    last: dict[int, str] = {}
    for row in connection.execute(select(ALARM_STATES).order_by(ALARM_STATES.c.step)).all():
        last[row.alarm_id] = row.state
    active: dict[Condition, list[int]] = defaultdict(list)
    for row in connection.execute(select(ALARMS).order_by(ALARMS.c.id)).all():
        if last.get(row.id) in ("raised", "acknowledged") and row.code in judged:
            active[row.code, row.reason].append(row.id)
    gone = [one for one in active if one not in present and one[1] in seen.get(one[0], {one[1]})]
    return sorted(present - set(active)), [number for one in gone for number in active[one]]
