"""Run `barsight demo`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro

from barsight.cli.arguments import call
from barsight.cli.measure import print_outcome
from barsight.cli.progress import stages
from barsight.cli.safe_console import SafeConsole
from barsight.core.compiling.ahead import compile_ahead
from barsight.core.files import atomic_path, expect_empty
from barsight.measure_folder import measure_into
from barsight.measure_settings import MeasureSettings
from barsight.simulation.settings import SimulationSettings
from barsight.simulation.simulate import simulate
from barsight.yard.magnet.description import example_magnet


def run(arguments: Sequence[str]) -> None:
    """Parse and show."""

    def command(out: Annotated[Path, tyro.conf.arg(aliases=("-o",))] = Path("demo")) -> None:
        """Simulate a small yard, measure it, and compare with its truth and its simulated laser.

        Args:
            out: A new folder for the recording (OUT/recording), the example magnet that lifts are chosen for
                (OUT/magnet.toml) and the results (OUT/result).
        """
        console = SafeConsole(stderr=True)
        recording, magnet, result = (out / name for name in ("recording", "magnet.toml", "result"))
        expect_empty(out)
        console.print("Simulating a small yard ...")
        with stages(console) as advance:
            compile_ahead(advance, "simulate", "measure")
            simulate(recording, SimulationSettings.demo(), lambda n, total: advance("render", n, total))
        with atomic_path(magnet) as path:
            path.write_text(example_magnet(), encoding="utf-8")
        console.print("Measuring it; lifts are chosen for the example magnet, as of the recording's end ...")
        with stages(console) as advance:
            content = measure_into(
                recording, result, MeasureSettings(), advance=advance, truth_of=recording, magnet=magnet,
                judged_at="end",
            )  # fmt: skip
        print_outcome(content, console, verbose=False)
        console.print(f"report: {result / 'report.html'}", soft_wrap=True, highlight=False, markup=False)
        console.print(f"in 3D:  barsight view {result}", soft_wrap=True, highlight=False, markup=False)

    call(command, "demo", arguments)
