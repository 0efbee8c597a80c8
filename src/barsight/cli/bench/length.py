"""Run `barsight bench length`: time and memory against the length of the yard."""

from __future__ import annotations

import json
import os
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.box import SIMPLE_HEAD
from rich.table import Table

from barsight.benchmarks.provenance import Provenance, provenance
from barsight.benchmarks.yard.repeated_recording import repeat
from barsight.cli.bench.yard import measure_apart
from barsight.cli.safe_console import SafeConsole
from barsight.core.json_values import write_json


@dataclass(frozen=True)
class LengthRow:
    """One measured way. cpu_s: of all threads; peak_memory_mib: of the whole process."""

    length_m: float
    frames: int
    seconds: float
    cpu_s: float
    peak_memory_mib: float
    stage_s: dict[str, float]


@dataclass(frozen=True)
class LengthBench:
    """The recording once, and the same driven several times end to end."""

    rows: tuple[LengthRow, LengthRow]
    provenance: Provenance


def bench_length(
    recording: tyro.conf.Positional[Path],
    times: int = 10,
    save: Annotated[Path | None, tyro.conf.arg(name="json")] = None,
) -> None:
    """Measure time and memory of a recording and of the same recording driven several times end to end.

    Args:
        recording: A recording with crane encoders, as barsight simulate writes it.
        times: How many laps the long way has.
        save: JSON file for all figures, with commit and machine.
    """
    with tempfile.TemporaryDirectory() as scratch:
        once, long = Path(scratch) / "once", Path(scratch) / "long"
        repeat(recording, once, 1)
        repeat(recording, long, times)
        bench = LengthBench((_row(once, Path(scratch) / "a"), _row(long, Path(scratch) / "b")), provenance())
    table = Table(
        "way", "frames", "s", "CPU s", "MiB", box=SIMPLE_HEAD, title=f"{recording.name}, {times} laps"
    )
    for row in bench.rows:
        figures = (f"{row.seconds:.0f}", f"{row.cpu_s:.0f}", f"{row.peak_memory_mib:.0f}")
        table.add_row(f"{row.length_m:.0f} m", str(row.frames), *figures)
    short, whole = bench.rows
    ratios = (whole.seconds / short.seconds, whole.cpu_s / short.cpu_s)
    memory = whole.peak_memory_mib / short.peak_memory_mib
    table.add_row("ratio", "", *(f"{ratio:.1f}" for ratio in ratios), f"{memory:.2f}")
    SafeConsole().print(table)
    if save is not None:
        write_json(save, bench)


def _row(recording: Path, out: Path) -> LengthRow:
    before = _children_s()
    measure_apart(recording, out, ())
    content = json.loads((out / "result.json").read_text(encoding="utf-8"))
    return LengthRow(
        content["trajectory"]["length_m"],
        content["frames"]["used"],
        content["seconds"],
        _children_s() - before,
        content["peak_memory_mib"],
        {stage["name"]: stage["seconds"] for stage in content["stages"]},
    )


def _children_s() -> float:
    used = os.times()
    return used.children_user + used.children_system
