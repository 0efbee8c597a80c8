"""Run `barsight fleet compare BEFORE AFTER -o OUT`."""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Annotated

import tyro

from barsight.cli.arguments import call
from barsight.cli.progress import stages
from barsight.cli.safe_console import SafeConsole
from barsight.core.errors import ConfigError, MeasurementError
from barsight.core.extras import extra
from barsight.core.files import atomic_directory
from barsight.core.json_values import json_value
from barsight.fleet.versions import Version
from barsight.store.opening import DEFAULT_URL, open_store


def run(arguments: Sequence[str]) -> None:
    """Parse the arguments, compare the versions and write the comparison."""

    def command(
        before: tyro.conf.Positional[str],
        after: tyro.conf.Positional[str],
        results: str,
        out: Annotated[Path, tyro.conf.arg(aliases=("-o",))],
        store: str = DEFAULT_URL,
    ) -> None:
        """Compare two versions over the archive: bundles moved beyond sigma, vetoes, intervals, times.

        Writes comparison.json, comparison.html and its pictures. Findings, such as vetoes that appeared or
        vanished, are significant by Holm's rule, at 5 % for any false one among all figures.

        Args:
            before: Version, given by the beginning of its name.
            after: The other version.
            results: Folder or URL of the results.
            out: Folder for the comparison; it must be new or empty.
            store: SQLAlchemy URL of the database.
        """
        with extra("fleet"):
            from barsight.fleet.comparison.comparing import compare_tasks
            from barsight.fleet.comparison.comparison_page import comparison_page, copy_pictures
            from barsight.fleet.comparison.findings import judge
            from barsight.fleet.objects import open_objects
            from barsight.fleet.records import find_version, read_tasks
        target = open_objects(results)
        with open_store(store) as opened, opened.reading() as connection:
            versions = _expect_two([find_version(connection, name) for name in (before, after)])
            planned = [read_tasks(connection, one) for one in versions]
        with stages(SafeConsole(stderr=True)) as advance:
            compared, untold = compare_tasks(target, planned[0], planned[1], partial(advance, "compare"))
        if not compared:
            raise MeasurementError(
                f"versions {versions[0].name} and {versions[1].name}: no recording is measured under both; "
                "run both first"
            )
        findings = judge(versions[0].name, versions[1].name, compared, untold)
        with atomic_directory(out) as staging:
            text = json.dumps(json_value(findings), indent=1, allow_nan=False)
            (staging / "comparison.json").write_text(text + "\n", encoding="utf-8")
            pictures = copy_pictures(target, findings, staging)
            (staging / "comparison.html").write_text(comparison_page(findings, pictures), encoding="utf-8")
        shifts, lifts = (
            ", ".join(f"{s.figure} {s.shift:+.4f}" for s in shifts if s.is_found) or "none"
            for shifts in (findings.shifts, findings.lifts)
        )
        console = SafeConsole()
        console.print(
            f"{len(compared)} recordings: {len(findings.beyond)} figures of bundles beyond sigma, shifts of "
            f"the archive: {shifts}, of its lifts' vetoes: {lifts}, "
            f"{sum(bool(one.vetoes) for one in compared)} with other vetoes of the map"
            + (f", {len(untold)} not compared" if untold else ""),
            highlight=False, soft_wrap=True,
        )  # fmt: skip
        console.print(f"page: {out / 'comparison.html'}", highlight=False, soft_wrap=True, markup=False)

    call(command, "fleet compare", arguments)


def _expect_two(versions: list[Version]) -> list[Version]:
    """Raise ConfigError for one version against itself: the comparison would say that nothing changed."""
    if versions[0].name == versions[1].name:
        raise ConfigError(f"BEFORE and AFTER name one version, {versions[0].name}; name two")
    return versions
