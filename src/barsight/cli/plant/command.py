"""Dispatch `barsight plant KIND ...` to the requested command."""

from __future__ import annotations

from collections.abc import Sequence

from barsight.cli.arguments import pass_on

KINDS = {
    "run": "Serve the plant's state by telegram, OPC UA, MQTT, S7 and webhooks until Ctrl-C",
    "user": "Add a user of the OPC UA server, or change role and password",
    "check": "Check each link from its other side, and write a protocol",
    "scl": "Write the telegram's types as a source file for TIA Portal",
}


def run(arguments: Sequence[str]) -> None:
    """Pass the remaining arguments on."""
    pass_on("plant", "task of the plant's side", KINDS, arguments)
