"""Record which recordings there are, which surveys were measured from them, and why one must be kept."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from barsight.core.errors import ConfigError
from barsight.core.extras import extra
from barsight.core.json_values import json_digest
from barsight.core.reading.bounded_reading import read_bytes
from barsight.recording.writers.retention import PROTECTED
from barsight.store.audit import Entry
from barsight.store.states import recording_state, step_recording
from barsight.store.tables import RECORDING_STATES, RECORDINGS, SURVEY_RECORDINGS, SURVEYS

with extra("store"):
    from sqlalchemy import Connection, select

_MAX_WHY_BYTES = 4096


@dataclass(frozen=True)
class FoundRecording:
    """A recording. key: its path or URL. digest: of its files' digests.

    kept_because: why its folder is protected from deletion; None if it isn't.
    """

    key: str
    digest: str
    kept_because: str | None = None


@dataclass(frozen=True)
class KnownRecording:
    """A recording in the store.

    state: its last state, set at at_ns by `who`; note: why it is kept, or the survey. surveys: maps measured
    from it.
    """

    key: str
    digest: str
    rig: str
    state: str
    at_ns: int
    who: str
    note: str | None
    surveys: tuple[str, ...]


def recordings_of(summary: dict[str, Any]) -> tuple[FoundRecording, ...]:
    """Find the recordings named in result.json whose files have digests there."""
    whole = {"recording": summary.get("recording"), "inputs": (summary.get("hashes") or {}).get("inputs")}
    found = {}
    for one in summary.get("passes") or [whole]:
        path = (one["recording"] or {}).get("path")
        if path and one["inputs"]:
            digest = json_digest(one["inputs"])
            found[digest] = FoundRecording(path, digest, _protection(Path(path)))
    return tuple(found.values())


def _protection(folder: Path) -> str | None:
    file = folder / PROTECTED
    if not file.is_file():
        return None
    why = read_bytes(file, _MAX_WHY_BYTES).decode("utf-8", "replace").strip()
    return why or f"its folder has a file {PROTECTED}"


def note_recordings(
    opened: Entry, found: tuple[FoundRecording, ...], rig: str, survey: tuple[int, str] | None
) -> None:
    """Add missing recordings, and that a survey (its id and map) was measured from them."""
    for one in found:
        known = select(RECORDINGS.c.id).where(RECORDINGS.c.digest == one.digest)
        number = opened.connection.execute(known).scalar()
        if number is None:
            number = opened.add(RECORDINGS, digest=one.digest, key=one.key, rig=rig, at_ns=opened.at_ns)
        state = recording_state(opened.connection, number)
        if survey is None:
            if state is None:
                step_recording(opened, number, "archived")
            continue
        opened.add(SURVEY_RECORDINGS, survey_id=survey[0], recording_id=number)
        if state in (None, "archived"):
            step_recording(opened, number, "measured", f"survey {survey[1]}")
        if one.kept_because is not None and state != "kept":
            step_recording(opened, number, "kept", one.kept_because)


def keep_recording(opened: Entry, name: str, why: str) -> str:
    """Record why a recording must not be deleted, and return its key; a local folder is also protected.

    name: its key, or the beginning of its digest. Raises ConfigError.
    """
    if not why.strip():
        raise ConfigError("say why it is kept")
    number, key = _find(opened.connection, name)
    if recording_state(opened.connection, number) == "kept":
        raise ConfigError(f"{key}: is kept already; --release takes that back first")
    step_recording(opened, number, "kept", why)
    if Path(key).is_dir():
        (Path(key) / PROTECTED).write_text(f"{why}\n", encoding="utf-8")
    return key


def release_recording(opened: Entry, name: str, why: str) -> str:
    """Remove the protection, and return the recording's key. Raises ConfigError if it isn't kept."""
    number, key = _find(opened.connection, name)
    if recording_state(opened.connection, number) != "kept":
        raise ConfigError(
            f"{key}: isn't kept, so there is nothing to release; barsight store list shows which are kept"
        )
    step_recording(opened, number, "released", why or None)
    (Path(key) / PROTECTED).unlink(missing_ok=True)
    return key


def list_recordings(connection: Connection) -> tuple[KnownRecording, ...]:
    """List the recordings, in the order in which they became known."""
    last = {}
    for row in connection.execute(select(RECORDING_STATES).order_by(RECORDING_STATES.c.step)).all():
        last[row.recording_id] = row
    maps: dict[int, list[str]] = {}
    query = select(SURVEY_RECORDINGS.c.recording_id, SURVEYS.c.map_id).join(SURVEYS)
    for row in connection.execute(query.order_by(SURVEY_RECORDINGS.c.id)).all():
        maps.setdefault(row.recording_id, []).append(row.map_id)
    rows = connection.execute(select(RECORDINGS).order_by(RECORDINGS.c.id)).all()
    return tuple(
        KnownRecording(
            row.key, row.digest, row.rig, last[row.id].state, last[row.id].at_ns, last[row.id].who,
            last[row.id].note, tuple(maps.get(row.id, ())),
        )
        for row in rows
    )  # fmt: skip


def _find(connection: Connection, name: str) -> tuple[int, str]:
    rows = connection.execute(select(RECORDINGS).order_by(RECORDINGS.c.id)).all()
    found = [row for row in rows if row.key in (name, str(Path(name).resolve()))] or [
        row for row in rows if len(name) >= 4 and row.digest.startswith(name)
    ]
    if len(found) != 1:
        problem = "names several recordings" if found else "is no recording that the store knows"
        raise ConfigError(f"{name}: {problem}; barsight store list shows them")
    return found[0].id, found[0].key
