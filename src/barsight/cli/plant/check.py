"""Run `barsight plant check --config plant.toml`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from barsight.cli.arguments import call
from barsight.cli.safe_console import SafeConsole
from barsight.core.errors import Failed, MeasurementError
from barsight.plant.checking import check_telegram
from barsight.plant.settings import read_plant


def run(arguments: Sequence[str]) -> None:
    """Parse, check and print."""

    def command(config: Path) -> None:
        """Connect to the telegram's server as a PLC, show both sides' bytes, and measure the cycle.

        Nothing is claimed. Ends with exit code 5 where cycle or life counter don't hold.

        Args:
            config: plant.toml.
        """
        checked = check_telegram(read_plant(config).telegram)
        if isinstance(checked, Failed):
            raise MeasurementError(f"{checked}; is barsight plant run running?")
        console = SafeConsole()
        for line in checked.lines:
            console.print(line, highlight=False, markup=False)
        if not checked.is_good:
            raise MeasurementError("cycle or life counter don't hold; see above")

    call(command, "plant check", arguments)
