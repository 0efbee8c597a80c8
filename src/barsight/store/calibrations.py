"""Record which calibration of a rig is valid when, and who approved it: a newer one ends the older one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from barsight.core.errors import ConfigError, InputError
from barsight.core.extras import extra
from barsight.store.audit import Entry
from barsight.store.history import expect_time, time_text
from barsight.store.tables import CALIBRATIONS, CRANES, RIGS, SURVEYS, VALIDITIES

with extra("store"):
    from sqlalchemy import Connection, Row, select

FIRST = "1"
"""Name of a crane or rig without a given name."""


@dataclass(frozen=True)
class ApprovedTime:
    """A period for which a calibration was approved.

    until_ns: its own end, or the beginning of the rig's next one; None if neither is known.
    """

    digest: str
    rig: str
    from_ns: int
    until_ns: int | None
    approved_by: str
    note: str | None
    at_ns: int

    def holds(self, clock_ns: int) -> bool:
        """Return True if the period includes a time."""
        return self.from_ns <= clock_ns and (self.until_ns is None or clock_ns < self.until_ns)


@dataclass(frozen=True)
class KnownCalibration:
    """A calibration with its rig and crane. times: periods of its approval, the oldest first."""

    digest: str
    rig: str
    crane: str
    times: tuple[ApprovedTime, ...]


def note_calibration(opened: Entry, digest: str, rig: str | None = None, crane: str | None = None) -> str:
    """Add a calibration, its rig and its crane if the store lacks them; return the rig's name.

    rig, crane: their names; by default those of this calibration, otherwise of the newest one. Raises
    InputError if the calibration belongs to another rig.
    """
    known = {row.digest: row.rig for row in _rows(opened.connection)}
    own = known.get(digest)
    if rig is not None and own is not None and rig != own:
        raise InputError(f"calibration {digest}", f"is of rig {own}, not {rig}", f"name rig {own}")
    name: str = rig or own or (list(known.values()) or [FIRST])[-1]
    _hang(opened, name, crane)
    if own is None:
        opened.add(CALIBRATIONS, digest=digest, rig=name, at_ns=opened.at_ns)
    return name


def _hang(opened: Entry, rig: str, crane: str | None) -> None:
    """Record on which crane a rig is mounted, if that is new."""
    hung = _cranes(opened.connection)
    wanted = crane or hung.get(rig) or (list(hung.values()) or [FIRST])[-1]
    if hung.get(rig) == wanted:
        return
    found = select(CRANES.c.id).where(CRANES.c.name == wanted)
    crane_id = opened.connection.execute(found).scalar()
    if crane_id is None:
        crane_id = opened.add(CRANES, name=wanted, at_ns=opened.at_ns)
    opened.add(RIGS, crane_id=crane_id, name=rig, at_ns=opened.at_ns)


def approve_calibration(
    opened: Entry, digest: str, from_ns: int, until_ns: int | None, note: str | None = None
) -> None:
    """Approve a known calibration for a period, in the name of the entry's author. Raises ConfigError.

    Once a calibration of a rig has been approved, lifts are offered only with approved ones.
    """
    query = select(CALIBRATIONS.c.id).where(CALIBRATIONS.c.digest == digest)
    number = opened.connection.execute(query).scalar()
    if number is None:
        raise ConfigError(f"the store knows no calibration {digest}")
    if until_ns is not None and expect_time(until_ns) <= from_ns:
        raise ConfigError(f"valid from {time_text(from_ns)} until {time_text(until_ns)}: that is no time")
    opened.add(
        VALIDITIES, calibration_id=number, from_ns=from_ns, until_ns=until_ns, approved_by=opened.who,
        note=note or None, at_ns=opened.at_ns,
    )  # fmt: skip


def find_calibration(connection: Connection, start: str) -> str:
    """Find a calibration's digest by its beginning, among known ones and those of surveys. Raises
    ConfigError.
    """
    surveyed = connection.execute(select(SURVEYS.c.calibration_id)).scalars()
    known = {row.digest for row in _rows(connection)} | set(surveyed)
    found = sorted(one for one in known if start and one.startswith(start))
    if len(found) != 1:
        problem = "names several calibrations" if found else "is neither a file nor a known calibration"
        raise ConfigError(f"{start}: {problem}; known are {', '.join(found or sorted(known)) or 'none'}")
    return str(found[0])


def list_calibrations(connection: Connection) -> tuple[KnownCalibration, ...]:
    """List the calibrations, in the order in which they became known."""
    cranes, times = _cranes(connection), _times(connection)
    return tuple(
        KnownCalibration(
            row.digest, row.rig, cranes[row.rig], tuple(one for one in times if one.digest == row.digest)
        )
        for row in _rows(connection)
    )


def why_invalid(connection: Connection, digest: str, clock_ns: int) -> str:
    """Return why a map's calibration isn't valid at a time; empty if it is, or if none of its rig's was ever
    approved.
    """
    times = _times(connection)
    rigs = {row.digest: row.rig for row in _rows(connection)}
    # A calibration unknown to the store, from a survey of an earlier schema, may belong to any rig.
    own = [one for one in times if digest not in rigs or one.rig == rigs[digest]]
    if not own or any(one.digest == digest and one.holds(clock_ns) for one in own):
        return ""
    mine = [one for one in own if one.digest == digest]
    if not mine:
        return f"calibration {digest} was never approved"
    last = mine[-1]
    if clock_ns < last.from_ns:
        return f"calibration {digest} is valid from {time_text(last.from_ns)} on only"
    newer = next((one for one in own if one.digest != digest and one.holds(clock_ns)), None)
    successor = "" if newer is None else f", when {newer.digest} took its place"
    until = "" if last.until_ns is None else time_text(last.until_ns)
    return f"calibration {digest} was valid until {until}{successor}; measure with one that is, or approve it"


def _times(connection: Connection) -> list[ApprovedTime]:
    """List the approved periods, each ended at the beginning of its rig's next one."""
    rows = connection.execute(
        select(VALIDITIES, CALIBRATIONS.c.digest, CALIBRATIONS.c.rig)
        .join(CALIBRATIONS)
        .order_by(CALIBRATIONS.c.rig, VALIDITIES.c.from_ns, VALIDITIES.c.id)
    ).all()
    times = []
    for place, row in enumerate(rows, start=1):
        until, after = row.until_ns, rows[place] if place < len(rows) else None
        if after is not None and after.rig == row.rig:
            until = after.from_ns if until is None else min(until, after.from_ns)
        times.append(
            ApprovedTime(row.digest, row.rig, row.from_ns, until, row.approved_by, row.note, row.at_ns)
        )
    return times


def _rows(connection: Connection) -> list[Row[Any]]:
    return list(connection.execute(select(CALIBRATIONS).order_by(CALIBRATIONS.c.id)).all())


def _cranes(connection: Connection) -> dict[str, str]:
    """Read the crane of each rig, in the order of mounting."""
    query = select(RIGS.c.name.label("rig"), CRANES.c.name).join(CRANES).order_by(RIGS.c.id)
    return {row.rig: row.name for row in connection.execute(query).all()}
