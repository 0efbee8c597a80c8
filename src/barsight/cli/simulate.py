"""Run `barsight simulate OUT`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from barsight.cli.arguments import call, config_path, load_settings
from barsight.cli.progress import stages
from barsight.simulation.settings import SimulationSettings
from barsight.simulation.simulate import simulate


def run(arguments: Sequence[str]) -> None:
    """Parse and render."""
    default = load_settings(config_path(arguments), SimulationSettings)

    def command(
        out: tyro.conf.Positional[Path],
        settings: Annotated[SimulationSettings, tyro.conf.arg(name="")] = default,
        config: Path | None = None,
    ) -> None:
        """Render a recording of a bar yard, with exact truth, as an EuRoC folder.

        Args:
            out: The folder to write; it must not exist yet.
            settings: The yard, the cameras, the crane and its sensors.
            config: TOML file with settings; flags go before it.
        """
        console = Console(stderr=True)
        with stages(console) as advance:
            simulate(out, settings, lambda done, total: advance("render", done, total))
        console.print(f"simulated recording: {out}", soft_wrap=True, highlight=False, markup=False)

    call(command, "simulate", arguments)
