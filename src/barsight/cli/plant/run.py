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
    """Parse and serve until Ctrl-C."""

    def command(config: Path) -> None:
        """Serve the plant's state by the links that plant.toml names (telegram, OPC UA, MQTT, S7, webhooks);
        Ctrl-C ends it.

        Args:
            config: plant.toml.
        """
        settings, console = read_plant(config), SafeConsole()
        with open_store(settings.store.url) as store:
            asyncio.run(serve_plant(store, settings, lambda told: console.print(told, highlight=False)))

    call(command, "plant run", arguments)
