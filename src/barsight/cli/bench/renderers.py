"""Run `barsight bench renderers`: compare our renderer with path tracing by what is measured."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Annotated

import tyro

from barsight.benchmarks.provenance import provenance
from barsight.benchmarks.yard.renderers import RenderedScene, RendererBench, render_scenes, renderer_table
from barsight.cli.safe_console import SafeConsole
from barsight.core.json_values import write_json
from barsight.measure_folder import measure_into
from barsight.measure_settings import MeasureSettings


def bench_renderers(
    bars: tuple[str, ...] = ("20mm:61", "25mm:37", "32mm:37", "40mm:19", "60mm:19", "90mm:7"),
    seed: int = 1,
    paths: int = 36,
    keep: Annotated[Path | None, tyro.conf.arg(aliases=("-o",))] = None,
    save: Annotated[Path | None, tyro.conf.arg(name="json")] = None,
) -> None:
    """Simulate small yards by our renderer and by path tracing with Mitsuba, and measure both.

    Needs the extra `mitsuba` and LLVM (Debian's libllvm19). Six yards take about ten minutes on two cores.

    Args:
        bars: Kinds of bundles as bar diameter and number of bars, one yard of each.
        seed: Seed of the first yard; the others count up.
        paths: Number of paths per ray in Mitsuba, a square.
        keep: Folder for the recordings and results. Those already there are not repeated.
        save: JSON file for all figures, with commit and machine.
    """
    console = SafeConsole()

    def tell(scene: RenderedScene) -> None:
        console.print(f"{scene.bars} by {scene.renderer}: measured", highlight=False, markup=False)

    with tempfile.TemporaryDirectory() as scratch:
        folder = (keep or Path(scratch)).absolute()
        bench = RendererBench(render_scenes(bars, seed, paths, folder, _measure, tell), provenance())
    console.print(renderer_table(bench))
    if save is not None:
        write_json(save, bench)


def _measure(recording: Path, out: Path) -> None:
    measure_into(recording, out, MeasureSettings(), report=False, judged_at="end")
