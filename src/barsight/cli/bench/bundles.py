"""Run `barsight bench bundles`: found bundles against true ones."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from rich.console import Console

from barsight.benchmarks.yard.bundle_detection import bench_bundles, rendered_yards
from barsight.benchmarks.yard.bundle_scores import (
    BundleErrors,
    bundle_report,
    bundle_table,
    join_scores,
    read_true_bundles,
    reliability,
    score_bundles,
)
from barsight.benchmarks.yard.yard_speed import time_yard
from barsight.cli.safe_console import SafeConsole
from barsight.core.errors import ConfigError
from barsight.core.json_values import write_json
from barsight.measure_folder import measure_into
from barsight.measure_settings import MeasureSettings
from barsight.result_folder import read_heights
from barsight.simulation.settings import SimulationSettings
from barsight.simulation.simulate import simulate
from barsight.yard.bundles.detection import find_bundles
from barsight.yard.bundles.fitting.settings import BundleSettings
from barsight.yard.inventory.bundle_file import read_bundles
from barsight.yard.magnet.description import load_magnet

Json = Annotated[Path | None, tyro.conf.arg(name="json")]


def bench_found_bundles(
    recording: Path | None = None,
    out: Path | None = None,
    yards: int = 32,
    length_m: float = 5.0,
    seed: int = 7,
    rendered: bool = False,
    keep: Path | None = None,
    save: Json = None,
) -> None:
    """Score found bundles against true ones: of drawn yards, of rendered ones, or of one measured recording.

    Args:
        recording: A simulated recording; with it goes `out`.
        out: The folder that `barsight measure` wrote for it.
        yards: Yards to draw; their exact surfaces get the errors of a measured map.
        length_m: Length of each drawn yard.
        seed: Seed of all that is drawn.
        rendered: Render the yards and measure them instead, half a minute of computing each.
        keep: Folder for the rendered yards; what is finished there is not done again.
        save: JSON file for all figures, with commit and machine.
    """
    if (recording is None) != (out is None):
        raise ConfigError("bench bundles: give both a recording and its measured folder, or neither")
    if yards < 1 or not 1 <= length_m <= 100:
        raise ConfigError("bench bundles: yards must be at least 1, length_m must lie between 1 and 100")
    seconds: tuple[float, ...] = ()
    console = SafeConsole()
    if recording is not None and out is not None:
        scores = score_bundles(read_bundles(out / "bundles.json"), read_true_bundles(recording))
    elif rendered:
        with tempfile.TemporaryDirectory() as scratch:
            scores, seconds = _bench_rendered(yards, seed, keep or Path(scratch), console)
    else:
        bench = bench_bundles(yards, seed, length_m)
        scores, seconds = bench.scores, bench.seconds
    console.print(bundle_table(scores))
    console.print(reliability(scores))
    if seconds:
        console.print(f"CPU time per yard to find its bundles: median {np.median(seconds):.1f} s")
    if recording is None and not rendered:
        console.print(str(time_yard(load_magnet(None), seed)))
    if save is not None:
        write_json(save, bundle_report(scores, seconds))


def _bench_rendered(
    yards: int, seed: int, keep: Path, console: Console
) -> tuple[BundleErrors, tuple[float, ...]]:
    """Score rendered yards: bundles are found anew in the kept maps, so that a kept folder judges the code as
    it is.
    """
    parts, seconds = [], []
    for number, settings in enumerate(rendered_yards(yards, seed)):
        recording, out = _measured(keep / f"seed_{seed}_yard_{number:02d}", settings)
        heights = read_heights(out)
        start = time.process_time()
        found = find_bundles(heights, BundleSettings())
        seconds.append(time.process_time() - start)
        part = score_bundles(found, read_true_bundles(recording))
        parts.append(part)
        console.print(
            f"yard {number}, {settings.bars}, up to {settings.yard.max_layers} layers: "
            f"{part.found} of {part.free} found, {part.wrong} of {part.claimed} false",
            highlight=False,
        )
    return join_scores(parts), tuple(seconds)


def _measured(folder: Path, settings: SimulationSettings) -> tuple[Path, Path]:
    """Render and measure the yard where its folders are not there yet."""
    recording, out = folder / "recording", folder / "measured"
    folder.mkdir(parents=True, exist_ok=True)
    if not recording.is_dir():
        simulate(recording, settings)
    if not (out / "result.json").is_file():
        measure_into(recording, out, MeasureSettings())
    return recording, out
