"""Run `barsight store keep URL RECORDING WHY`."""

from __future__ import annotations

from collections.abc import Sequence

import tyro

from barsight.cli.arguments import call
from barsight.cli.safe_console import SafeConsole
from barsight.store.audit import entry, user_name
from barsight.store.opening import open_store
from barsight.store.recordings import keep_recording, release_recording


def run(arguments: Sequence[str]) -> None:
    """Parse the arguments, change the protection and print the result."""

    def command(
        url: tyro.conf.Positional[str], recording: tyro.conf.Positional[str],
        why: tyro.conf.Positional[str], release: bool = False, by: str | None = None,
    ) -> None:  # fmt: skip
        """Protect a recording from deletion, with a reason.

        A folder on this computer gets a file PROTECTED,
        so that a crane's recorder does not delete it when the disk fills up.

        Args:
            url: SQLAlchemy URL of the database.
            recording: Its path, or the beginning of its SHA-256; `store list` shows both.
            why: The reason.
            release: Remove the protection, for this reason.
            by: Name for the audit log; by default the name of the user.
        """
        change = release_recording if release else keep_recording
        with open_store(url) as store, entry(store, by or user_name(), f"recording {recording}") as opened:
            key = change(opened, recording, why)
        message = f"{key} is {'released' if release else 'kept'}: {why}"
        SafeConsole().print(message, highlight=False, soft_wrap=True)

    call(command, "store keep", arguments)
