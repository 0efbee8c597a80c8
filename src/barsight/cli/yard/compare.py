"""Run `barsight compare OLD NEW`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import tyro
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from barsight.cli.arguments import call
from barsight.cli.safe_console import SafeConsole
from barsight.core.errors import MeasurementError
from barsight.core.json_values import write_json
from barsight.result_folder import open_folder, read_heights
from barsight.yard.identity import expect_same_frame
from barsight.yard.inventory.bundle_file import read_bundles
from barsight.yard.inventory.changes import YardChanges, compare_yards


def run(arguments: Sequence[str]) -> None:
    """Parse the arguments, compare the yards and print the changes."""

    def command(
        old: tyro.conf.Positional[Path], new: tyro.conf.Positional[Path], json: Path | None = None,
        same_yard: bool = False,
    ) -> None:  # fmt: skip
        """Report the changes between two measured yards: moved, settled, taken, added, in mm and kg.

        A change counts as significant if, by the sigmas of both, its probability by chance is less than
        one in a thousand.

        Args:
            old: The earlier folder of results from barsight measure.
            new: The later one.
            json: JSON file for all figures.
            same_yard: Both frames are of one surveyed yard although their yard frames differ, as after a
                recalibration.
        """
        frames = []
        for folder in (old, new):
            summary, _ = open_folder(folder, lifts=False)
            frames.append(summary.get("yard_frame_id"))
            reference = summary.get("reference")
            if reference != "yard":
                raise MeasurementError(
                    f"{folder}: is in the {reference} frame; only maps with a crane's place can be compared"
                )
        if not same_yard:
            expect_same_frame(new, frames[1], frames[0], str(old))
        compared = compare_yards(
            read_bundles(old / "bundles.json"), read_heights(old),
            read_bundles(new / "bundles.json"), read_heights(new),
        )  # fmt: skip
        if json is not None:
            _write(compared, json)
        _print(compared, SafeConsole())

    call(command, "compare", arguments)


def _write(compared: YardChanges, target: Path) -> None:
    rows = [asdict(change) | {"significant": change.significant} for change in compared.changes]
    write_json(target, {"changes": rows, "shift_mm": 1e3 * compared.shift_m})


def _print(compared: YardChanges, console: Console) -> None:
    changes = compared.changes
    shown = [change for change in changes if change.kind != "same"]
    if shown:
        table = Table(box=SIMPLE_HEAD, title="Changes")
        for head in ("what", "old", "new", "across mm", "along mm", "up mm", "yaw deg", "kg"):
            table.add_column(head, justify="right", no_wrap=True)
        for change in shown:
            across, along, up, yaw = change.sigmas
            table.add_row(
                change.kind, _name(change.old), _name(change.new), _figure(change.across_mm, across, 0),
                _figure(change.along_mm, along, 0), _figure(change.up_mm, up, 0),
                _figure(change.yaw_deg, yaw, 2), _figure(change.kg, change.sigma_kg, 0),
            )  # fmt: skip
        console.print(table)
    x, y, z = 1e3 * compared.shift_m
    shift = f"shift of the whole yard, taken out of all: {x:+.0f}, {y:+.0f}, {z:+.0f} mm in x, y, z"
    console.print(shift, highlight=False)
    same = len(changes) - len(shown)
    console.print(f"unchanged: {same} of {len(changes)} bundles", highlight=False)


def _name(number: int | None) -> str:
    return "-" if number is None else str(number)


def _figure(value: float, sigma: float, decimals: int) -> str:
    if math.isnan(value):
        return "-"
    return f"{value:+.{decimals}f} ± {sigma:.{decimals}f}"
