"""Run `barsight fleet promote VERSION --into FOLDER`, or with --revert."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import tyro

from barsight.cli.arguments import call
from barsight.cli.progress import stages
from barsight.cli.safe_console import SafeConsole
from barsight.core.errors import ConfigError
from barsight.core.extras import extra
from barsight.store.audit import user_name
from barsight.store.opening import DEFAULT_URL, open_store


def run(arguments: Sequence[str]) -> None:
    """Parse the arguments and switch the version."""

    def command(
        version: tyro.conf.Positional[str | None] = None, results: str | None = None,
        into: Path | None = None, store: str = DEFAULT_URL, revert: bool = False, by: str | None = None,
    ) -> None:  # fmt: skip
        """Switch the page and the plant to a version, for all its recordings at once, or undo that.

        Args:
            version: Version, by the beginning of its name.
            results: Folder or URL of the results.
            into: Folder on this machine to which the results are copied and from which the page reads them.
            store: SQLAlchemy URL of the database.
            revert: Switch back to the version promoted before, or to the store's own results without one.
            by: Name for the audit log; by default the name of the user.
        """
        with extra("fleet"):
            from barsight.fleet.objects import open_objects
            from barsight.fleet.promoting import promote, take_back
            from barsight.fleet.records import find_version, read_tasks
        who, console = by or user_name(), SafeConsole()
        with open_store(store) as opened:
            if revert:
                before = take_back(opened, who)
                message = f"promoted again: version {before}" if before else "no version is promoted any more"
                console.print(message, highlight=False)
                return
            if version is None or results is None or into is None:
                raise ConfigError("fleet promote needs a version, --results and --into; or --revert")
            with opened.reading() as connection:
                chosen = find_version(connection, version)
                tasks = read_tasks(connection, chosen)
            with stages(SafeConsole(stderr=True)) as advance:
                count = promote(
                    opened, open_objects(results), chosen, tasks, into, who,
                    lambda done, total: advance("fetch", done, total),
                )  # fmt: skip
        console.print(f"promoted version {chosen.name}: {count} surveys", highlight=False)

    call(command, "fleet promote", arguments)
