"""Run `barsight report OUT`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import tyro

from barsight.cli.arguments import call
from barsight.cli.safe_console import SafeConsole
from barsight.report.page import write_report


def run(arguments: Sequence[str]) -> None:
    """Parse and write."""

    def command(out: tyro.conf.Positional[Path]) -> None:
        """Write report.html anew from the files of a measured yard.

        Args:
            out: A folder written by barsight measure.
        """
        path = out / "report.html"
        write_report(out, path)
        SafeConsole(stderr=True).print_line(f"report: {path}")

    call(command, "report", arguments)
