"""Run `barsight fleet run --store URL --results URL`."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

from barsight.cli.arguments import call
from barsight.cli.progress import stages
from barsight.cli.safe_console import SafeConsole
from barsight.core.errors import ConfigError
from barsight.fleet.cluster import connect
from barsight.fleet.driver import count_states, drive
from barsight.fleet.ledger import forgive
from barsight.fleet.objects import open_objects
from barsight.fleet.planning import in_order
from barsight.fleet.records import find_version, read_archive, read_tasks
from barsight.fleet.task import TaskSettings
from barsight.fleet.window import RunWindow
from barsight.store.audit import user_name
from barsight.store.opening import DEFAULT_URL, open_store


def run(arguments: Sequence[str]) -> None:
    """Parse and drive."""

    def command(
        results: str, store: str = DEFAULT_URL, version: str | None = None, workers: int = 1,
        scheduler: str | None = None, limit: int | None = None, first: tuple[str, ...] = (),
        idle: bool = False, between: tuple[str, str] | None = None, memory_gib: float = 8.0,
        timeout_s: float = 7200.0, lease_s: float = 60.0, threads: int = 0, again: bool = False,
        by: str | None = None,
    ) -> None:  # fmt: skip
        """Measure what is planned; killed, it goes on where it was when it is started again.

        Args:
            results: Folder or URL for what is measured.
            store: SQLAlchemy's URL of the database.
            version: Version to measure, by the beginning of its name; the one planned last if not given.
            workers: Worker processes on this machine.
            scheduler: Address of a Dask scheduler, tcp://HOST:PORT, whose workers are used instead.
            limit: Most recordings to measure now.
            first: Beginnings of the names of recordings that come first, in this order.
            idle: Start a recording only while this machine has an idle core.
            between: Start recordings only between two local times, like 22:00 06:00.
            memory_gib: Memory that one measurement may take.
            timeout_s: Time that one measurement may take.
            lease_s: Time after which a dead worker's recording is taken over; more than clocks differ.
            threads: Threads of each measurement; all cores if 0.
            again: Try parked recordings again.
            by: Who runs it, for the audit log; the name of the user if not given.
        """
        if min(workers, memory_gib, timeout_s) <= 0 or lease_s < 2:
            raise ConfigError("fleet run: workers, memory and time are above 0, the lease is 2 s or more")
        window = RunWindow(between, idle)
        target = open_objects(results, create=True)
        with open_store(store) as opened:
            with opened.reading() as connection:
                chosen = find_version(connection, version)
                tasks = in_order(read_tasks(connection, chosen), first)[:limit]
                archive = read_archive(connection, chosen)
            if again:
                for task in tasks:
                    forgive(target, task.key)
            # Workers of other machines can't write into this machine's file.
            is_reached = scheduler is None or not store.startswith("sqlite")
            settings = TaskSettings(
                archive, target.url, store if is_reached else None, memory_gib, timeout_s, lease_s, threads,
                by or user_name(),
            )  # fmt: skip
            with connect(workers, scheduler) as client, stages(SafeConsole(stderr=True)) as advance:
                told = partial(advance, "measure")
                drive(client, tasks, settings, opened, target, window, told)
            counts = count_states(target, tasks)
        SafeConsole().print(
            f"version {chosen.name}: {counts.published} published, {counts.parked} parked of {len(tasks)}",
            highlight=False,
        )

    call(command, "fleet run", arguments)
