"""Run `barsight bench yard`: render the field test, measure it with each method and compare."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Annotated, Literal, get_args

import tyro

from barsight.benchmarks.provenance import provenance
from barsight.benchmarks.yard.field_test import VARIANTS, YardBench, laser_error_mm, yard_row, yard_table
from barsight.benchmarks.yard.run_cost import cost_table, measure_apart
from barsight.cli.progress import stages
from barsight.cli.safe_console import SafeConsole
from barsight.core.errors import ConfigError
from barsight.core.json_values import write_json
from barsight.recording.base import RecordingSettings
from barsight.recording.open import open_recording
from barsight.simulation.settings.recording import SimulationSettings
from barsight.simulation.simulate import simulate

Method = Literal[
    "paper", "sgbm", "sgbm 5path", "ours", "ours fast", "ours crane-only", "ours votes-alone",
    "ours self-calibrated", "ours paper-contours",
]  # fmt: skip


def bench_yard(
    length: float = 35.0,
    frames: int = 100,
    seed: int = 5,
    bars: str = "90mm:7,40mm:37,60mm:19",
    recording: Path | None = None,
    methods: tuple[Method, ...] = get_args(Method),
    save: Annotated[Path | None, tyro.conf.arg(name="json")] = None,
) -> None:
    """Run the paper's field test at its scale: laser, the paper's method, SGBM and Barsight's.

    All use one recording. Besides errors, it shows each method's time, memory and stages, relative to SGBM's
    where that is among the methods. 35 m and 100 pairs take about an hour on two cores; --length 7
    --frames 20 gives a first answer.

    Args:
        length: Length of the stack, in metres.
        frames: Number of stereo pairs.
        seed: Random seed of the simulated yard.
        bars: Kinds of bundles in the yard.
        recording: A simulated recording to use instead.
        methods: The methods to compare, one row each.
        save: JSON file for all figures, with commit and machine.
    """
    console = SafeConsole()
    with tempfile.TemporaryDirectory() as scratch:
        place = recording or Path(scratch) / "recording"
        if recording is None:
            settings = SimulationSettings(length_m=length, frames=frames, seed=seed, bars=bars, depth_views=0)
            with stages(console) as advance:
                simulate(place, settings, lambda done, total: advance("render", done, total))
        source = open_recording(place, RecordingSettings())
        if not (place / "truth" / "height.npz").is_file():
            raise ConfigError(f"{place}: has no truth; give a recording of barsight simulate")
        rows = []
        for method in dict.fromkeys(methods):
            console.print(f"measuring: {method} ...")
            out = Path(scratch) / method.replace(" ", "-")
            cost = measure_apart(place, out, VARIANTS[method])
            rows.append(yard_row(method, VARIANTS[method], place, out, cost))
        what = f"{place.name}" if recording else f"{length:g} m, {frames} pairs, seed {seed}, {bars}"
        bench = YardBench(what, *laser_error_mm(source, place), tuple(rows), provenance())
    console.print(yard_table(bench))
    costs = {row.method: row.cost for row in bench.rows}
    reference = "sgbm 5path" if "sgbm 5path" in costs else "sgbm"
    made = bench.provenance
    console.print(cost_table(f"{made.cores} cores, {made.machine}", costs, reference))
    if save is not None:
        write_json(save, bench)
