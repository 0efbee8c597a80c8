"""Dispatch `barsight fleet KIND ...` to the requested command on an archive."""

from __future__ import annotations

from collections.abc import Sequence

from barsight.cli.arguments import pass_on

KINDS = {
    "plan": "Find an archive's recordings and plan their measurement",
    "run": "Measure the planned recordings, on this machine's cores or a Dask cluster",
    "status": "Count what is done, under way, left and parked",
    "compare": "Compare two versions over the archive",
    "promote": "Switch the page and the plant to a version, or back",
}


def run(arguments: Sequence[str]) -> None:
    """Pass the remaining arguments on."""
    pass_on("fleet", "task of the fleet", KINDS, arguments)
