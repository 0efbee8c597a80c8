"""Dispatch `barsight plant KIND ...` to the requested command."""

from __future__ import annotations

from collections.abc import Sequence

from barsight.cli.arguments import pass_on

KINDS = {
    "run": "Serve the state by telegram, OPC UA, MQTT, S7 and webhooks; Ctrl-C ends it",
    "user": "Add a user of the OPC UA server, or change role and password",
    "check": "Check each link from the other side, and write a protocol; exit code 5 where one does not hold",
    "scl": "Write the telegram's types as a source for TIA Portal",
}


def run(arguments: Sequence[str]) -> None:
    """Pass the remaining arguments on."""
    pass_on("plant", "task of the plant's side", KINDS, arguments)
