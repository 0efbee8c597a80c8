"""Build the documents that the page reads from the store: the current yard, lifts, surveys, alarms, stock."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from barsight.core.errors import InputError
from barsight.core.extras import extra
from barsight.page.conditions import is_there
from barsight.store.audit import IDS_PER_QUERY
from barsight.store.calibrations import list_calibrations
from barsight.store.confirmation import map_vetoes, newest_survey, open_lifts, yard_clock_ns
from barsight.store.history import PresentBundle, identity_name, list_surveys, present_yard
from barsight.store.promotion import counts
from barsight.store.recordings import list_recordings
from barsight.store.states import alarm_priority
from barsight.store.tables import (
    ABSENCES,
    ALARM_STATES,
    ALARMS,
    LIFT_BUNDLES,
    LIFT_STATES,
    LIFTS,
    SIGHTINGS,
    STOCK_DECISIONS,
    SURVEY_FACTS,
    SURVEY_VETOES,
    SURVEYS,
)  # fmt: skip
from barsight.yard.inventory.bundle_file import read_match
from barsight.yard.inventory.matching import SAME_SIZE_RATIO

with extra("store"):
    from sqlalchemy import Connection, Row, func, or_, select

MAX_LIFTS = MAX_ALARMS = MAX_RECORDINGS = 500
"""Maximum numbers of past ones that the page lists."""
_FIGURES = (
    "axis_centre_m", "yaw_deg", "pitch_deg", "length_m", "ends_m", "ends_open", "width_m", "top_z_m",
    "bar_diameter_m", "bars", "section_m2", "mass_kg", "layer", "on_top", "confidence", "known_share",
    "sigma", "reasons", "cover_doubts",
)  # fmt: skip
_ALARM_ORDER = {"raised": 0, "returned": 1, "acknowledged": 2, "cleared": 3}


def state_document(connection: Connection) -> dict[str, Any]:
    """Build the header: the newest survey, the yard's clock, the numbers of open items."""
    newest = newest_survey(connection)
    alarms = alarm_records(connection)
    active = [one for one in alarms if one["state"] != "cleared"]
    top = min(active, key=_urgency, default=None)
    return {
        "clock_ns": yard_clock_ns(connection),
        "survey": None if newest is None else _survey_of(newest),
        "map_vetoes": [] if newest is None else map_vetoes(connection, newest.id),
        "offered": sum(lift.state == "offered" for lift in open_lifts(connection)),
        "claimed": sum(lift.state != "offered" for lift in open_lifts(connection)),
        "alarms": len(active),
        "unacknowledged": sum(one["state"] in ("raised", "returned") for one in active),
        "top_alarm": top,
    }


def bundle_records(connection: Connection, at_ns: int | None = None) -> list[dict[str, Any]]:
    """List the yard's bundles at a time, each with its figures, doubt, vetoes and the lift that takes it."""
    vetoes: dict[tuple[int, int], list[dict[str, str]]] = defaultdict(list)
    for row in connection.execute(select(SURVEY_VETOES).order_by(SURVEY_VETOES.c.id)).all():
        if row.bundle_id is not None:
            vetoes[row.survey_id, row.bundle_id].append({"code": row.code, "reason": row.reason})
    offers = {}
    if at_ns is None:
        of = _bundles_of_lifts(connection)
        offers = {number: lift for lift in open_lifts(connection) for number in of[lift.lift_id]}
    present = present_yard(connection, at_ns)
    beyond = unseen_lengths([one.sighting.record for one in present])
    return [
        _bundle(one, vetoes, offers) | {"unseen_m": unseen_m}
        for one, unseen_m in zip(present, beyond, strict=True)
    ]


def unseen_lengths(records: list[dict[str, Any]]) -> list[float | None]:
    """Estimate by how much each bundle with an open end is seen too short.

    The reference is the median length of longer bundles of the same kind with both ends seen; None without an
    open end or a reference.
    """
    whole = np.array(
        [
            (one["bar_diameter_m"] or np.nan, one["width_m"], one["length_m"])
            for one in records
            if not any(one["ends_open"])
        ]
    ).reshape(-1, 3)
    unseen_m: list[float | None] = []
    for record in records:
        size = np.array([record["bar_diameter_m"] or np.nan, record["width_m"]])
        alike = (np.abs(whole[:, :2] - size) <= SAME_SIZE_RATIO * size).all(axis=1)
        alike &= whole[:, 2] > record["length_m"]
        is_known = any(record["ends_open"]) and bool(alike.any())
        unseen_m.append(float(np.median(whole[alike, 2])) - record["length_m"] if is_known else None)
    return unseen_m


