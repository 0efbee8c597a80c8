"""Run `barsight plant run --config plant.toml`."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from pathlib import Path

from barsight.cli.arguments import call
from barsight.cli.safe_console import SafeConsole
from barsight.plant.links.running import serve_plant
from barsight.plant.settings import read_plant
from barsight.store.opening import open_store


def run(arguments: Sequence[str]) -> None:
    """Parse the arguments and serve until Ctrl-C."""

    def command(config: Path) -> None:
        """Serve the plant's state over the links in plant.toml until Ctrl-C.

        Possible links are the telegram, OPC UA, MQTT, S7 and webhooks.

        Args:
            config: plant.toml.
        """
        settings, console = read_plant(config), SafeConsole()
        with open_store(settings.store.url) as store:
            asyncio.run(serve_plant(store, settings, console.print_line))

    call(command, "plant run", arguments)
