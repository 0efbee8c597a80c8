"""Run `barsight store verify URL`."""

from __future__ import annotations

from collections.abc import Sequence

import tyro

from barsight.cli.arguments import call
from barsight.cli.safe_console import SafeConsole
from barsight.core.errors import Failed, MeasurementError
from barsight.store.audit import verify_chain
from barsight.store.opening import DEFAULT_URL, open_store


def run(arguments: Sequence[str]) -> None:
    """Parse the arguments, verify the chain and print the result."""

    def command(url: tyro.conf.Positional[str] = DEFAULT_URL) -> None:
        """Verify the audit chain and the rows that it covers; exit code 5 names the first that is invalid.

        Prints the number of rows and the last digest. A chain that was cut off at its end is also valid, so
        note both elsewhere and compare them.

        Args:
            url: SQLAlchemy URL of the database.
        """
        with open_store(url) as store, store.reading() as connection:
            chain = verify_chain(connection)
        if isinstance(chain, Failed):
            raise MeasurementError(f"{store.name}: {chain.reason}")
        message = f"the audit log is valid: {chain.entries} rows; the last digest is {chain.digest}"
        SafeConsole().print(message, highlight=False, soft_wrap=True)

    call(command, "store verify", arguments)
