"""Dispatch `barsight fleet KIND ...` to the requested command on an archive."""

from __future__ import annotations

from collections.abc import Sequence

from barsight.cli.arguments import pass_on

KINDS = {
    "plan": "Find an archive's recordings, and tell what is to be done and how long it takes",
    "run": "Measure what is planned, on this machine's cores or a Dask cluster",
    "status": "Count what is done, under way, left, and parked with its reason",
    "compare": "Compare two versions over the archive: what moved beyond its sigma",
    "promote": "Switch what the page and the plant see to a version, or back",
}


def run(arguments: Sequence[str]) -> None:
    """Pass the remaining arguments on."""
    pass_on("fleet", "task of the fleet", KINDS, arguments)
