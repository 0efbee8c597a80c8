"""Run `barsight fleet plan ARCHIVE --store URL --results URL`."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import tyro

from barsight.cli.arguments import call, load_settings
from barsight.cli.progress import stages
from barsight.cli.safe_console import SafeConsole
from barsight.core.errors import ConfigError, InputError
from barsight.core.extras import extra
from barsight.measure_settings import MeasureSettings
from barsight.store.audit import user_name
from barsight.store.opening import DEFAULT_URL, open_store


def run(arguments: Sequence[str]) -> None:
    """Parse the arguments, plan and print."""

    def command(
        archive: tyro.conf.Positional[str], results: str, store: str = DEFAULT_URL,
        config: Path | None = None, rig: Path | None = None, magnet: Path | None = None,
        limit: int | None = None, workers: int = 1, by: str | None = None,
    ) -> None:  # fmt: skip
        """Find an archive's recordings and plan their measurement.

        Prints how many are new, done and parked, and estimates hours and gigabytes. Nothing is measured.
        Unreadable recordings are named and left out, and the exit code is then 3.

        A folder with survey.json, {"passes": ["first", "second"]}, is one survey of several passes.

        Args:
            archive: Folder or s3://, az://, gs:// URL that contains the recordings.
            results: Folder or URL for the results.
            store: SQLAlchemy URL of the database.
            config: TOML file of settings, as for barsight measure.
            rig: Calibration to use instead of the recordings' own.
            magnet: TOML file of the magnet that lifts are chosen for.
            limit: Maximum number of recordings to plan, in the order of their names.
            workers: Number of workers for which the hours are estimated.
            by: Name for the audit log; by default the name of the user.
        """
        with extra("fleet"):
            from barsight.fleet.ledger import parked_keys, published_keys
            from barsight.fleet.objects import open_objects
            from barsight.fleet.planning import estimate, plan_tasks
            from barsight.fleet.records import note_plan, seconds_by_size
            from barsight.fleet.versions import publish_version
        for flag, value in {"workers": workers, "limit": limit}.items():
            if value is not None and value < 1:
                raise ConfigError(f"--{flag} {value}: give 1 or more")
        settings = load_settings(config, MeasureSettings)
        left_out: list[InputError] = []
        source, target = open_objects(archive), open_objects(results, create=True)
        version = publish_version(target, settings, config, rig, magnet)
        with stages(SafeConsole(stderr=True)) as advance:
            tasks = plan_tasks(source, target, version, limit, partial(advance, "read"), left_out.append)
        with open_store(store, create=True) as opened:
            new = note_plan(opened, tasks, by or user_name())
            with opened.reading() as connection:
                measured = seconds_by_size(connection)
        ended = {"done": published_keys(target), "parked": parked_keys(target)}
        left = [task for task in tasks if not any(task.key in keys for keys in ended.values())]
        words = [f"{new} new in the plan", f"{len(left)} to do"]
        words[1:1] = [f"{sum(t.key in keys for t in tasks)} {name}" for name, keys in ended.items()]
        _tell(f"version {version.name}: {len(tasks)} recordings, {', '.join(words)}")
        _tell_work(estimate(left, measured), workers)
        for error in left_out:
            _tell(f"left out: {error}", stderr=True)
        if left_out:
            raise InputError(
                archive, f"{len(left_out)} recordings are left out of the plan, the others are in it",
                "repair those named above and plan again",
            )  # fmt: skip

    call(command, "fleet plan", arguments)


def _tell_work(work: Any, workers: int) -> None:
    basis = f"by {work.known} measured" if work.known else "roughly: none was measured yet"
    _tell(
        f"about {work.seconds / 3600 / workers:.2f} h with {workers} workers, "
        f"{work.fetched_bytes / 1e9:.2f} GB to fetch, {work.written_bytes / 1e9:.2f} GB to write ({basis})"
    )


def _tell(line: str, *, stderr: bool = False) -> None:
    SafeConsole(stderr=stderr).print(line, highlight=False, soft_wrap=True, markup=False)
