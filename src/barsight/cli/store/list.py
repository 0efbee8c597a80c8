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
from barsight.store.calibrations import KnownCalibration, list_calibrations
from barsight.store.confirmation import yard_clock_ns
from barsight.store.history import SurveyRow, list_surveys, present_yard, time_text, yard_records
from barsight.store.opening import DEFAULT_URL, open_store
from barsight.store.recordings import KnownRecording, list_recordings


def run(arguments: Sequence[str]) -> None:
    """Parse the arguments, read the store and print its content."""

    def command(
        url: tyro.conf.Positional[str] = DEFAULT_URL, json: bool = False, migrate: bool = False
    ) -> None:
        """List the store's surveys, calibrations and recordings, and the bundles currently in the yard.

        Args:
            url: SQLAlchemy URL of the database.
            json: Write JSON, with each bundle's record as in bundles.json.
            migrate: Update the tables of an earlier version on PostgreSQL; back them up first.
        """
        now_ns = time.time_ns()
        with open_store(url, migrate=migrate) as store, store.reading() as connection:
            surveys, present = list_surveys(connection), present_yard(connection)
            calibrations, recordings = list_calibrations(connection), list_recordings(connection)
            clock_ns = yard_clock_ns(connection, now_ns)
        if json:
            print_json(
                {
                    "surveys": [asdict(each) for each in surveys],
                    "calibrations": [asdict(each) for each in calibrations],
                    "recordings": [asdict(each) for each in recordings],
                    "bundles": yard_records(present, now_ns),
                }
            )
            return
        console = SafeConsole()
        console.print(_table(surveys))
        console.print(_calibration_table(calibrations, clock_ns))
        console.print(_recording_table(recordings))
        console.print(bundle_table("Present yard", present, now_ns))

    call(command, "store list", arguments)


def _calibration_table(calibrations: tuple[KnownCalibration, ...], clock_ns: int) -> Table:
    table = Table(title="Calibrations", box=SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    for head in ("crane", "rig", "calibration", "valid from", "until", "approved by", "now"):
        table.add_column(head, no_wrap=head not in ("valid from", "until", "approved by"), overflow="fold")
    for one in calibrations:
        named = one.crane, one.rig, one.digest
        if not one.times:
            table.add_row(*named, "-", "-", "-", "never approved")
        for time_ in one.times:
            since, until = (
                "-" if ns is None else time_text(ns).replace("T", " ")  # which may be broken into two lines
                for ns in (time_.from_ns, time_.until_ns)
            )
            status = "valid" if time_.holds(clock_ns) else "to come" if clock_ns < time_.from_ns else "ended"
            table.add_row(*named, since, until, time_.approved_by, status)
    return table


def _recording_table(recordings: tuple[KnownRecording, ...]) -> Table:
    table = Table(title="Recordings", box=SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    for head in ("recording", "SHA-256", "rig", "state", "why kept, or since", "surveys"):
        table.add_column(head, no_wrap=head in ("SHA-256", "rig", "state", "surveys"), overflow="fold")
    for one in recordings:
        why = one.note if one.state == "kept" and one.note else time_text(one.at_ns)
        table.add_row(one.key, one.digest[:12], one.rig, one.state, why, "\n".join(one.surveys))
    return table


def _table(surveys: tuple[SurveyRow, ...]) -> Table:
    table = Table(title="Surveys", box=SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    for head in ("map", "last frame", "seen", "same", "moved", "added", "found", "gone"):
        table.add_column(head, justify="left" if head in ("map", "last frame") else "right", no_wrap=True)
    for each in surveys:
        counts = [each.changes.get(kind, 0) for kind in ("same", "moved", "added", "found")]
        numbers = [sum(counts), *counts, each.changes.get("gone", 0)]
        table.add_row(each.map_id, time_text(each.captured_to_ns), *map(str, numbers))
    return table
