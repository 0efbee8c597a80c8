"""Drive a version's tasks to completion: submit what is left, check the results, repeat."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from barsight.core.errors import InputError
from barsight.fleet.cluster import AHEAD, run_all
from barsight.fleet.ledger import PARKED, parked_keys, published_keys, result_note, running_keys
from barsight.fleet.objects import Objects
from barsight.fleet.records import note_results, noted_keys
from barsight.fleet.task import TaskSettings, run_task
from barsight.fleet.versions import FleetTask
from barsight.fleet.window import RunWindow
from barsight.store.opening import Store

POLL_S = 2.0
_ROWS = 200
"""Number of rows written in one transaction."""


@dataclass(frozen=True)
class FleetCounts:
    """Numbers of keys by state."""

    published: int
    parked: int
    running: int
    left: int


def count_states(results: Objects, tasks: list[FleetTask]) -> FleetCounts:
    """Count the tasks that are published, parked, running, and left."""
    keys = {task.key for task in tasks}
    published, parked = published_keys(results) & keys, parked_keys(results) & keys
    open_keys = keys - published - parked
    running = running_keys(results, open_keys)
    return FleetCounts(len(published), len(parked - published), len(running), len(open_keys - running))


def drive(
    client: Any,
    tasks: list[FleetTask],
    settings: TaskSettings,
    store: Store,
    results: Objects,
    window: RunWindow,
    advance: Callable[[int, int], None],
    run: Callable[[Any, Any], str] = run_task,
) -> None:
    """Run all tasks missing in the results until each is published or parked.

    advance: called with the number of tasks done and in total. Rows that workers could not write are written
    at the end of each round. Tasks claimed by another driver's workers are waited for.
    """
    wanted = {task.key for task in tasks}
    while True:
        ended = (published_keys(results) | parked_keys(results)) & wanted
        note_missing(store, results, settings.by, wanted)
        advance(len(ended), len(tasks))
        left = [task for task in tasks if task.key not in ended]
        if not left:
            return
        if not window.is_open():
            time.sleep(POLL_S)
            continue
        busy = running_keys(results, {task.key for task in left})
        free = [task for task in left if task.key not in busy]
        done = len(ended)
        # Tasks queued at the workers would start after the window has closed.
        ahead = 1 if window.is_limited else AHEAD
        for key in run_all(client, run, free, settings, window.is_open, ahead):
            if key is not None:
                done += 1
                advance(min(done, len(tasks)), len(tasks))
        if not free:
            time.sleep(POLL_S)


def open_tasks(store: Store, results: Objects, tasks: list[FleetTask], by: str) -> list[FleetTask]:
    """List the tasks that are neither published nor parked; write the missing rows of the others."""
    note_missing(store, results, by, {task.key for task in tasks})
    ended = published_keys(results) | parked_keys(results)
    return [task for task in tasks if task.key not in ended]


def note_missing(store: Store, results: Objects, by: str, wanted: set[str]) -> int:
    """Write the rows of published tasks missing in the store; return their number."""
    with store.reading() as connection:
        known = noted_keys(connection)
    missing = sorted((published_keys(results) & wanted) - known)
    for first in range(0, len(missing), _ROWS):
        notes = ((key, result_note(results, key)) for key in missing[first : first + _ROWS])
        note_results(store, {key: note for key, note in notes if note is not None}, by)
    return len(missing)


def parked_reasons(results: Objects, tasks: list[FleetTask]) -> list[tuple[FleetTask, str]]:
    """List the parked tasks, each with its reason."""
    keys = parked_keys(results)
    parked = []
    for task in tasks:
        if task.key in keys:
            note = results.read_json(f"parked/{task.key}.json", PARKED)
            if note is None:
                raise InputError(
                    f"{results.url}/parked/{task.key}.json", "is gone", "ask for the status again"
                )
            parked.append((task, str(note["reason"])))
    return parked
