"""Run `barsight live soak OUT -o SOAK`, `live soak --replay RECORDING -o SOAK [-- FLAGS OF LIVE]`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro

from barsight.cli.arguments import call
from barsight.cli.safe_console import SafeConsole
from barsight.core.errors import ConfigError, MeasurementError
from barsight.live.soak.report import UNSURE, SoakBounds, soak_table
from barsight.live.soak.run import SoakPlan, soak_replays, soak_run

BOUNDS = SoakBounds()


def run(arguments: Sequence[str]) -> None:
    """Parse the arguments, run the soak test and print its result."""
    cut = arguments.index("--") if "--" in arguments else len(arguments)
    own, flags = arguments[:cut], arguments[cut + 1 :]

    def command(
        out: Annotated[Path, tyro.conf.arg(aliases=("-o",))],
        run: Annotated[Path | None, tyro.conf.Positional] = None,
        replay: Path | None = None,
        hours: float | None = None,
        warm_up_h: float = 0.5,
        faults_after_h: float | None = None,
        seed: int = 0,
        bounds: SoakBounds = BOUNDS,
    ) -> None:  # fmt: skip
        """Soak-test a live run for hours or weeks: its memory, open descriptors and recovery from faults.

        Writes soak.json and soak.md every minute and at the end: after --hours, on Ctrl-C, or when the run
        has gone. The exit code is 5 if a bound is broken, or if it is too early to tell.

        Args:
            out: An empty or new folder for the two files.
            run: OUT of a barsight live that is already running, such as that of its service.
            replay: A recording to replay over and over in a run of its own instead; flags for that live run
                follow at the end, after --.
            hours: Duration in hours from the beginning; by default until Ctrl-C.
            warm_up_h: Hours during which memory may grow.
            faults_after_h: Hours after which the run's processes are killed, one at a time at random moments.
            seed: Random seed of these moments.
            bounds: Bounds that the run must stay within.
        """
        if (run is None) == (replay is None):
            raise ConfigError("live soak needs OUT of a run that goes on, or --replay RECORDING")
        if run is not None and flags:
            raise ConfigError("flags after -- are for --replay: a run that goes on has its own")
        plan = SoakPlan(
            hours or math.inf, warm_up_h, math.inf if faults_after_h is None else faults_after_h, seed
        )
        console = SafeConsole(stderr=True)
        tell = console.print_line
        if replay is not None:
            found = soak_replays(replay, out, plan, bounds, flags, tell)
        else:
            assert run is not None
            found = soak_run(run, out, plan, bounds, tell)
        SafeConsole().print_line(soak_table(found))
        if wrong := [*found["broken"], *found[UNSURE]]:
            name = "bounds are broken" if found["broken"] else "not sure yet, soak longer"
            raise MeasurementError(f"{name}: {'; '.join(wrong)}")

    call(command, "live soak", own)
