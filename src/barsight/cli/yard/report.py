"""Run `barsight report OUT`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import tyro

from barsight.cli.arguments import call
from barsight.cli.safe_console import SafeConsole
from barsight.report.page import write_report


def run(arguments: Sequence[str]) -> None:
    """Parse the arguments and write the report."""

    def command(out: tyro.conf.Positional[Path]) -> None:
        """Write report.html again from the files of a measured yard.

        Args:
            out: A folder of results from barsight measure.
        """
        path = out / "report.html"
        write_report(out, path)
        SafeConsole(stderr=True).print_line(f"report: {path}")

    call(command, "report", arguments)
