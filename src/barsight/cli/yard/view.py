"""Run `barsight view OUT`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import tyro

from barsight.cli.arguments import call
from barsight.core.extras import extra


def run(arguments: Sequence[str]) -> None:
    """Parse the arguments and serve until Ctrl-C."""

    def command(out: tyro.conf.Positional[Path], port: int = 8080, browser: bool = True) -> None:
        """Show a measured yard in 3D in the browser until Ctrl-C; works offline.

        Args:
            out: A folder of results from barsight measure.
            port: Port on this machine to serve at.
            browser: Open the browser.
        """
        with extra("view"):
            from barsight.viewer.view import view
        view(out, port, browser)

    call(command, "view", arguments)
