"""Run `barsight bench length`: measure time and memory as a function of the yard's length."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from barsight.benchmarks.provenance import Provenance, provenance
from barsight.benchmarks.yard.repeated_recording import repeat
from barsight.benchmarks.yard.run_cost import RunCost, cost_table, measure_apart
from barsight.cli.safe_console import SafeConsole
from barsight.core.errors import ConfigError
from barsight.core.json_values import write_json
from barsight.result_folder import read_summary


@dataclass(frozen=True)
class LengthRow:
    """Time and memory of one travel."""

    length_m: float
    frames: int
    cost: RunCost


@dataclass(frozen=True)
class LengthBench:
    """Results for the recording driven once, and driven several times end to end."""

    rows: tuple[LengthRow, LengthRow]
    provenance: Provenance


def bench_length(
    recording: tyro.conf.Positional[Path],
    times: int = 10,
    save: Annotated[Path | None, tyro.conf.arg(name="json")] = None,
) -> None:
    """Measure time and memory for a recording and for the same recording driven several times end to end.

    Args:
        recording: A recording with crane encoders, as barsight simulate writes it.
        times: Number of laps of the long travel, at least two.
        save: JSON file for all figures, with commit and machine.
    """
    if times < 2:
        raise ConfigError(f"--times {times}: the long way has two laps at least")
    with tempfile.TemporaryDirectory() as scratch:
        once, long = Path(scratch) / "once", Path(scratch) / "long"
        repeat(recording, once, 1)
        repeat(recording, long, times)
        bench = LengthBench((_row(once, Path(scratch) / "a"), _row(long, Path(scratch) / "b")), provenance())
    costs = {f"{row.length_m:.0f} m, {row.frames} pairs": row.cost for row in bench.rows}
    title = f"{recording.name}, {times} laps; {bench.provenance.cores} cores, {bench.provenance.machine}"
    SafeConsole().print(cost_table(title, costs, next(iter(costs))))
    if save is not None:
        write_json(save, bench)


def _row(recording: Path, out: Path) -> LengthRow:
    cost = measure_apart(recording, out, ())
    content = read_summary(out)
    return LengthRow(content["trajectory"]["length_m"], content["frames"]["used"], cost)
