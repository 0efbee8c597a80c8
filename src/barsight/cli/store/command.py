"""Dispatch `barsight store KIND ...` to the requested command."""

from __future__ import annotations

from collections.abc import Sequence

from barsight.cli.arguments import pass_on

KINDS = {
    "add": "Add a measured folder; its bundles get permanent names",
    "approve": "Approve a calibration of a rig for a period",
    "keep": "Protect a recording from deletion, with a reason",
    "list": "List surveys, calibrations and recordings, and the bundles currently in the yard",
    "user": "Add a person who may log in to the page, or withdraw the account",
    "verify": "Verify the audit chain and the rows that it covers",
}


def run(arguments: Sequence[str]) -> None:
    """Pass the remaining arguments on."""
    pass_on("store", "task of the store", KINDS, arguments)
