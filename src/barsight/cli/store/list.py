"""Run `barsight store list URL`."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict

import tyro
from rich.box import SIMPLE_HEAD
from rich.table import Table

from barsight.cli.arguments import call
from barsight.cli.safe_console import SafeConsole
from barsight.cli.store.yard import bundle_table, print_json
from barsight.store.history import SurveyRow, list_surveys, present_yard, time_text, yard_records
from barsight.store.opening import DEFAULT_URL, open_store


def run(arguments: Sequence[str]) -> None:
    """Parse, read and print."""

    def command(
        url: tyro.conf.Positional[str] = DEFAULT_URL, json: bool = False, migrate: bool = False
    ) -> None:
        """List the surveys of the store and the bundles of the present yard.

        Args:
            url: SQLAlchemy's URL of the database.
            json: Write JSON, with each bundle's record as in bundles.json.
            migrate: Bring the tables of an earlier version on PostgreSQL up to date; back them up before.
        """
        now_ns = time.time_ns()
        with open_store(url, migrate=migrate) as store, store.reading() as connection:
            surveys, present = list_surveys(connection), present_yard(connection)
        if json:
            print_json(
                {"surveys": [asdict(each) for each in surveys], "bundles": yard_records(present, now_ns)}
            )
            return
        console = SafeConsole()
        console.print(_table(surveys))
        console.print(bundle_table("Present yard", present, now_ns))

    call(command, "store list", arguments)


def _table(surveys: tuple[SurveyRow, ...]) -> Table:
    table = Table(title="Surveys", box=SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    for head in ("map", "last frame", "seen", "same", "moved", "added", "found", "gone"):
        table.add_column(head, justify="left" if head in ("map", "last frame") else "right", no_wrap=True)
    for each in surveys:
        counts = [each.changes.get(kind, 0) for kind in ("same", "moved", "added", "found")]
        numbers = [sum(counts), *counts, each.changes.get("gone", 0)]
        table.add_row(each.map_id, time_text(each.captured_to_ns), *map(str, numbers))
    return table
