"""Run `barsight store add URL OUT`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from barsight.cli.arguments import call
from barsight.cli.safe_console import SafeConsole
from barsight.store.adding import AddedSurvey, add_survey, read_survey
from barsight.store.audit import user_name
from barsight.store.opening import DEFAULT_URL, open_store


def run(arguments: Sequence[str]) -> None:
    """Parse, add and print."""

    def command(
        url: tyro.conf.Positional[str],
        out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")],
        by: str | None = None,
        migrate: bool = False,
        same_yard: bool = False,
        rig: str | None = None,
        crane: str | None = None,
    ) -> None:
        """Add a measured folder to the store: its bundles get names that they keep.

        Makes the store where there is none. A folder that is there already changes nothing; an older one is
        put into its place in time. OUT is only read.

        Args:
            url: SQLAlchemy's URL of the database; sqlite:///barsight.db where only OUT is given.
            out: A folder written by barsight measure. It should stay where it is.
            by: Who adds it, for the audit log; the name of the user if not given.
            same_yard: The survey lies in the store's surveyed yard, though what places it there differs, as
                after a recalibration.
            rig: Name of the rig that it was surveyed with; the calibration's or the newest if not given.
            crane: Name of the crane that the rig hangs from; the one that it hung from, if not given.
            migrate: Bring the tables of an earlier version on PostgreSQL up to date; back them up before.
        """
        survey = read_survey(out)
        with open_store(url, create=True, migrate=migrate) as store:
            added = add_survey(store, survey, by or user_name(), same_yard=same_yard, rig=rig, crane=crane)
        _print(added, SafeConsole())

    words = list(arguments)
    if len(words) == 1 and not words[0].startswith("-"):
        words.insert(0, DEFAULT_URL)
    call(command, "store add", words)


def _print(added: AddedSurvey, console: Console) -> None:
    if not added.is_new:
        console.print(f"survey {added.map_id} is in the store already: nothing changed", highlight=False)
        return
    told = ", ".join(f"{count} {kind}" for kind, count in sorted(added.counts.items()))
    console.print(f"survey {added.map_id}: {told or 'no bundles'}", highlight=False)
    for kind in ("moved", "added", "gone"):
        names = [name for name, each in {**added.changes, **added.absences}.items() if each == kind]
        if names:
            console.print(f"{kind}: {', '.join(names)}", highlight=False)
