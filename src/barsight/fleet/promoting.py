"""Switch page and plant to a version's results, and revert the switch."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from barsight.core.errors import ConfigError, InputError, MeasurementError, OutputError
from barsight.core.extras import extra
from barsight.core.files import atomic_directory
from barsight.fleet.ledger import REMEDY, published_keys, result_note
from barsight.fleet.objects import Objects
from barsight.fleet.records import found_recording
from barsight.fleet.versions import FleetTask, Version
from barsight.store.adding import add_survey, read_survey
from barsight.store.audit import entry
from barsight.store.opening import Store
from barsight.store.promotion import promoted_version
from barsight.store.tables import FLEET_SURVEYS, PROMOTIONS, SURVEYS

with extra("store"):
    from sqlalchemy import select


def promote(
    store: Store,
    results: Objects,
    version: Version,
    tasks: list[FleetTask],
    folder: Path,
    by: str,
    advance: Callable[[int, int], None],
) -> int:
    """Copy a version's results into `folder`, add them to the store as surveys, and switch to them at once.

    They are invisible until the switch; if killed before it, the promotion can be repeated. Raises
    MeasurementError while a recording of the version is neither published nor parked. Returns the number of
    surveys.
    """
    done = published_keys(results)
    open_ones = [t for t in tasks if t.key not in done and results.read(f"parked/{t.key}.json") is None]
    if open_ones or not done & {task.key for task in tasks}:
        raise MeasurementError(
            f"version {version.name}: {len(open_ones)} recordings are not measured; run it to its end first"
        )
    chosen = [task for task in tasks if task.key in done]
    surveys = []
    for number, task in enumerate(chosen):
        out = folder / task.key[:32]
        if not out.is_dir():
            try:
                _fetch(results, task.key, out)
            except OutputError:
                if not out.is_dir():  # else another promotion has copied it in the meantime
                    raise
        surveys.append(replace(read_survey(out), recordings=(found_recording(task),)))
        advance(number + 1, len(chosen))
    for survey in sorted(surveys, key=lambda one: one.to_ns):
        map_id = survey.identity.map_id
        with entry(store, by, f"fleet survey {map_id} of version {version.name}") as opened:
            read = opened.connection
            mine = (FLEET_SURVEYS.c.version == version.name) & (FLEET_SURVEYS.c.map_id == map_id)
            if read.execute(select(FLEET_SURVEYS.c.id).where(mine)).first() is None:
                is_there = read.execute(select(SURVEYS.c.id).where(SURVEYS.c.map_id == map_id)).first()
                is_others = read.execute(
                    select(FLEET_SURVEYS.c.is_own).where(FLEET_SURVEYS.c.map_id == map_id)
                ).first()
                is_own = bool(is_others.is_own) if is_others else is_there is None
                opened.add(FLEET_SURVEYS, version=version.name, map_id=map_id, is_own=is_own)
        # An archive covers one yard; its rigs and mountings are recalibrated over the years.
        add_survey(store, survey, by, same_yard=True, version=version.name)
    _switch(store, version.name, by, f"promote fleet version {version.name}")
    return len(surveys)


def take_back(store: Store, by: str) -> str:
    """Switch back to the version promoted before, and return its name; empty for none.

    Raises ConfigError if nothing is promoted.
    """
    with store.reading() as connection:
        now = promoted_version(connection)
        rows = connection.execute(select(PROMOTIONS.c.version).order_by(PROMOTIONS.c.id)).scalars()
        stack: list[str] = [""]
        for name in rows:  # a switch to the version below the top reverted the top
            if len(stack) > 1 and stack[-2] == name:
                stack.pop()
            elif stack[-1] != name:
                stack.append(name)
    if not now:
        raise ConfigError("no version is promoted: there is nothing to take back")
    before = stack[-2] if len(stack) > 1 else ""
    _switch(store, before, by, f"take back fleet version {now}")
    return before


def _switch(store: Store, name: str, by: str, what: str) -> None:
    with entry(store, by, what) as opened:
        if promoted_version(opened.connection) != name:
            opened.add(PROMOTIONS, version=name, who=by, at_ns=opened.at_ns)


def _fetch(results: Objects, key: str, out: Path) -> None:
    note = result_note(results, key)
    if note is None:
        raise InputError(f"{results.url}/results/{key}/result.json", "is gone", "run the version again")
    with atomic_directory(out) as staging:
        for name, stated in note["files"].items():
            path, digest, size = f"files/{key}/{note['token']}/{name}", hashlib.sha256(), 0
            with (staging / Path(name).name).open("wb") as stream:
                for part in results.chunks(path):
                    size += len(part)
                    if size > stated["bytes"]:
                        break
                    digest.update(part)
                    stream.write(part)
            if size != stated["bytes"] or digest.hexdigest() != stated["sha256"]:
                raise InputError(f"{results.url}/{path}", "was changed after it was published", REMEDY)
