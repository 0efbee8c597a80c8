"""Run `barsight plant user NAME --config plant.toml`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import tyro

from barsight.cli.arguments import call
from barsight.cli.store.password import ask_password
from barsight.core.errors import ConfigError
from barsight.plant.settings import read_plant


def run(arguments: Sequence[str]) -> None:
    """Parse the arguments, ask for the password and add the user."""

    def command(
        name: tyro.conf.Positional[str],
        config: Path,
        role: Literal["viewer", "operator", "engineer"] = "operator",
    ) -> None:
        """Add a user of the OPC UA server to the file named by opcua.users, or change role and password.

        The command asks for the password; if the input is not a terminal, its first line is the password.
        A running server reads the file at its next start.

        Args:
            name: The user's name.
            config: plant.toml.
            role: viewer, operator or engineer.
        """
        from barsight.plant.opcua.security.access import add_user  # an extra that only OPC UA needs

        opcua = read_plant(config).opcua
        if opcua is None or opcua.users is None:
            raise ConfigError(f'{config}: name the file of the users first: [opcua] users = "users.json"')
        add_user(opcua.users, name, role, ask_password())

    call(command, "plant user", arguments)
