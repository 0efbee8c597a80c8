"""Run `barsight yard URL`."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import tyro
from rich.box import SIMPLE_HEAD
from rich.table import Table

from barsight.cli.arguments import call
from barsight.cli.safe_console import SafeConsole
from barsight.core.errors import ConfigError
from barsight.core.files import atomic_path
from barsight.core.json_values import json_value
from barsight.core.stamps import NS_PER_S
from barsight.store.history import (
    PresentBundle,
    parse_time,
    present_yard,
    time_text,
    yard_changes,
    yard_records,
)
from barsight.store.opening import DEFAULT_URL, open_store
from barsight.store.stock import listed_bundles
from barsight.yard.inventory.stock_list import stock_text

_UNITS = ((86400, "d"), (3600, "h"), (60, "min"), (1, "s"))


def run(arguments: Sequence[str]) -> None:
    """Parse the arguments, read the store and print the yard."""

    def command(
        url: tyro.conf.Positional[str] = DEFAULT_URL, at: str | None = None, since: str | None = None,
        json: bool = False, stock_list: Path | None = None,
    ) -> None:  # fmt: skip
        """Print the yard as known at a time, or its changes between two times.

        The yard is each bundle's newest sighting with its age; changes are bundles that came, went and moved.

        Args:
            url: SQLAlchemy URL of the database.
            at: ISO 8601 with its zone, like 2026-11-23T14:00:00Z, or integer ns; by default now.
            since: An earlier time, in the same form; print only the changes between it and --at.
            stock_list: CSV file to write the yard to, in the form that `--bundles.stock-list` reads.
            json: Write JSON, with each bundle's record as in bundles.json and its identity.
        """
        at_ns = None if at is None else parse_time(at)
        now_ns = time.time_ns() if at_ns is None else at_ns
        if since is not None:
            if stock_list is not None:
                raise ConfigError("--stock-list writes the yard at one time; leave --since out")
            since_ns = parse_time(since)
            if since_ns > now_ns:
                raise ConfigError(f"--since {since} is later than {time_text(now_ns)}; name an earlier time")
            with open_store(url) as store, store.reading() as connection:
                changes = yard_changes(connection, since_ns, now_ns)
            if json:
                print_json({"since_ns": since_ns, "at_ns": now_ns, "changes": changes})
            else:
                SafeConsole().print(_change_table(since_ns, now_ns, changes))
            return
        with open_store(url) as store, store.reading() as connection:
            present = present_yard(connection, at_ns)
        if stock_list is not None:
            with atomic_path(stock_list) as path:
                path.write_text(stock_text(listed_bundles(present)), encoding="utf-8")
            SafeConsole().print(f"{stock_list}: {len(present)} bundles", highlight=False, soft_wrap=True)
            return
        if json:
            print_json({"at_ns": now_ns, "bundles": yard_records(present, now_ns)})
            return
        SafeConsole().print(bundle_table(f"Yard at {time_text(now_ns)}", present, now_ns))

    call(command, "yard", arguments)


def _change_table(since_ns: int, at_ns: int, changes: list[dict[str, Any]]) -> Table:
    title = f"Changes from {time_text(since_ns)} to {time_text(at_ns)}"
    table = Table(title=title, box=SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    for head in ("name", "what", "from x m", "y m", "to x m", "y m"):
        table.add_column(head, justify="left" if head in ("name", "what") else "right", no_wrap=True)
    for one in changes:
        places = [
            "-" if place is None else f"{place[axis]:.3f}"
            for place in (one["from_m"], one["to_m"])
            for axis in (0, 1)
        ]
        table.add_row(one["identity"], one["what"], *places)
    return table


def print_json(content: object) -> None:
    """Print a JSON document."""
    sys.stdout.write(json.dumps(json_value(content), indent=1, allow_nan=False) + "\n")


def bundle_table(title: str, present: tuple[PresentBundle, ...], now_ns: int) -> Table:
    """Format the bundles of a yard with place, age and doubts."""
    table = Table(title=title, box=SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    for head in ("name", "x m", "y m", "top m", "yaw deg", "length m", "age", "stock", "doubt"):
        table.add_column(
            head, justify="left" if head in ("name", "stock", "doubt") else "right",
            no_wrap=head not in ("stock", "doubt"),
        )  # fmt: skip
    for each in present:
        one, bundle = each.sighting, each.sighting.record
        x_m, y_m, _ = bundle["axis_centre_m"]
        open_end = "+" if any(bundle["ends_open"]) else ""
        table.add_row(
            one.identity, f"{x_m:.3f}", f"{y_m:.3f}", f"{bundle['top_z_m']:.3f}",
            f"{bundle['yaw_deg']:.2f}", f"{bundle['length_m']:.2f}{open_end}", _age(now_ns - one.seen_ns),
            one.stock_name or "", "" if each.doubt is None else each.doubt.kind,
        )  # fmt: skip
    return table


def _age(age_ns: int) -> str:
    """Format an age in its largest whole unit."""
    seconds = age_ns // NS_PER_S
    size, unit = next(((size, unit) for size, unit in _UNITS if abs(seconds) >= size), (1, "s"))
    return f"{seconds // size} {unit}"
