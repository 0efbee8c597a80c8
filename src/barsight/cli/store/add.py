"""Run `barsight store add URL OUT`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import tyro
from rich.console import Console

from barsight.cli.arguments import call
from barsight.cli.safe_console import SafeConsole
from barsight.store.adding import AddedSurvey, add_survey, read_survey
from barsight.store.audit import user_name
from barsight.store.confirmation import newest_survey, yard_clock_ns
from barsight.store.history import why_ahead
from barsight.store.opening import DEFAULT_URL, open_store


def run(arguments: Sequence[str]) -> None:
    """Parse the arguments, add the survey and print the result."""

    def command(
        url: tyro.conf.Positional[str],
        out: tyro.conf.Positional[Path],
        by: str | None = None,
        migrate: bool = False,
        same_yard: bool = False,
        rig: str | None = None,
        crane: str | None = None,
    ) -> None:
        """Add a measured folder to the store; its bundles get permanent names.

        The store is created if there is none. A folder that is already in it changes nothing; an older one
        is inserted at its place in time. OUT is only read.

        Args:
            url: SQLAlchemy URL of the database; sqlite:///barsight.db if only OUT is given.
            out: A folder of results from barsight measure. It should stay where it is.
            by: Name for the audit log; by default the name of the user.
            same_yard: The survey is of the store's surveyed yard although its yard frame differs, as after
                a recalibration.
            rig: Name of the rig used for the survey; by default the calibration's rig, or else the newest.
            crane: Name of the crane that carries the rig; by default the one that carried it before.
            migrate: Update the tables of an earlier version on PostgreSQL; back them up first.
        """
        survey = read_survey(out)
        with open_store(url, create=True, migrate=migrate) as store:
            added = add_survey(store, survey, by or user_name(), same_yard=same_yard, rig=rig, crane=crane)
            with store.reading() as connection:
                newest, clock_ns = newest_survey(connection), yard_clock_ns(connection)
        console = SafeConsole()
        _print(added, console)
        if added.is_new and newest is not None and newest.map_id != added.map_id:
            ahead = why_ahead(newest.captured_to_ns, clock_ns) or f"the newest is {newest.map_id}"
            console.print(f"it isn't the newest, so nothing of it is offered: {ahead}", highlight=False)

    words = list(arguments)
    if len(words) == 1 and not words[0].startswith("-"):
        words.insert(0, DEFAULT_URL)
    call(command, "store add", words)


def _print(added: AddedSurvey, console: Console) -> None:
    if not added.is_new:
        console.print(f"survey {added.map_id} is in the store already: nothing changed", highlight=False)
        return
    counts = ", ".join(f"{count} {kind}" for kind, count in sorted(added.counts.items()))
    console.print(f"survey {added.map_id}: {counts or 'no bundles'}", highlight=False)
    for kind in ("moved", "added", "gone"):
        names = [name for name, each in {**added.changes, **added.absences}.items() if each == kind]
        if names:
            console.print(f"{kind}: {', '.join(names)}", highlight=False)
