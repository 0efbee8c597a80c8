"""Run `barsight store user URL NAME`."""

from __future__ import annotations

from collections.abc import Sequence

import tyro

from barsight.cli.arguments import call
from barsight.cli.store.password import ask_password
from barsight.store.accounts import Role, add_person, withdraw
from barsight.store.audit import entry, user_name
from barsight.store.opening import open_store


def run(arguments: Sequence[str]) -> None:
    """Parse the arguments, ask for the password and add the account."""

    def command(
        url: tyro.conf.Positional[str], name: tyro.conf.Positional[str], role: Role = "operator",
        remove: bool = False,
    ) -> None:  # fmt: skip
        """Add a person who may log in to the page, change role and password, or withdraw the account.

        The command asks for the password; if the input is not a terminal, its first line is the password.

        Args:
            url: SQLAlchemy URL of the database.
            name: The person's name.
            role: viewer, operator, engineer or service.
            remove: Withdraw the account.
        """
        password = "" if remove else ask_password()
        with open_store(url) as store, entry(store, user_name(), f"account {name}") as opened:
            if remove:
                withdraw(opened, name)
            else:
                add_person(opened, name, role, password)

    call(command, "store user", arguments)
