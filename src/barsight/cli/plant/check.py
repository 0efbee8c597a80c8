"""Run `barsight plant check --config plant.toml`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from barsight.cli.arguments import call
from barsight.cli.safe_console import SafeConsole
from barsight.core.errors import ConfigError, MeasurementError
from barsight.plant.links.checks import check_links, write_protocol
from barsight.plant.settings import read_plant
from barsight.report.signing import sign_file


def run(arguments: Sequence[str]) -> None:
    """Parse the arguments, check the links and print the findings."""

    def command(
        config: Path, seconds: float = 5.0, protocol: Path | None = None, key: Path | None = None
    ) -> None:
        """Check each link in plant.toml from its other side: data, rate, and changes of the life counter.

        No lift is claimed. The exit code is 5 if a link fails.

        Args:
            config: plant.toml.
            seconds: Time, in seconds, over which the telegram's cycle is observed.
            protocol: A text file to write for the commissioning folder.
            key: Ed25519 key (PEM) that signs the protocol; the signature is written next to it as NAME.sig.
        """
        if key is not None and protocol is None:
            raise ConfigError("--key signs a protocol: give --protocol too")
        checks, console = check_links(read_plant(config), seconds), SafeConsole()
        for one in checks:
            console.print(f"{one.link}: {'holds' if one.is_good else 'does not hold'}", highlight=False)
            for line in one.lines:
                console.print(f"  {line}", highlight=False, markup=False)
        if protocol is not None:
            write_protocol(protocol, config, checks)
        if protocol is not None and key is not None:
            sign_file(protocol, key)
        if wrong := [one.link for one in checks if not one.is_good]:
            raise MeasurementError(f"{', '.join(wrong)}: does not hold; see above")

    call(command, "plant check", arguments)
