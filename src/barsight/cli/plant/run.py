"""Run `barsight plant run --config plant.toml`."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from pathlib import Path

from barsight.cli.arguments import call
from barsight.cli.safe_console import SafeConsole
from barsight.core.errors import OutputError
from barsight.plant.serving import TelegramServer
from barsight.plant.settings import read_plant
from barsight.store.opening import open_store


def run(arguments: Sequence[str]) -> None:
    """Parse and serve until Ctrl-C."""

    def command(config: Path) -> None:
        """Serve the cyclic telegram to a PLC by TCP; Ctrl-C ends it.

        Args:
            config: plant.toml.
        """
        settings = read_plant(config)
        console = SafeConsole()
        one = settings.telegram
        with open_store(settings.store.url) as store:
            server = TelegramServer(store, settings)
            try:
                asyncio.run(server.run(lambda port: console.print(f"telegram at {one.host}:{port}")))
            except OSError as error:
                raise OutputError(f"telegram at {one.host}:{one.port}: {error}; choose another") from error

    call(command, "plant run", arguments)
