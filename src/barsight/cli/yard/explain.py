"""Run `barsight explain OUT LIFT`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from barsight.cli.arguments import call
from barsight.cli.safe_console import SafeConsole
from barsight.report.explanation import Explanation, explain, format_check, write_explanation

COLOUR = {"passed": "green", "failed": "red", "unknown": "red"}


def run(arguments: Sequence[str]) -> None:
    """Parse the arguments, print the explanation and write its page."""

    def command(
        folder: tyro.conf.Positional[Path],
        lift: tyro.conf.Positional[str],
        out: Annotated[Path | None, tyro.conf.arg(aliases=("-o",))] = None,
    ) -> None:
        """Explain why a lift is offered or refused: every check with its figure and bound, and a picture.

        Args:
            folder: A folder of results from barsight measure.
            lift: The rank of an offered lift, like 3, or bundle:12 for the lift of bundle 12, offered or not.
            out: HTML file for checks and picture; by default OUT/explain-LIFT.html.
        """
        explanation = explain(folder, lift)
        target = out or folder / f"explain-{lift.replace(':', '-')}.html"
        write_explanation(explanation, target)
        console = SafeConsole()
        _print(explanation, console)
        console.print_line(f"page: {target}")

    call(command, "explain", arguments)


def _print(explanation: Explanation, console: Console) -> None:
    console.print(explanation.title, highlight=False)
    for veto in explanation.map_vetoes:
        console.print(f"[red]{veto['code']}:[/red] {escape(veto['reason'])}", highlight=False)
    for since in explanation.since:
        console.print(f"[red]{since.code}:[/red] {escape(since.reason)}", highlight=False)
    table = Table(box=SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    for head in ("result", "what is checked", "figure", "bound", "veto"):
        table.add_column(head, overflow="fold", no_wrap=head != "what is checked")
    for check in explanation.checks:
        figure, bound = format_check(check)
        what = check["what"] + (f"\n{check['reason']}" if check["reason"] else "")
        colour = COLOUR[check["result"]]
        table.add_row(f"[{colour}]{check['result']}[/{colour}]", escape(what), figure, bound, check["code"])
    console.print(table)
    if explanation.unseen:
        console.print(explanation.unseen, highlight=False)
