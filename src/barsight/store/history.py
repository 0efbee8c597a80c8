"""Read from the store what was known of each bundle at a time, what changed, and the outcome of the lifts."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from barsight.core.errors import ConfigError
from barsight.core.extras import extra
from barsight.core.stamps import NS_PER_S
from barsight.store.audit import IDS_PER_QUERY
from barsight.store.promotion import counts
from barsight.store.states import newest_steps
from barsight.store.tables import ABSENCES, LIFT_BUNDLES, LIFT_STATES, LIFTS, SIGHTINGS, SURVEY_FACTS, SURVEYS
from barsight.yard.axes import turn_between
from barsight.yard.inventory.bundle_file import bundle_of
from barsight.yard.inventory.matching import moved_bundles
from barsight.yard.lifting.validity import is_ahead
from barsight.yard.types import Bundle

with extra("store"):
    from sqlalchemy import Connection, Row, Table, and_, func, select, true, tuple_
    from sqlalchemy.sql.elements import ColumnElement


@dataclass(frozen=True, eq=False)
class BundleSighting:
    """A bundle as one survey saw it. record: its JSON of bundles.json, without the bars' axes."""

    bundle_id: int
    survey_id: int
    map_id: str
    seen_ns: int
    change: str
    stock_name: str | None
    record: dict[str, Any]

    @property
    def identity(self) -> str:
        """Return the bundle's name in the store."""
        return identity_name(self.bundle_id)

    @property
    def bundle(self) -> Bundle:
        """Return the bundle in the form that the stages of the yard use."""
        return bundle_of(self.record)


@dataclass(frozen=True)
class Absence:
    """A survey that looked for a bundle and did not see it. kind: `gone`, `covered` or `not-found`."""

    bundle_id: int
    looked_ns: int
    kind: str
    reason: str


@dataclass(frozen=True, eq=False)
class PresentBundle:
    """A bundle in the yard at a time: its newest sighting, and any later survey that contradicts it."""

    sighting: BundleSighting
    doubt: Absence | None


def identity_name(bundle_id: int) -> str:
    """Name a bundle for people and files."""
    return f"B{bundle_id}"


@dataclass(frozen=True)
class SurveyRow:
    """A survey, and its numbers of bundles `same`, `moved`, `added`, `found`, `gone` ... when added."""

    map_id: str
    captured_from_ns: int
    captured_to_ns: int
    is_simulated: bool
    folder: str
    changes: dict[str, int]


def list_surveys(connection: Connection) -> tuple[SurveyRow, ...]:
    """List the surveys in time order."""
    counts: dict[int, Counter[str]] = {}
    for table, kind in ((SIGHTINGS, SIGHTINGS.c.change), (ABSENCES, ABSENCES.c.kind)):
        grouped = select(table.c.survey_id, kind, func.count()).group_by(table.c.survey_id, kind)
        for survey_id, name, count in connection.execute(grouped).all():
            counts.setdefault(survey_id, Counter())[name] += count
    rows = connection.execute(select(*SURVEY_FACTS).order_by(SURVEYS.c.captured_to_ns, SURVEYS.c.id)).all()
    return tuple(
        SurveyRow(
            r.map_id, r.captured_from_ns, r.captured_to_ns, r.is_simulated, r.folder,
            dict(counts.get(r.id, {})),
        )
        for r in rows
    )  # fmt: skip


def survey_folder(connection: Connection, map_id: str) -> Path:
    """Find the result folder of a survey by its map."""
    query = select(SURVEYS.c.folder).where(SURVEYS.c.map_id == map_id)
    return Path(connection.execute(query).scalar_one())


