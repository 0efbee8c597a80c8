"""Plan an archive: a task for each recording, and an estimate of the remaining hours and gigabytes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import inf
from statistics import median

from barsight.core.errors import InputError
from barsight.core.settings.values import expect_ranges
from barsight.fleet.archive import find_recordings, manifest_digest
from barsight.fleet.objects import Objects, UnreachableError
from barsight.fleet.versions import FleetTask, Version

FIRST_S, PER_PAIR_S, PER_BYTE_S, RESULT_BYTES = 8.0, 1.5, 1e-6, 15_000_000
"""Rough rates on two cores, for an archive of which nothing has been measured yet: seconds per recording, per
pair and per byte, and bytes per result.
"""


@dataclass(frozen=True)
class WorkEstimate:
    """Remaining work: seconds of one worker, bytes to fetch and to write. known: number of tasks used."""

    seconds: float
    fetched_bytes: int
    written_bytes: int
    known: int


def plan_tasks(
    archive: Objects,
    results: Objects,
    version: Version,
    limit: int | None,
    advance: Callable[[int, int], None],
    leave_out: Callable[[InputError], None] | None = None,
) -> list[FleetTask]:
    """Make the tasks of an archive's recordings in the order of their names, one task for equal content.

    advance: called with the bytes read and in total. leave_out: called with the error of a recording that
    can't be read, which then has no task; without it the error is raised.
    """
    recordings = find_recordings(archive)[:limit]
    total, done = sum(one.size for one in recordings), 0
    tasks: dict[str, FleetTask] = {}
    for recording in recordings:

        def read(size: int) -> None:
            nonlocal done
            done += size
            advance(done, total)

        try:
            manifest = manifest_digest(archive, results, recording, read)
        except UnreachableError:
            raise
        except InputError as error:
            if leave_out is None:
                raise
            leave_out(error)
            continue
        key = version.key(manifest)
        tasks.setdefault(
            key,
            FleetTask(
                key, recording.name, recording.passes, version, manifest, archive.url, recording.size,
                recording.pairs,
            ),
        )  # fmt: skip
    return list(tasks.values())


def estimate(tasks: list[FleetTask], measured: list[tuple[int, int, float, int]]) -> WorkEstimate:
    """Estimate the work of tasks from completed ones: by their pairs, or by bytes if these aren't known.

    measured: bytes, pairs, seconds and bytes of result of completed tasks.
    """
    per_pair = [seconds / pairs for _, pairs, seconds, _ in measured if pairs]
    per_byte = [seconds / size for size, _, seconds, _ in measured if size]
    written = [result for *_, result in measured]
    seconds = 0.0
    for task in tasks:
        if task.pairs:
            seconds += median(per_pair) * task.pairs if per_pair else FIRST_S + PER_PAIR_S * task.pairs
        else:
            seconds += median(per_byte) * task.size if per_byte else FIRST_S + PER_BYTE_S * task.size
    each = median(written) if written else RESULT_BYTES
    return WorkEstimate(seconds, sum(t.size for t in tasks), round(each * len(tasks)), len(measured))


@dataclass(frozen=True)
class TaskChoice:
    """Choice and order of the tasks to run."""

    version: str | None = None
    """Version to measure, given by the beginning of its name; the newest if not given."""
    limit: int | None = None
    """Maximum number of remaining recordings to measure now."""
    first: tuple[str, ...] = ()
    """Beginnings of the names of recordings to measure first, in this order."""
    again: bool = False
    """Try parked recordings again."""

    def __post_init__(self) -> None:
        if self.limit is not None:
            expect_ranges(self, "", limit=(1, inf))

    def of(self, tasks: list[FleetTask]) -> list[FleetTask]:
        """Sort the tasks by the beginnings of names in `first`, all others last, and cut them to the
        limit.
        """

        def rank(task: FleetTask) -> int:
            hits = (place for place, start in enumerate(self.first) if task.name.startswith(start))
            return next(hits, len(self.first))

        return sorted(tasks, key=rank)[: self.limit]
