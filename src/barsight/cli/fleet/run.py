"""Run `barsight fleet run --store URL --results URL`."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Annotated

import tyro

from barsight.cli.arguments import call
from barsight.cli.progress import stages
from barsight.cli.safe_console import SafeConsole
from barsight.core.errors import ConfigError
from barsight.fleet.cluster import connect
from barsight.fleet.driver import count_states, drive, open_tasks
from barsight.fleet.ledger import forgive, parked_keys
from barsight.fleet.objects import open_objects
from barsight.fleet.planning import TaskChoice
from barsight.fleet.records import find_version, read_tasks
from barsight.fleet.task import TaskLimits, TaskSettings
from barsight.fleet.window import RunWindow
from barsight.store.audit import user_name
from barsight.store.opening import DEFAULT_URL, open_store


def run(arguments: Sequence[str]) -> None:
    """Parse the arguments and run the planned measurements."""

    def command(
        results: str,
        choice: Annotated[TaskChoice, tyro.conf.arg(name="")],
        limits: Annotated[TaskLimits, tyro.conf.arg(name="")],
        window: Annotated[RunWindow, tyro.conf.arg(name="")],
        store: str = DEFAULT_URL,
        workers: int = 1,
        scheduler: str | None = None,
        by: str | None = None,
    ) -> None:
        """Measure the planned recordings; if the command is killed, it continues when started again.

        Args:
            results: Folder or URL for the results.
            choice: Choice among the planned recordings.
            limits: Limits of each measurement.
            window: Times at which recordings are started.
            store: SQLAlchemy URL of the database.
            workers: Number of worker processes on this machine.
            scheduler: Address of a Dask scheduler, tcp://HOST:PORT, whose workers are used instead.
            by: Name for the audit log; by default the name of the user.
        """
        if workers < 1:
            raise ConfigError(f"--workers {workers}: give 1 or more")
        target = open_objects(results)
        with open_store(store) as opened:
            with opened.reading() as connection:
                chosen = find_version(connection, choice.version)
                planned = read_tasks(connection, chosen)
            if choice.again:
                for key in parked_keys(target) & {task.key for task in planned}:
                    forgive(target, key)
            who = by or user_name()
            tasks = choice.of(open_tasks(opened, target, planned, who))
            # Workers on other machines can't write to a database file on this machine.
            is_reached = scheduler is None or not store.startswith("sqlite")
            settings = TaskSettings(target.url, store if is_reached else None, limits, who)
            with connect(workers, scheduler) as client, stages(SafeConsole(stderr=True)) as advance:
                drive(client, tasks, settings, opened, target, window, partial(advance, "measure"))
            counts, now = count_states(target, planned), count_states(target, tasks)
        SafeConsole().print(
            f"version {chosen.name}: {now.published} published and {now.parked} parked now; of "
            f"{len(planned)} recordings {counts.published} are published, {counts.parked} parked, "
            f"{counts.running + counts.left} left"
            + ("; barsight fleet status names the reasons" if counts.parked else ""),
            highlight=False, soft_wrap=True,
        )  # fmt: skip

    call(command, "fleet run", arguments)
