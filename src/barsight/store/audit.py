"""Log each addition to the store in a chain of digests, and verify the chain and the rows that it covers."""

from __future__ import annotations

import getpass
import hashlib
import json
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from barsight.core.errors import Failed
from barsight.core.extras import extra
from barsight.store.opening import Store
from barsight.store.tables import AUDIT, METADATA

with extra("store"):
    from sqlalchemy import Connection, Table, func, insert, select

_FIRST = "0" * 64
IDS_PER_QUERY = 500
"""Maximum number of ids in one query, as databases limit the parameters of a statement."""


@dataclass(frozen=True)
class Entry:
    """An addition in progress. at_ns: when it happened. rows: ids of the rows added, by table."""

    connection: Connection
    who: str
    at_ns: int
    rows: dict[str, list[int]] = field(default_factory=dict)

    def add(self, table: Table, **values: Any) -> int:
        """Insert a row and return its id."""
        key = self.connection.execute(insert(table).values(**values)).inserted_primary_key
        assert key is not None
        number = int(key[0])
        self.rows.setdefault(table.name, []).append(number)
        return number


@dataclass(frozen=True)
class AuditChain:
    """A valid chain. entries: number of entries. digest: of the last entry; if it is also kept elsewhere, a
    missing end of the chain can be detected later.
    """

    entries: int
    digest: str


@contextmanager
def entry(store: Store, who: str, what: str, at_ns: int | None = None) -> Iterator[Entry]:
    """Begin one addition: its rows and its line in the audit log are all committed together, or none.

    at_ns: when it happened; None for now.
    """
    with store.writing() as connection:
        opened = Entry(connection, who, time.time_ns() if at_ns is None else at_ns)
        yield opened
        if opened.rows:
            _append(opened, what)


def _append(opened: Entry, what: str) -> None:
    last = opened.connection.execute(select(AUDIT).order_by(AUDIT.c.id.desc()).limit(1)).mappings().first()
    content = {"rows": opened.rows, "rows_sha256": _rows_digest(opened.connection, opened.rows)}
    row = {
        "id": 1 if last is None else last["id"] + 1,
        "at_ns": opened.at_ns,
        "who": opened.who,
        "what": what,
        "content": _canonical(content),
        "previous": _FIRST if last is None else last["digest"],
    }
    opened.connection.execute(insert(AUDIT).values(**row, digest=_digest(row)))


def newest_entry(connection: Connection) -> tuple[int, str]:
    """Return id and digest of the newest row of the log, (0, "") if there is none."""
    row = connection.execute(select(AUDIT.c.id, AUDIT.c.digest).order_by(AUDIT.c.id.desc()).limit(1)).first()
    return (0, "") if row is None else (int(row.id), str(row.digest))


def has_entry(connection: Connection, seen: tuple[int, str]) -> bool:
    """Check that the log still has a row, given by id and digest; (0, "") it always has."""
    digest = connection.execute(select(AUDIT.c.digest).where(AUDIT.c.id == seen[0])).scalar()
    return seen == (0, "") or digest == seen[1]


def verify_chain(connection: Connection) -> AuditChain | Failed:
    """Verify the log from its first row: each digest, the link to the row before, and the rows it covers.

    Fails with the first invalid row, or if a table has rows that no row of the log covers.
    """
    previous, count = _FIRST, 0
    covered: dict[str, set[int]] = {}
    for row in connection.execute(select(AUDIT).order_by(AUDIT.c.id)).mappings().all():
        count += 1
        problem = _problem(connection, dict(row), count, previous, covered)
        if problem:
            return Failed("audit", f"audit row {count} does not hold: {problem}")
        previous = row["digest"]
    for name, table in METADATA.tables.items():
        found = connection.execute(select(func.count()).select_from(table)).scalar_one()
        if table is not AUDIT and found != len(covered.get(name, ())):
            counts = f"{found} rows, the audit log covers {len(covered.get(name, ()))}"
            return Failed("audit", f"table {name} has {counts}")
    return AuditChain(count, previous)


def _problem(
    connection: Connection, row: dict[str, Any], count: int, previous: str, covered: dict[str, set[int]]
) -> str:
    """Return what is wrong with a row of the log, empty if it is valid. covered: receives its rows' ids."""
    digest = row.pop("digest")
    if row["id"] != count:
        return f"it is missing, row {row['id']} follows"
    if row["previous"] != previous:
        return "it does not follow from the row before"
    if digest != _digest(row):
        return "it was changed after it was written"
    content = json.loads(row["content"])
    if content["rows_sha256"] != _rows_digest(connection, content["rows"]):
        tables = ", ".join(content["rows"])
        return f"what it added on {row['what']} was changed or removed (tables {tables})"
    for name, ids in content["rows"].items():
        covered.setdefault(name, set()).update(ids)
    return ""


def _rows_digest(connection: Connection, rows: dict[str, list[int]]) -> str:
    """Compute SHA-256 over rows as stored in the database."""
    found: list[Any] = []
    for name in sorted(rows):
        table, ids = METADATA.tables[name], sorted(rows[name])
        for first in range(0, len(ids), IDS_PER_QUERY):
            part = table.c.id.in_(ids[first : first + IDS_PER_QUERY])
            found += [
                [name, *_plain(row)]
                for row in connection.execute(select(table).where(part).order_by(table.c.id)).all()
            ]
    return hashlib.sha256(_canonical(found).encode()).hexdigest()


def _plain(row: Any) -> list[Any]:
    return [hashlib.sha256(value).hexdigest() if isinstance(value, bytes) else value for value in row]


def _digest(row: dict[str, Any]) -> str:
    """Compute SHA-256 of the previous digest and a row's canonical JSON."""
    return hashlib.sha256((row["previous"] + _canonical(row)).encode()).hexdigest()


def _canonical(value: Any) -> str:
    """Write JSON with sorted keys and without spaces, so that equal values give equal text."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)


def user_name() -> str:
    """Name the computer's user for the audit log."""
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # in a container the user may have no name
        return f"uid {os.getuid()}"
