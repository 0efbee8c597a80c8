"""`barsight bench bundles`: found bundles against true ones."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from rich.console import Console

from barsight.core.errors import ConfigError
from barsight.evaluation.bundle_scores import (
    bundle_report,
    bundle_table,
    read_true_bundles,
    reliability,
    score_bundles,
)
from barsight.evaluation.stereo_provenance import write_json
from barsight.simulation.bundle_bench import bench_bundles
from barsight.simulation.yard_speed import time_yard
from barsight.yard.bundle_file import read_bundles
from barsight.yard.magnet import load_magnet

Json = Annotated[Path | None, tyro.conf.arg(name="json")]


def bench_found_bundles(
    recording: Path | None = None,
    out: Path | None = None,
    yards: int = 32,
    length_m: float = 5.0,
    seed: int = 7,
    save: Json = None,
) -> None:
    """Found bundles against the true ones: of drawn yards, or of one measured recording.

    Args:
        recording: A simulated recording; with it goes `out`.
        out: The folder that `barsight measure` wrote for it.
        yards: Yards to draw; their exact surfaces get the errors of a measured map.
        length_m: Length of each yard.
        seed: Seed of all that is drawn.
        save: JSON file for all figures, with commit and machine.
    """
    if (recording is None) != (out is None):
        raise ConfigError("bench bundles: give both a recording and its measured folder, or neither")
    if yards < 1 or not 1 <= length_m <= 100:
        raise ConfigError("bench bundles: yards must be at least 1, length_m must lie between 1 and 100")
    seconds: tuple[float, ...] = ()
    if recording is not None and out is not None:
        scores = score_bundles(read_bundles(out / "bundles.json"), read_true_bundles(recording))
    else:
        bench = bench_bundles(yards, seed, length_m)
        scores, seconds = bench.scores, bench.seconds
    console = Console()
    console.print(bundle_table(scores))
    console.print(reliability(scores))
    if seconds:
        console.print(f"CPU time per yard of {length_m:g} m: median {np.median(seconds):.1f} s")
    if recording is None:
        console.print(str(time_yard(load_magnet(None), seed)))
    if save is not None:
        write_json(save, bundle_report(scores, seconds))
