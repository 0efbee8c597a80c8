"""Measure one recording of an archive: claim, download, measure under limits, upload, publish, record."""

from __future__ import annotations

import hashlib
import os
import socket
import sys
import time
from dataclasses import dataclass
from math import inf
from pathlib import Path

from barsight.core.errors import BarsightError, Failed, InputError, OutputError
from barsight.core.files import translated_os_errors
from barsight.core.settings.values import NOT_NEGATIVE, POSITIVE, expect_ranges
from barsight.fleet.archive import copied_to, download
from barsight.fleet.ledger import HeldRecording, claim, discard, fail, held, publish
from barsight.fleet.limits import LimitedRun, run_limited, thread_variables
from barsight.fleet.objects import Objects, UnreachableError, open_objects
from barsight.fleet.records import note_result
from barsight.fleet.scratch import compile_once, scratch_folder
from barsight.fleet.versions import FleetTask, arguments, expect_software

COMMAND = (sys.executable, "-m", "barsight", "measure")
_REASON = 400
"""Number of characters kept of a measurement's last line."""


@dataclass(frozen=True)
class TaskLimits:
    """Limits of one measurement of an archive."""

    memory_gib: float = 8.0
    """Maximum memory of one measurement in GiB."""
    timeout_s: float = 7200.0
    """Maximum duration of one measurement in seconds."""
    lease_s: float = 60.0
    """Time in seconds after which a dead worker's recording is taken over; must exceed the clocks'
    differences.
    """
    threads: int = 0
    """Number of threads of each measurement; 0 for all cores."""

    def __post_init__(self) -> None:
        expect_ranges(
            self, "", memory_gib=POSITIVE, timeout_s=POSITIVE, lease_s=(2, inf), threads=NOT_NEGATIVE
        )  # fmt: skip


@dataclass(frozen=True)
class TaskSettings:
    """Settings shared by all tasks: URLs of results and store (None: the driver writes the rows), limits."""

    results: str
    store: str | None
    limits: TaskLimits = TaskLimits()
    by: str = "fleet"
    command: tuple[str, ...] = COMMAND


def run_task(task: FleetTask, settings: TaskSettings) -> str:
    """Measure a recording unless another worker has claimed or done it; return its key in any case.

    A failed recording is retried at once until it is parked. Raises ConfigError if this machine's software
    isn't the version's, and any error that ends the whole run: unreachable results or archive, or a full
    disk.
    """
    expect_software(task.version.software)
    results = open_objects(settings.results)
    while True:
        mine = claim(results, task.key, settings.limits.lease_s)
        if not isinstance(mine, HeldRecording):
            return task.key
        with held(results, mine, settings.limits.lease_s):
            try:
                ended = _try(task, mine, settings, results)
            except OutputError as error:
                raise OutputError(f"on {socket.gethostname()}: {error}") from error
            if not isinstance(ended, Failed):
                return task.key
            if fail(results, mine, f"{ended.code}: {ended.reason}"):
                return task.key


def _try(task: FleetTask, mine: HeldRecording, settings: TaskSettings, results: Objects) -> Failed | None:
    """Measure once; return None if the result is published, by this try or another."""
    started = time.monotonic()
    with scratch_folder(task.key) as folder, translated_os_errors(folder):
        words = arguments(results, task.version, folder)
        (folder / "in").mkdir()
        archive = open_objects(task.archive)
        try:
            paths = list(download(archive, task.name, task.passes, folder / "in"))
        except UnreachableError:
            raise
        except InputError as error:
            return Failed("refused", str(error))
        words = [*map(str, paths), "-o", str(folder / "out"), "--at", "end", *words]
        if settings.command == COMMAND:
            compile_once()
        fetched_s = time.monotonic() - started
        ran = run_limited(
            [*settings.command, *words],
            folder,
            os.environ | thread_variables(settings.limits.threads),
            settings.limits.memory_gib,
            settings.limits.timeout_s,
        )
        if isinstance(ran, Failed):
            if ran.code == "output":
                raise OutputError(ran.reason)
            return Failed(ran.code, _in_archive(ran.reason, task, folder)[:_REASON])
        files = _upload(folder / "out", f"files/{task.key}/{mine.token}", results)
        content = _content(task, ran, fetched_s, time.monotonic() - started, files)
        is_ours = publish(results, mine, content)
        discard(results, mine, is_ours=is_ours)
        if is_ours and settings.store is not None:
            try:
                note_result(settings.store, task.key, content, settings.by)
            except BarsightError as error:  # the driver writes what is missing
                sys.stderr.write(f"{error}\n")
    return None


def _in_archive(reason: str, task: FleetTask, folder: Path) -> str:
    """Replace the places of the copies in a reason by those in the archive: the copies are gone by then."""
    place = f"{task.archive}/{task.name}".rstrip("/")
    above = place.rpartition("/")[0] if task.name else place
    for copy, original in ((copied_to(task.name, folder / "in"), place), (folder / "in", above)):
        reason = reason.replace(str(copy), original)
    return reason


def _upload(out: Path, target: str, results: Objects) -> dict[str, dict[str, object]]:
    files: dict[str, dict[str, object]] = {}
    for path in sorted(p for p in out.rglob("*") if p.is_file()):
        name = path.relative_to(out).as_posix()
        with path.open("rb") as stream:
            digest = hashlib.file_digest(stream, "sha256").hexdigest()
        results.write(f"{target}/{name}", path)
        files[name] = {"bytes": path.stat().st_size, "sha256": digest}
    return files


def _content(
    task: FleetTask, ran: LimitedRun, fetched_s: float, whole_s: float, files: dict[str, dict[str, object]]
) -> dict[str, object]:
    return {
        "recording": task.name,
        "version": task.version.name,
        "measured_s": round(ran.seconds, 3),
        "fetched_s": round(fetched_s, 3),
        "whole_s": round(whole_s, 3),
        "peak_bytes": ran.peak_bytes,
        "published_at": time.time(),
        "files": files,
    }
