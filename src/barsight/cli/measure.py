"""`barsight measure RECORDING -o OUT`."""

from __future__ import annotations

import shutil
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
from barsight.core.errors import OutputError
from barsight.core.files import atomic_directory
from barsight.evaluation.truth import score
from barsight.pipeline import MeasureSettings, measure
from barsight.recording.open import open_recording
from barsight.report.files import RESULT_FILES, summary, write_results, write_summary, write_surface
from barsight.report.page import write_report
from barsight.yard.magnet import load_magnet


def run(arguments: Sequence[str]) -> None:
    """Parse and measure."""
    default = load_settings(config_path(arguments), MeasureSettings)

    def command(
        recording: tyro.conf.Positional[Path],
        out: Annotated[Path, tyro.conf.arg(aliases=("-o",))],
        settings: Annotated[MeasureSettings, tyro.conf.arg(name="")] = default,
        config: Path | None = None,
        magnet: Path | None = None,
        at: Literal["now", "end"] = "now",
        overwrite: bool = False,
        resume: bool = False,
        verbose: Annotated[bool, tyro.conf.arg(aliases=("-v",))] = False,
    ) -> None:
        """Measure a stereo recording into OUT: map, contours, trajectory, cloud and report.html.

        The recording may be an EuRoC folder, a KITTI odometry sequence or a ROS bag; barsight info shows
        what is in it. Crane encoders give the trajectory in the yard; without them stereo odometry does.
        OUT is written whole or not at all.

        Args:
            recording: The recording.
            out: The folder for the results.
            settings: Settings of the stages.
            config: TOML file with settings; flags go before it.
            resume: Keep what is done beside OUT until the end; a killed run started again with it goes on.
            magnet: TOML file of the magnet that lifts are chosen for (docs/how-to/describe-a-magnet.md).
                Without it nothing is offered.
            at: When lifts are judged: now, or at the end of the recording, to look back; never for a crane.
            overwrite: Replace the result files of an earlier run in OUT.
            verbose: Print the time that each stage took.
        """
        console = Console(stderr=True)
        measured = measure_into(
            recording, out, settings, console, overwrite=overwrite, resume=resume, magnet=magnet, judged_at=at
        )
        print_outcome(measured, console, verbose=verbose)
        console.print(f"report: {out / 'report.html'}", soft_wrap=True, highlight=False, markup=False)

    call(command, "measure", arguments)


def measure_into(
    path: Path,
    out: Path,
    settings: MeasureSettings,
    console: Console,
    *,
    overwrite: bool = False,
    resume: bool = False,
    truth_of: Path | None = None,
    magnet: Path | None = None,
    judged_at: Literal["now", "end"] = "now",
) -> dict[str, Any]:
    """Measure, write all files and the report into `out`, and return what result.json says.

    resume: keep what is done in `.NAME.resume` beside `out`, and go on from what is there.
    truth_of: a recording with truth to score against; only after the measuring is done.
    judged_at: when lifts are judged, see `barsight.pipeline.measure`.
    """
    if out.resolve() == path.resolve() or path.resolve() in out.resolve().parents:
        raise OutputError(f"{out}: lies in the recording itself; name a folder elsewhere")
    recording = open_recording(path, settings.recording)
    keep = out.absolute().with_name(f".{out.absolute().name}.resume") if resume else None
    described = load_magnet(magnet) if magnet is not None else None
    with atomic_directory(out, replace=overwrite, owned=RESULT_FILES) as staging:
        scratch = staging / "scratch"
        scratch.mkdir()
        with stages(console) as advance:
            measured = measure(
                recording, settings, scratch, advance, keep, described,
                lambda surface, free: write_surface(surface, free, staging), judged_at,
            )  # fmt: skip
        content = summary(measured)
        write_results(measured, staging)
        shutil.rmtree(scratch)
        if truth_of is not None:
            content["truth"] = score(truth_of, staging)
        write_summary(content, staging / "result.json")
        write_report(staging, staging / "report.html")
    if keep is not None:
        shutil.rmtree(keep, ignore_errors=True)
    return content


def print_outcome(content: dict[str, Any], console: Console, *, verbose: bool) -> None:
    """The run in a few lines: frames, agreement with the laser, truth, warnings."""
    frames, trajectory = content["frames"], content["trajectory"]
    console.print(
        f"{frames['used']} of {frames['total']} frames over {trajectory['length_m']:.2f} m "
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
        "mae": "MAE", "p95": "P95", "max": "max",
    }  # fmt: skip
    table = Table(title="Vision minus laser, mm", box=SIMPLE_HEAD)
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
