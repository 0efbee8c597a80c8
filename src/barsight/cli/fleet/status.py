"""Run `barsight fleet status --store URL --results URL`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict

from barsight.cli.arguments import call
from barsight.cli.safe_console import SafeConsole
from barsight.core.extras import extra
from barsight.store.opening import DEFAULT_URL, open_store


def run(arguments: Sequence[str]) -> None:
    """Parse the arguments, count and print."""

    def command(results: str, store: str = DEFAULT_URL, version: str | None = None) -> None:
        """Count each version's recordings: published, under way, left, and parked with reasons.

        Args:
            results: Folder or URL for the results.
            store: SQLAlchemy URL of the database.
            version: Version to report, by the beginning of its name; by default all.
        """
        with extra("fleet"):
            from barsight.fleet.driver import count_states, parked_reasons
            from barsight.fleet.objects import open_objects
            from barsight.fleet.records import find_version, read_tasks, read_versions
            from barsight.fleet.versions import places
            from barsight.store.promotion import promoted_version
        target, console = open_objects(results), SafeConsole()
        with open_store(store) as opened, opened.reading() as connection:
            chosen = read_versions(connection) if version is None else [find_version(connection, version)]
            promoted = promoted_version(connection)
            planned = {one: read_tasks(connection, one) for one in chosen}
        for one, tasks in planned.items():
            words = ", ".join(f"{n} {name}" for name, n in asdict(count_states(target, tasks)).items())
            star = " (promoted)" if one.name == promoted else ""
            console.print(f"version {one.name}{star}: {words}", highlight=False, soft_wrap=True)
            for task, reason in parked_reasons(target, tasks):
                console.print(
                    f"  parked {places(tasks)[task.key]}: {reason}",
                    highlight=False,
                    soft_wrap=True,
                    markup=False,
                )

    call(command, "fleet status", arguments)