def _bundle(shown: PresentBundle, vetoes: Any, offers: Any) -> dict[str, Any]:
    sighting = shown.sighting
    lift = offers.get(sighting.bundle_id)
    return {
        "identity": sighting.identity,
        "map_id": sighting.map_id,
        "seen_ns": sighting.seen_ns,
        "change": sighting.change,
        "stock_name": sighting.stock_name,
        "doubt": None if shown.doubt is None else {"code": shown.doubt.kind, "reason": shown.doubt.reason},
        "vetoes": vetoes.get((sighting.survey_id, sighting.bundle_id), []),
        "lift": None
        if lift is None
        else {"id": lift.lift_id, "rank": lift.record["rank"], "state": lift.state},
        **{name: sighting.record[name] for name in _FIGURES},
    }


def bundle_history(connection: Connection, number: int) -> dict[str, Any] | None:
    """List all surveys that saw a bundle or looked for it, and its lifts; None if there is no such bundle."""
    seen = connection.execute(
        select(SIGHTINGS, SURVEYS.c.map_id, SURVEYS.c.captured_to_ns)
        .join(SURVEYS)
        .where(SIGHTINGS.c.bundle_id == number)
        .order_by(SURVEYS.c.captured_to_ns)
    ).all()
    if not seen:
        return None
    missed = connection.execute(
        select(ABSENCES, SURVEYS.c.map_id, SURVEYS.c.captured_to_ns)
        .join(SURVEYS)
        .where(ABSENCES.c.bundle_id == number)
    ).all()
    entries = [
        {
            "map_id": row.map_id, "at_ns": row.captured_to_ns, "what": row.change, "x_m": row.x_m,
            "y_m": row.y_m, "top_z_m": row.top_z_m, "length_m": row.length_m,
            "stock_name": row.stock_name, "sigma": json.loads(row.record)["sigma"],
        }
        for row in seen
    ]  # fmt: skip
    entries += [
        {"map_id": r.map_id, "at_ns": r.captured_to_ns, "what": r.kind, "reason": r.reason} for r in missed
    ]
    return {
        "identity": identity_name(number),
        "history": sorted(entries, key=lambda each: each["at_ns"]),
        "lifts": [one for one in lift_records(connection) if identity_name(number) in one["bundles"]],
    }


def lift_records(connection: Connection) -> list[dict[str, Any]]:
    """List the newest lifts and all open ones, each with its states, who set them, and its figures."""
    of = _bundles_of_lifts(connection)
    newest = select(LIFTS.c.id).join(SURVEYS).where(counts()).order_by(LIFTS.c.id.desc()).limit(MAX_LIFTS)
    open_ids = [lift.lift_id for lift in open_lifts(connection)]
    rows = connection.execute(
        select(LIFTS, SURVEYS.c.map_id, SURVEYS.c.calibration_id, SURVEYS.c.captured_to_ns)
        .join(SURVEYS)
        .where(or_(LIFTS.c.id.in_(newest), LIFTS.c.id.in_(open_ids)))
        .order_by(LIFTS.c.id.desc())
    ).all()
    steps = _steps(connection, LIFT_STATES, LIFT_STATES.c.lift_id, [row.id for row in rows])
    return [
        {
            "id": row.id, "rank": row.rank, "map_id": row.map_id, "calibration_id": row.calibration_id,
            "seen_ns": row.captured_to_ns, "bundles": [identity_name(number) for number in of[row.id]],
            "state": steps[row.id][-1]["state"], "steps": steps[row.id],
            **_lift_figures(json.loads(row.record)),
        }
        for row in rows
    ]  # fmt: skip


def _lift_figures(record: dict[str, Any]) -> dict[str, Any]:
    names = (
        "target", "tolerance", "set_down", "mass_kg", "mass_sigma_kg", "pull_low_n", "pull_needed_n",
        "safety", "count", "count_probability", "valid_from_ns", "valid_until_ns",
    )  # fmt: skip
    crane = ("crane_target", "crane_set_down")  # not in records of an earlier version
    return {name: record[name] for name in names} | {name: record.get(name) for name in crane}


def alarm_records(connection: Connection) -> list[dict[str, Any]]:
    """List the alarms that stand and the newest cleared ones, the most urgent state first, each with its
    states. Of those alike in code and reason that stand, only the newest is listed.
    """
    cleared = select(ALARM_STATES.c.alarm_id).where(ALARM_STATES.c.state == "cleared")
    past = select(ALARMS.c.id).where(ALARMS.c.id.in_(cleared)).order_by(ALARMS.c.id.desc()).limit(MAX_ALARMS)
    alike = (ALARMS.c.code, ALARMS.c.reason)
    standing = select(func.max(ALARMS.c.id)).where(ALARMS.c.id.not_in(cleared)).group_by(*alike)
    rows = connection.execute(
        select(ALARMS)
        .where(or_(ALARMS.c.id.in_(past), ALARMS.c.id.in_(standing)))
        .order_by(ALARMS.c.id.desc())
    ).all()
    steps = _steps(connection, ALARM_STATES, ALARM_STATES.c.alarm_id, [row.id for row in rows])
    alarms = [
        {
            "id": row.id, "code": row.code, "reason": row.reason, "state": steps[row.id][-1]["state"],
            "at_ns": steps[row.id][0]["at_ns"], "steps": steps[row.id],
            "priority": alarm_priority(row.code),
        }
        for row in rows
    ]  # fmt: skip
    return sorted(alarms, key=_urgency)


