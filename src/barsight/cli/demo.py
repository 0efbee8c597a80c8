"""Run `barsight demo`."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import tyro

from barsight.cli.arguments import call
from barsight.cli.measure import print_outcome
from barsight.cli.progress import stages
from barsight.cli.safe_console import SafeConsole
from barsight.core.compiling.ahead import compile_ahead
from barsight.core.errors import ConfigError
from barsight.core.extras import extra
from barsight.core.files import atomic_path, expect_empty
from barsight.measure_folder import measure_into
from barsight.measure_settings import MeasureSettings
from barsight.simulation.passes import simulate_passes
from barsight.simulation.settings.recording import SimulationSettings
from barsight.simulation.settings.travel import PassesSettings
from barsight.simulation.simulate import stream
from barsight.simulation.stock import stack_yard
from barsight.yard.magnet.description import example_magnet

PASSES = PassesSettings((0.0, 0.0), alternate=False, pause_s=3600.0, changes=("taken", "moved"))
RECORDINGS, RESULTS = ("recording", "recording_later"), ("result", "result_later")


def run(arguments: Sequence[str]) -> None:
    """Parse the arguments and run the demo."""

    def command(
        out: Annotated[Path, tyro.conf.arg(aliases=("-o",))] = Path("demo"), serve: bool = True
    ) -> None:
        """Simulate a small yard before and after a change, measure both, and serve the operator's page.

        The first survey is compared with its truth and its simulated laser.

        Args:
            out: A new folder for the recordings (OUT/recording, OUT/recording_later), the stock list
                (OUT/stock.csv), the example magnet that lifts are chosen for (OUT/magnet.toml), the results
                (OUT/result, OUT/result_later) and the store (OUT/yard.db).
            serve: Serve the page at the end, until Ctrl-C.
        """
        console = SafeConsole(stderr=True)
        expect_empty(out)
        console.print("Simulating a small yard, and an hour later, with one bundle taken and one moved ...")
        with stages(console) as advance:
            compile_ahead(advance, "simulate", "measure")
            _simulate(out, lambda n, total: advance("render", n, total))
        console.print("Measuring it; lifts are chosen for the example magnet, as of the recording's end ...")
        print_outcome(_measure(out, console, 0), console, verbose=False)
        _measure(out, console, 1)
        for what in (f"report: {out / 'result' / 'report.html'}", f"in 3D:  barsight view {out / 'result'}"):
            console.print_line(what)
        _show_page(out, console, serve=serve)

    call(command, "demo", arguments)


def _simulate(out: Path, advance: Any) -> None:
    """Write both recordings, the stock list at the time of the first one, and the magnet."""
    settings = replace(SimulationSettings.demo(), passes=PASSES)
    simulate_passes(out / "passes", settings, advance)
    for number, name in enumerate(RECORDINGS, start=1):
        (out / "passes" / f"pass_{number}").rename(out / name)
    (out / "passes").rmdir()
    with atomic_path(out / "magnet.toml") as path:
        path.write_text(example_magnet(), encoding="utf-8")
    with atomic_path(out / "stock.csv") as path, path.open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file)
        table.writerow(("name", "x_m", "y_m", "length_m"))
        for number, one in enumerate(stack_yard(settings, stream(settings, 0)).bundles, start=1):
            table.writerow(
                (f"A{number:02}", *(round(float(v), 2) for v in one.centre_m[:2]), round(one.length_m, 2))
            )


def _measure(out: Path, console: SafeConsole, number: int) -> dict[str, Any]:
    """Measure one of the recordings; the first is also compared with its truth."""
    settings = MeasureSettings()
    settings = replace(settings, bundles=replace(settings.bundles, stock_list=out / "stock.csv"))
    recording = out / RECORDINGS[number]
    with stages(console) as advance:
        return measure_into(
            recording, out / RESULTS[number], settings, advance=advance,
            truth_of=recording if number == 0 else None, magnet=out / "magnet.toml", judged_at="end",
        )  # fmt: skip


def _show_page(out: Path, console: SafeConsole, *, serve: bool) -> None:
    """Add both results to a store and serve its page, or say which extra is missing."""
    url = f"sqlite:///{out / 'yard.db'}"
    try:
        with extra("store,page"):
            from barsight.page.api import serve as page
            from barsight.store.adding import add_survey, read_survey
            from barsight.store.audit import user_name
            from barsight.store.opening import open_store
    except ConfigError:
        added = " && ".join(f"barsight store add {url} {out / name}" for name in RESULTS)
        for line in (
            f"page:   pip install 'barsight[store,page]', then {added}",
            f"        and barsight serve --store {url}",
        ):
            console.print_line(line)
        return
    with open_store(url, create=True) as store:
        for name in RESULTS:
            add_survey(store, read_survey(out / name), user_name())
    if serve:
        console.print("page:", end="   ", highlight=False)
        page.serve(url, page.ServeOptions(port=0))
    else:
        console.print_line(f"page:   barsight serve --store {url}")
