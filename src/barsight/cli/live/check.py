"""Run `barsight live check --config crane.toml`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro

from barsight.cli.arguments import call
from barsight.cli.safe_console import SafeConsole
from barsight.core.errors import MeasurementError
from barsight.live.crane.check import check_machine
from barsight.live.settings import read_crane

WORDS = {True: "ok", False: "FAILED", None: "note"}


def run(arguments: Sequence[str]) -> None:
    """Parse the arguments, check the machine and print the findings."""

    def command(
        config: Path, out: Annotated[Path, tyro.conf.arg(aliases=("-o",))] = Path(),
    ) -> None:  # fmt: skip
        """Check that this machine can run live: cores, memory, disks, network, cameras, readings, clocks.

        Prints a line for each: item, finding, requirement and, on failure, a remedy. The exit code is 5 if
        something that a run needs fails; `note` marks what the system does not report or a run does not need.

        Args:
            config: crane.toml.
            out: Folder in which runs will write.
        """
        console, failed = SafeConsole(), []
        for one in check_machine(read_crane(config), out):
            line = f"{WORDS[one.passed]:<7}{one.what}: {one.found} (needed: {one.needed})"
            if one.passed is not True and one.remedy:
                line += f"; {one.remedy}"
            console.print(line, highlight=False, soft_wrap=True, markup=False)
            if one.passed is False:
                failed.append(one.what)
        if failed:
            raise MeasurementError(f"this machine can't run live: {', '.join(failed)}")

    call(command, "live check", arguments)