def _urgency(alarm: dict[str, Any]) -> tuple[int, int, int]:
    """Rank an alarm by state, then priority, then age, the newest first."""
    return _ALARM_ORDER[alarm["state"]], alarm["priority"], -alarm["at_ns"]


def survey_records(connection: Connection) -> list[dict[str, Any]]:
    """List the surveys, the newest first, with the findings and files of each."""
    files = {row.map_id: row for row in connection.execute(select(*SURVEY_FACTS)).all()}
    records = []
    for survey in reversed(list_surveys(connection)):
        row = files[survey.map_id]
        present = Path(survey.folder)
        more = [name for name in ("report.html", "ortho.png") if is_there(present / name)]
        kept = [name for name in sorted(json.loads(row.files)) if is_there(present / name)]
        records.append(
            asdict(survey)
            | {
                "calibration_id": row.calibration_id, "software_version": row.software_version,
                "added_ns": row.added_ns, "files": kept + more, "missing": sorted(
                    set(json.loads(row.files)) - set(kept)
                ),
            }
        )  # fmt: skip
    return records


def equipment_record(connection: Connection) -> dict[str, Any]:
    """List the calibrations with rig, crane and periods of approval, and the recordings."""
    return {
        "calibrations": [asdict(one) for one in list_calibrations(connection)],
        "recordings": [asdict(one) for one in reversed(list_recordings(connection))][:MAX_RECORDINGS],
    }


def stock_record(connection: Connection) -> dict[str, Any]:
    """List the differences between the newest survey and the stock list with which it was measured."""
    newest = newest_survey(connection)
    none: dict[str, Any] = {"map_id": None, "list": None, "differences": []}
    if newest is None:
        return none
    path = Path(newest.folder) / "bundles.json"
    try:
        match = read_match(path) if is_there(path) else None
    except (InputError, OSError, ValueError):
        match = None
    if match is None:
        return none | {"map_id": newest.map_id, "missing_file": not is_there(path)}
    numbers = {
        row.number: identity_name(row.bundle_id)
        for row in connection.execute(select(SIGHTINGS).where(SIGHTINGS.c.survey_id == newest.id)).all()
    }
    differences: list[dict[str, Any]] = [
        {"kind": "missing", "name": name, "bundle": None} for name in match.missing
    ]
    differences += [{"kind": "hidden", "name": name, "bundle": None} for name in match.hidden]
    differences += [{"kind": "extra", "name": None, "bundle": numbers.get(number)} for number in match.extra]
    for matched in match.matched:
        entry = {"name": matched.name, "bundle": numbers.get(matched.bundle)}
        if matched.name in match.moved:
            differences.append({"kind": "moved", "moved_m": matched.moved_m, **entry})
        if matched.disagrees:
            differences.append({"kind": "differs", "says": matched.disagrees, **entry})
    query = select(STOCK_DECISIONS).where(STOCK_DECISIONS.c.survey_id == newest.id)
    decided = {row.difference: row for row in connection.execute(query.order_by(STOCK_DECISIONS.c.id)).all()}
    for each in differences:
        each["key"] = f"{each['kind']} {each['name'] or each['bundle']}"
        row = decided.get(each["key"])
        each["decision"] = None
        if row is not None:
            each["decision"] = {"what": row.decision, "who": row.who, "at_ns": row.at_ns, "note": row.note}
    agree = [one.name for one in match.matched if one.name not in match.moved and not one.disagrees]
    return {"map_id": newest.map_id, "list": len(match.matched), "agree": agree, "differences": differences}


def _survey_of(row: Row[Any]) -> dict[str, Any]:
    names = (
        "map_id", "captured_from_ns", "captured_to_ns", "added_ns", "calibration_id", "is_simulated",
        "software_version",
    )  # fmt: skip
    return {name: getattr(row, name) for name in names}


def _bundles_of_lifts(connection: Connection) -> dict[int, list[int]]:
    of: dict[int, list[int]] = defaultdict(list)
    for row in connection.execute(select(LIFT_BUNDLES).order_by(LIFT_BUNDLES.c.id)).all():
        of[row.lift_id].append(row.bundle_id)
    return of


def _steps(
    connection: Connection, table: Any, owner: Any, numbers: Iterable[int]
) -> dict[int, list[dict[str, Any]]]:
    found: dict[int, list[dict[str, Any]]] = defaultdict(list)
    known = list(numbers)
    for first in range(0, len(known), IDS_PER_QUERY):
        part = owner.in_(known[first : first + IDS_PER_QUERY])
        for row in connection.execute(select(table).where(part).order_by(owner, table.c.step)):
            step = {"state": row.state, "at_ns": row.at_ns, "who": row.who, "note": row.note}
            found[getattr(row, owner.name)].append(step)
    return found
