"""Run `barsight measure RECORDING [RECORDING ...] -o OUT`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from barsight.cli.arguments import call, config_path, load_settings
from barsight.cli.progress import stages
from barsight.cli.safe_console import SafeConsole
from barsight.measure_folder import measure_into
from barsight.measure_settings import MeasureSettings


def run(arguments: Sequence[str]) -> None:
    """Parse the arguments and measure."""
    default = load_settings(config_path(arguments), MeasureSettings)

    def command(
        recordings: tyro.conf.Positional[tuple[Path, ...]],
        out: Annotated[Path, tyro.conf.arg(aliases=("-o",))],
        settings: Annotated[MeasureSettings, tyro.conf.arg(name="")] = default,
        config: Path | None = None,
        magnet: Path | None = None,
        at: Literal["now", "end"] = "now",
        overwrite: bool = False,
        resume: bool = False,
        verbose: Annotated[bool, tyro.conf.arg(aliases=("-v",))] = False,
    ) -> None:
        """Measure a stereo recording, or several passes over one yard, into OUT.

        The results are map, contours, trajectory, cloud and report.html.

        The recording may be an EuRoC folder, a KITTI odometry sequence or a ROS bag; barsight info shows
        its content. Crane encoders give the trajectory in the yard; without them, stereo odometry does.
        OUT is written completely or not at all.

        Args:
            recordings: The recording; or several passes over one yard by one crane with encoders, in any
                order. They become one map, in which the newer pass takes precedence where the yard changed.
            out: The folder for the results.
            settings: Settings of the stages.
            config: TOML file with settings; flags take precedence.
            resume: Keep intermediate results next to OUT until the end; to continue a killed run,
                repeat the command.
            magnet: TOML file of the magnet that lifts are chosen for (docs/how-to/describe-a-magnet.md).
                Without it, no lift is offered.
            at: Time at which lifts are judged: now, or the recording's end for review, never for a crane.
            overwrite: Replace the result files of an earlier run in OUT.
            verbose: Print the time that each stage took.
        """
        console = SafeConsole(stderr=True)
        with stages(console) as advance:
            measured = measure_into(
                recordings, out, settings, advance=advance, overwrite=overwrite, resume=resume, magnet=magnet,
                judged_at=at,
            )  # fmt: skip
        print_outcome(measured, console, verbose=verbose)
        console.print_line(f"report: {out / 'report.html'}")

    call(command, "measure", arguments)


def print_outcome(content: dict[str, Any], console: Console, *, verbose: bool) -> None:
    """Summarise the run in a few lines: frames, agreement with the laser, truth, warnings."""
    frames, trajectory = content["frames"], content["trajectory"]
    passed_over = frames["passed_over"]["count"]
    hardly_moved = f" ({passed_over} had hardly moved)" if passed_over else ""
    console.print(
        f"{frames['used']} of {frames['total']} frames{hardly_moved} over {trajectory['length_m']:.2f} m "
        f"({', '.join(content['sensors_used'])}), {content['map']['cells_seen']} cells of "
        f"{1e3 * content['map']['cell_m']:.0f} mm seen, peak memory {content['peak_memory_mib']:.0f} MiB",
        highlight=False,
    )
    if content["agreement"]:
        console.print(_agreement_table(content["agreement"]))
    if content["truth"]:
        console.print(_truth_table(content["truth"]))
    for warning in content["warnings"]:
        console.print(f"[yellow]{escape(warning['code'])}:[/yellow] {escape(warning['message'])}")
    if verbose:
        table = Table("stage", "seconds", "per frame", title="Time by stage (worker seconds)")
        for stage in content["stages"]:
            each = f"{stage['seconds'] / stage['frames']:.3f}" if stage["frames"] else ""
            table.add_row(stage["name"], f"{stage['seconds']:.2f}", each)
        console.print(table)
        for refused in frames["refused"]:
            console.print(f"refused {refused['stamp_ns']} ({refused['stage']}): {escape(refused['reason'])}")


def _agreement_table(agreements: list[dict[str, Any]]) -> Table:
    heads = {
        "bias": "bias", "median": "median", "smooth_mae": "smooth MAE",
        "mae": "MAE", "p95": "P95", "max": "max", "equivalence": "equal ±",
    }  # fmt: skip
    table = Table(title="Vision minus laser, mm", box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for head in ("prof.", "y m", "seen %", *heads.values()):
        table.add_column(head, justify="right", no_wrap=True)
    for a in agreements:
        numbers = (a[f"{name}_mm"] for name in heads)
        cells = ("-" if n is None else f"{n:.1f}" for n in numbers)
        table.add_row(str(a["profile"]), f"{a['y_m']:.2f}", f"{a['coverage_pct']:.1f}", *cells)
    return table


def _truth_table(truth: dict[str, dict[str, float]]) -> Table:
    heads = {
        "coverage_pct": "seen %", "bias_mm": "bias", "median_mm": "median", "mae_mm": "MAE", "p95_mm": "P95",
        "within_95_pct": "in 95 %",
    }  # fmt: skip
    table = Table(title="Vision minus truth, mm", box=SIMPLE_HEAD)
    table.add_column("places", no_wrap=True)
    for head in heads.values():
        table.add_column(head, justify="right", no_wrap=True)
    for name, figures in truth.items():
        cells = (f"{figures[key]:.1f}" if key in figures else "-" for key in heads)
        table.add_row(name, *cells)
    return table
