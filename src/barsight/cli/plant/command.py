"""Dispatch `barsight plant KIND ...` to what is asked of the plant's side."""

from __future__ import annotations

from collections.abc import Sequence

from barsight.cli.arguments import pass_on

KINDS = {
    "run": "Serve the cyclic telegram to a PLC by TCP; Ctrl-C ends it",
    "check": "Connect as a PLC, show the bytes, measure the cycle; exit code 5 where it doesn't hold",
}


def run(arguments: Sequence[str]) -> None:
    """Pass the rest of the line on."""
    pass_on("plant", "task of the plant's side", KINDS, arguments)
