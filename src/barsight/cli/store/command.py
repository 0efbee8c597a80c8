"""Dispatch `barsight store KIND ...` to the requested command."""

from __future__ import annotations

from collections.abc import Sequence

from barsight.cli.arguments import pass_on

KINDS = {
    "add": "Add a measured folder: its bundles get names that they keep",
    "approve": "Approve a calibration for a time; the rig's older ones end",
    "keep": "Say why a recording is not to be deleted",
    "list": "List the surveys, calibrations and recordings, and the bundles of the present yard",
    "user": "Add or withdraw who may log in to the page",
    "verify": "Check the audit chain and the rows that it covers; exit code 5 where they don't hold",
}


def run(arguments: Sequence[str]) -> None:
    """Pass the remaining arguments on."""
    pass_on("store", "task of the store", KINDS, arguments)
