"""Run `barsight paper -o OUT`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro

from barsight.cli.arguments import call
from barsight.cli.progress import stages
from barsight.cli.safe_console import SafeConsole
from barsight.core.files import expect_empty
from barsight.paper.page import expect_recording, write_paper


def run(arguments: Sequence[str]) -> None:
    """Parse, run and write."""

    def command(
        out: Annotated[Path, tyro.conf.arg(aliases=("-o",))],
        quick: bool = False,
        recording: Path | None = None,
    ) -> None:
        """Reproduce the paper: each equation, figure, table and conclusion next to Barsight's, on one page.

        Args:
            out: A new folder for the page, OUT/paper.html.
            quick: Draw fewer and smaller scenes: 10 m of stack in 320 x 256 pairs, not 35 m in 640 x 512.
            recording: Show the figures for this recording; Table 1, the side and the environments stay drawn.
        """
        expect_recording(recording)
        expect_empty(out)
        console = SafeConsole(stderr=True)
        with stages(console) as advance:
            write_paper(out, advance, quick=quick, recording=recording)
        console.print_line(f"page: {out / 'paper.html'}")

    call(command, "paper", arguments)
