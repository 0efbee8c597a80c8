"""Keep a fleet's facts in the store: versions, tasks, results; each addition is in the audit log."""

from __future__ import annotations

import json
import time
from collections.abc import Iterable
from dataclasses import asdict
from typing import Any

from barsight.core.errors import ConfigError
from barsight.core.extras import extra
from barsight.fleet.versions import FleetTask, Version
from barsight.store.audit import entry
from barsight.store.opening import Store, open_store
from barsight.store.recordings import FoundRecording, note_recordings
from barsight.store.tables import FLEET_PLACES, FLEET_RESULTS, FLEET_TASKS, FLEET_VERSIONS

with extra("store"):
    from sqlalchemy import Connection, select


def note_plan(store: Store, tasks: Iterable[FleetTask], by: str) -> int:
    """Add a version, its tasks that are missing in the store, and their current places.

    Returns the number of new tasks.
    """
    planned = {task.key: task for task in tasks}
    with entry(store, by, f"fleet plan of {len(planned)} recordings") as opened:
        known = set(opened.connection.execute(select(FLEET_TASKS.c.key)).scalars())
        names = set(opened.connection.execute(select(FLEET_VERSIONS.c.name)).scalars())
        for version in {task.version for task in planned.values() if task.version.name not in names}:
            opened.add(FLEET_VERSIONS, **asdict(version), at_ns=opened.at_ns)
        note_recordings(opened, tuple(found_recording(task) for task in planned.values()), "", None)
        places = _places(opened.connection)
        for key, task in planned.items():
            if key not in known:
                opened.add(
                    FLEET_TASKS, key=key, version=task.version.name, archive=task.archive,
                    recording=task.name, passes=json.dumps(task.passes), bytes=task.size, pairs=task.pairs,
                    at_ns=opened.at_ns,
                )  # fmt: skip
            place = {"manifest": task.manifest, "archive": task.archive, "recording": task.name}
            if places.get(key) != tuple(place.values()):
                opened.add(FLEET_PLACES, key=key, **place, at_ns=opened.at_ns)
    return len(planned.keys() - known)


def found_recording(task: FleetTask) -> FoundRecording:
    """Name a task's recording by its place in the archive and its manifest."""
    return FoundRecording(f"{task.archive}/{task.name}".rstrip("/"), task.manifest)


def note_result(url: str, key: str, content: dict[str, Any], by: str) -> None:
    """Add a published task's row from a worker, if it is missing."""
    with open_store(url) as store:
        note_results(store, {key: content}, by)


def note_results(store: Store, contents: dict[str, dict[str, Any]], by: str) -> None:
    """Add the missing rows of published tasks. contents: their result.json."""
    with entry(store, by, f"fleet results of {len(contents)} recordings") as opened:
        known = noted_keys(opened.connection)
        for key, content in contents.items():
            if key not in known:
                opened.add(
                    FLEET_RESULTS, key=key, measured_s=content["measured_s"], whole_s=content["whole_s"],
                    peak_bytes=content["peak_bytes"], at_ns=time.time_ns(),
                    result_bytes=sum(file["bytes"] for file in content["files"].values()),
                )  # fmt: skip


def noted_keys(connection: Connection) -> set[str]:
    """List the keys that have a result row."""
    return set(connection.execute(select(FLEET_RESULTS.c.key)).scalars())


def read_versions(connection: Connection) -> list[Version]:
    """List the versions in the order in which they were first planned."""
    rows = connection.execute(select(FLEET_VERSIONS).order_by(FLEET_VERSIONS.c.id)).all()
    return [Version(r.name, r.configuration, r.calibration, r.magnet, r.software, r.rig) for r in rows]


def find_version(connection: Connection, name: str | None) -> Version:
    """Find a version by the beginning of its name; the newest if None. Raises ConfigError."""
    versions = read_versions(connection)
    if not versions:
        raise ConfigError("the store knows no version of a fleet; barsight fleet plan makes one")
    found = [one for one in versions if name is None or one.name.startswith(name)]
    if name is None:
        return found[-1]
    if len(found) != 1:
        problem = "names several versions" if found else "names no version that is planned"
        raise ConfigError(f"{name}: {problem}; known are {', '.join(one.name for one in found or versions)}")
    return found[0]


def read_tasks(connection: Connection, version: Version) -> list[FleetTask]:
    """List a version's tasks in the order of the plan, each at its last known place."""
    chosen = select(FLEET_TASKS).where(FLEET_TASKS.c.version == version.name).order_by(FLEET_TASKS.c.id)
    places = _places(connection)
    tasks = []
    for row in connection.execute(chosen).all():
        manifest, archive, name = places.get(row.key, ("", row.archive, row.recording))
        passes = tuple(json.loads(row.passes))
        tasks.append(FleetTask(row.key, name, passes, version, manifest, archive, row.bytes, row.pairs))
    return tasks


def _places(connection: Connection) -> dict[str, tuple[str, str, str]]:
    """Read the manifest of each key's recording, the archive where it was last found, and its name there."""
    rows = connection.execute(select(FLEET_PLACES).order_by(FLEET_PLACES.c.id)).all()
    return {row.key: (row.manifest, row.archive, row.recording) for row in rows}


def seconds_by_size(connection: Connection) -> list[tuple[int, int, float, int]]:
    """List bytes, pairs, seconds and result bytes of the newest thousand completed tasks."""
    joined = (
        select(
            FLEET_TASKS.c.bytes, FLEET_TASKS.c.pairs, FLEET_RESULTS.c.whole_s, FLEET_RESULTS.c.result_bytes
        )
        .join(FLEET_RESULTS, FLEET_RESULTS.c.key == FLEET_TASKS.c.key)
        .order_by(FLEET_RESULTS.c.id.desc())
        .limit(1000)
    )
    return [(r[0], r[1], r[2], r[3]) for r in connection.execute(joined).all()]