def parse_time(text: str) -> int:
    """Read a time in ns from ISO 8601 with a zone, or from integer ns. Raises ConfigError."""
    if text.isascii() and text.isdigit():
        return expect_time(int(text))
    try:
        parsed = datetime.fromisoformat(text)
    except ValueError:
        parsed = None
    if parsed is None or parsed.tzinfo is None:
        raise ConfigError(f"{text!r} is not a time; write it like 2026-11-23T14:00:00Z, with the zone")
    return expect_time((parsed - datetime.fromtimestamp(0, UTC)) // timedelta(microseconds=1) * 1000)


def expect_time(stamp_ns: int) -> int:
    """Return a stamp that a store can hold. Raises ConfigError."""
    if not 0 <= stamp_ns < 2**63:
        raise ConfigError("a time lies from 1970 to 2262; to name no end leave it out")
    return stamp_ns


def time_text(stamp_ns: int) -> str:
    """Format a stamp in UTC, to the second."""
    return datetime.fromtimestamp(stamp_ns // NS_PER_S, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


def why_ahead(captured_to_ns: int, clock_ns: int) -> str:
    """Return why surveys made now count as older than one with these frames; empty if they don't."""
    if not is_ahead(captured_to_ns, clock_ns):
        return ""
    until = time_text(captured_to_ns)
    ends = f"the newest survey's frames, until {until},"
    return f"{ends} are ahead of this clock: surveys till then count as older"


def newest_sightings(
    connection: Connection, until_ns: int | None, version: str | None = None
) -> dict[int, BundleSighting]:
    """Find each bundle's newest sighting up to a time (None for no limit). version: as if it were
    promoted.
    """
    condition = true() if until_ns is None else SURVEYS.c.captured_to_ns <= until_ns
    return _sightings(connection, and_(condition, counts(version)), is_newest=True)


def next_sightings(
    connection: Connection, after_ns: int, version: str | None = None
) -> dict[int, BundleSighting]:
    """Find each bundle's first sighting after a time. version: as if it were promoted."""
    condition = and_(SURVEYS.c.captured_to_ns > after_ns, counts(version))
    return _sightings(connection, condition, is_newest=False)


def newest_absences(
    connection: Connection, until_ns: int | None, version: str | None = None
) -> dict[int, Absence]:
    """Find each bundle's newest absence from a survey up to a time. version: as if it were promoted."""
    condition = true() if until_ns is None else SURVEYS.c.captured_to_ns <= until_ns
    rows = _first_of_each(connection, ABSENCES, and_(condition, counts(version)), is_newest=True)
    return {r.bundle_id: Absence(r.bundle_id, r.captured_to_ns, r.kind, r.reason) for r in rows}


def present_yard(connection: Connection, at_ns: int | None = None) -> tuple[PresentBundle, ...]:
    """List the bundles in the yard at a time (None for now), in the order of their names.

    A bundle found gone by a survey is no longer there; one that was covered, or not found in its place, is
    still there, with that doubt.
    """
    absences = newest_absences(connection, at_ns)
    present = []
    for number, sighting in sorted(newest_sightings(connection, at_ns).items()):
        doubt = absences.get(number)
        if doubt is not None and doubt.looked_ns < sighting.seen_ns:
            doubt = None
        if doubt is None or doubt.kind != "gone":
            present.append(PresentBundle(sighting, doubt))
    return tuple(present)


def yard_changes(connection: Connection, before_ns: int, after_ns: int) -> list[dict[str, Any]]:
    """List the changes between two times: `came`, `went`, `moved`; unchanged bundles are left out."""
    before = {one.sighting.bundle_id: one.sighting for one in present_yard(connection, before_ns)}
    after = {one.sighting.bundle_id: one.sighting for one in present_yard(connection, after_ns)}
    both = sorted(before.keys() & after.keys())
    moved = moved_bundles([before[n].bundle for n in both], [after[n].bundle for n in both])
    changes = []
    for number in sorted(
        {*before, *after} - {n for n, is_moved in zip(both, moved, strict=True) if not is_moved}
    ):
        old, new = before.get(number), after.get(number)
        kind = "went" if new is None else "came" if old is None else "moved"
        changes.append(
            {
                "identity": identity_name(number), "what": kind,
                "from_m": None if old is None else old.record["axis_centre_m"],
                "to_m": None if new is None else new.record["axis_centre_m"],
                "from_ends_m": None if old is None else old.record["ends_m"],
                "to_ends_m": None if new is None else new.record["ends_m"],
                "width_m": [one.record["width_m"] for one in (old, new) if one is not None][-1],
            }
        )  # fmt: skip
    return changes


def yard_records(present: tuple[PresentBundle, ...], now_ns: int) -> list[dict[str, Any]]:
    """Build each bundle's record: as in bundles.json, with identity, survey, age and doubt."""
    return [
        {
            "identity": each.sighting.identity,
            "map_id": each.sighting.map_id,
            "seen_ns": each.sighting.seen_ns,
            "age_s": (now_ns - each.sighting.seen_ns) / NS_PER_S,
            "stock_name": each.sighting.stock_name,
            "doubt": None if each.doubt is None else {"code": each.doubt.kind, "reason": each.doubt.reason},
            "bundle": each.sighting.record,
        }
        for each in present
    ]


def _sightings(
    connection: Connection, condition: ColumnElement[bool], *, is_newest: bool
) -> dict[int, BundleSighting]:
    rows = _first_of_each(connection, SIGHTINGS, condition, is_newest=is_newest)
    return {
        r.bundle_id: BundleSighting(
            r.bundle_id, r.survey_id, r.map_id, r.captured_to_ns, r.change, r.stock_name, json.loads(r.record)
        )
        for r in rows
    }


def _first_of_each(
    connection: Connection, table: Table, condition: ColumnElement[bool], *, is_newest: bool
) -> Iterable[Row[Any]]:
    """Find the newest row of each bundle by its survey's time, or the oldest.

    Only the index of surveys and bundles is scanned: all rows with their records are many times as much.
    """
    surveys: dict[int, list[int]] = {}
    chosen = select(SURVEYS.c.id, SURVEYS.c.captured_to_ns).where(condition)
    for survey_id, captured_ns in connection.execute(chosen).all():
        surveys.setdefault(captured_ns, []).append(survey_id)
    times = chosen.subquery()
    of_bundle = (func.max if is_newest else func.min)(times.c.captured_to_ns)
    number = table.c.bundle_id + 0  # else SQLite follows the bundles' own index, from row to row
    joined = times.join(table, table.c.survey_id == times.c.id)
    newest = select(number, of_bundle).select_from(joined).group_by(number)
    keys = [(one, bundle) for bundle, at in connection.execute(newest).all() for one in surveys[at]]
    rows: dict[int, Row[Any]] = {}
    for first in range(0, len(keys), IDS_PER_QUERY):
        key = tuple_(table.c.survey_id, table.c.bundle_id).in_(keys[first : first + IDS_PER_QUERY])
        found = select(table, SURVEYS.c.map_id, SURVEYS.c.captured_to_ns).join(SURVEYS).where(key)
        for row in connection.execute(found).all():
            known = rows.get(row.bundle_id)
            if known is None or (row.survey_id > known.survey_id) is is_newest:
                rows[row.bundle_id] = row
    return rows.values()


@dataclass(frozen=True)
class ExecutedLift:
    """A lift that took a bundle. set_down: its JSON in lifts.json. state: `executed` or later."""

    lift_id: int
    bundle_id: int
    executed_ns: int
    state: str
    set_down: dict[str, float] | None

    def laid(self, bundle: Bundle) -> Bundle | None:
        """Return the bundle at the place where it was set down; None if that is unknown."""
        if self.set_down is None:
            return None
        to = self.set_down
        yaw_rad = turn_between(0.0, math.radians(to["yaw_deg"]))
        up_m = to["z_m"] - bundle.bottom_z_m
        centre = np.array([to["x_m"], to["y_m"], bundle.centre_m[2] + up_m])
        return replace(bundle, centre_m=centre, yaw_rad=yaw_rad, pitch_rad=0.0, top_z_m=bundle.top_z_m + up_m)


def executed_lifts(connection: Connection) -> tuple[ExecutedLift, ...]:
    """List the lifts that took a single bundle, each with its last state, in the order of their ids."""
    newest = newest_steps(LIFT_STATES, "lift")
    done = LIFT_STATES.alias("done")
    last = LIFT_STATES.alias("last")
    alone = (
        select(LIFT_BUNDLES.c.lift_id, func.min(LIFT_BUNDLES.c.bundle_id).label("bundle_id"))
        .group_by(LIFT_BUNDLES.c.lift_id)
        .having(func.count() == 1)
        .subquery()
    )
    rows = connection.execute(
        select(LIFTS.c.id, alone.c.bundle_id, done.c.at_ns, last.c.state, LIFTS.c.record)
        .join(done, (done.c.lift_id == LIFTS.c.id) & (done.c.state == "executed"))
        .join(newest, newest.c.lift_id == LIFTS.c.id)
        .join(last, (last.c.lift_id == LIFTS.c.id) & (last.c.step == newest.c.step))
        .join(alone, alone.c.lift_id == LIFTS.c.id)
        .order_by(LIFTS.c.id)
    ).all()
    return tuple(
        ExecutedLift(r.id, r.bundle_id, r.at_ns, r.state, json.loads(r.record)["set_down"]) for r in rows
    )
