"""Run `barsight bench bundles`: compare found bundles with the true ones."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from rich.console import Console

from barsight.benchmarks.yard.bundle_detection import drawn_yards, rendered_yards, score_drawn
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
from barsight.cli.bench.seeds import over_seeds
from barsight.cli.safe_console import SafeConsole
from barsight.core.errors import ConfigError
from barsight.core.json_values import write_json
from barsight.measure_folder import measure_into
from barsight.measure_settings import MeasureSettings
from barsight.result_folder import read_heights
from barsight.simulation.settings.recording import SimulationSettings
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
    workers: int = 1,
    scheduler: str | None = None,
    save: Json = None,
) -> None:
    """Score found bundles against true ones: of drawn yards, of rendered yards, or of one measured recording.

    Args:
        recording: A simulated recording; it needs `out`.
        out: The folder of results from `barsight measure` for that recording.
        yards: Number of yards to draw; errors of a measured map are added to their exact surfaces.
        length_m: Length of each drawn yard, in metres.
        seed: Random seed of all that is drawn.
        rendered: Render the yards and measure them instead, which takes half a minute each.
        keep: Folder for the rendered yards; yards already finished there are not repeated.
        workers: Number of yards processed at a time, each in a process of its own.
        scheduler: Address of a Dask scheduler, tcp://HOST:PORT, whose workers are used instead; they share
            the folder of --keep.
        save: JSON file for all figures, with commit and machine.
    """
    if (recording is None) != (out is None):
        raise ConfigError("bench bundles: give both a recording and its measured folder, or neither")
    if yards < 1 or not 1 <= length_m <= 100:
        raise ConfigError("bench bundles: yards must be at least 1, length_m must lie between 1 and 100")
    if seed < 0:
        raise ConfigError(f"bench bundles: seed must be at least 0, not {seed}")
    seconds: tuple[float, ...] = ()
    console = SafeConsole()
    if recording is not None and out is not None:
        scores = score_bundles(read_bundles(out / "bundles.json"), read_true_bundles(recording))
    else:
        if rendered and scheduler is not None and keep is None:
            raise ConfigError("bench bundles: workers of --scheduler share a folder: name it with --keep")
        drawn = tuple(rendered_yards(yards, seed) if rendered else drawn_yards(yards, seed, length_m))
        with tempfile.TemporaryDirectory() as scratch:
            folder = (keep or Path(scratch)).absolute() / f"seed_{seed}" if rendered else None
            found = dict[int, tuple[BundleErrors, float]]()
            for number, one in over_seeds(_score, range(yards), (drawn, folder), workers, scheduler):
                found[number] = one
                if rendered:
                    _tell(console, number, drawn[number], one[0])
        scores = join_scores([found[number][0] for number in range(yards)])
        seconds = tuple(
            found[number][1] for number in range(0 if rendered else 1, yards)
        )  # the first run compiles
    console.print(bundle_table(scores))
    console.print(reliability(scores))
    if seconds:
        console.print(f"CPU time per yard to find its bundles: median {np.median(seconds):.1f} s")
    if recording is None and not rendered:
        console.print(str(time_yard(load_magnet(None), seed)))
    if save is not None:
        write_json(save, bundle_report(scores, seconds))


def _tell(console: Console, number: int, settings: SimulationSettings, part: BundleErrors) -> None:
    console.print(
        f"yard {number}, {settings.bars}, up to {settings.yard.max_layers} layers: "
        f"{part.found} of {part.free} found, {part.wrong} of {part.claimed} false",
        highlight=False,
    )


def _score(
    number: int, given: tuple[tuple[SimulationSettings, ...], Path | None]
) -> tuple[BundleErrors, float]:
    """Score a yard, which is drawn, or rendered where a folder is given for it.

    Bundles are detected again in its stored map, so that a kept folder tests the current code.
    """
    yards, folder = given
    if folder is None:
        return score_drawn(yards[number])
    recording, out = _measured(folder.with_name(f"{folder.name}_yard_{number:02d}"), yards[number])
    heights = read_heights(out)
    start = time.process_time()
    found = find_bundles(heights, BundleSettings())
    return score_bundles(found, read_true_bundles(recording)), time.process_time() - start


def _measured(folder: Path, settings: SimulationSettings) -> tuple[Path, Path]:
    """Render and measure the yard where its folders don't exist yet."""
    recording, out = folder / "recording", folder / "measured"
    folder.mkdir(parents=True, exist_ok=True)
    if not recording.is_dir():
        simulate(recording, settings)
    if not (out / "result.json").is_file():
        measure_into(recording, out, MeasureSettings())
    return recording, out
