"""Run `barsight bench lifts`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console

from barsight.benchmarks.provenance import write_json
from barsight.benchmarks.yard.lift_targets import bench_lifts, lift_table
from barsight.benchmarks.yard.yard_speed import time_yard
from barsight.cli.progress import stages
from barsight.core.errors import ConfigError
from barsight.yard.bundles.detection import find_bundles
from barsight.yard.bundles.fitting.settings import BundleSettings
from barsight.yard.lifting.magnet import load_magnet

_TIMED_SEED = 7


def bench_lift_targets(
    yards: int = 32,
    placements: int = 1000,
    bundles: Literal["found", "given"] = "found",
    magnet: Path | None = None,
    save: Annotated[Path | None, tyro.conf.arg(name="json")] = None,
) -> None:
    """Score count under the magnet's footprint and vetoes on simulated yards against exact knowledge.

    Args:
        yards: Simulated yards, of one to five layers and seven mixes of bars.
        placements: Random placements, spread over the yards.
        bundles: Found in the noisy map, or the true ones given with errors of a stated sigma.
        magnet: TOML file of the magnet; an example is assumed without it.
        save: JSON file for all figures, with commit and machine.
    """
    if yards < 1 or placements < yards:
        raise ConfigError(f"{placements} placements on {yards} yards: give at least one for each yard")
    settings = BundleSettings()
    with stages(Console(stderr=True)) as advance:
        bench = bench_lifts(
            load_magnet(magnet),
            yards,
            placements,
            (lambda heights: find_bundles(heights, settings)) if bundles == "found" else None,
            lambda done: advance("yards", done, yards),
        )
    Console().print(lift_table(bench))
    Console().print(str(time_yard(load_magnet(magnet), _TIMED_SEED)))
    if save is not None:
        write_json(save, bench)
