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
    """Parse and switch."""

    def command(
        version: tyro.conf.Positional[str | None] = None, results: str | None = None,
        into: Path | None = None, store: str = DEFAULT_URL, revert: bool = False, by: str | None = None,
    ) -> None:  # fmt: skip
        """Switch what the page and the plant see to a version, all its recordings at once; or take that back.

        Args:
            version: Version, by the beginning of its name.
            results: Folder or URL of what was measured.
            into: Folder of this machine that the results are copied to; the page reads them there.
            store: SQLAlchemy's URL of the database.
            revert: Switch back to what was promoted before, or to what the store had without.
            by: Who switches, for the audit log; the name of the user if not given.
        """
        with extra("fleet"):
            from barsight.fleet.objects import open_objects
            from barsight.fleet.promoting import promote, take_back
            from barsight.fleet.records import find_version, read_tasks
        who, console = by or user_name(), SafeConsole()
        with open_store(store) as opened:
            if revert:
                before = take_back(opened, who)
                told = f"promoted again: version {before}" if before else "no version is promoted any more"
                console.print(told, highlight=False)
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
