"""Measure a recording in a separate process, and tabulate its cost: time, memory, stages."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from rich.box import SIMPLE_HEAD
from rich.table import Table

from barsight.core.compiling.ahead import compile_ahead
from barsight.core.errors import MeasurementError
from barsight.result_folder import read_summary


@dataclass(frozen=True)
class RunCost:
    """One run of `barsight measure`. wall_s, cpu_s: wall time, and CPU time of all threads, of the whole
    process including its start. stage_s: seconds by stage; stages that run in parallel each count in full.
    """

    wall_s: float
    cpu_s: float
    peak_memory_mib: float
    stage_s: dict[str, float]


def measure_apart(recording: Path, out: Path, flags: tuple[str, ...]) -> RunCost:
    """Measure in a separate process, so that memory and time are those of this run alone. Kernels missing
    from the cache are compiled first.
    """
    compile_ahead(lambda stage, done, total: None, "measure")
    command = [sys.executable, "-m", "barsight", "measure", str(recording), "-o", str(out), *flags]
    wall_s, cpu_s = time.perf_counter(), _children_s()
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    wall_s, cpu_s = time.perf_counter() - wall_s, _children_s() - cpu_s
    if done.returncode != 0:
        lines = done.stderr.strip().splitlines()
        raise MeasurementError(f"{' '.join(flags) or 'default'}: {lines[-1] if lines else done.returncode}")
    content = read_summary(out)
    stage_s = {stage["name"]: stage["seconds"] for stage in content["stages"]}
    return RunCost(wall_s, cpu_s, content["peak_memory_mib"], stage_s)


def cost_table(title: str, costs: Mapping[str, RunCost], reference: str) -> Table:
    """Tabulate runs side by side, relative to `reference` if it is one of them, then their stages in s."""
    caption = "One run each. Stages: s by the clock; those that run side by side count each in full."
    if reference in costs:
        caption = f"times: over {reference}. {caption}"
    table = Table(title=title, caption=caption, box=SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    table.add_column("", no_wrap=True)
    for name in costs:
        table.add_column(name, justify="right", overflow="fold")
    runs = tuple(costs.values())
    heads = {
        "wall s": [run.wall_s for run in runs],
        "CPU s": [run.cpu_s for run in runs],
        "peak MiB": [run.peak_memory_mib for run in runs],
    }
    for head, values in heads.items():
        table.add_row(head, *(f"{value:.0f}" for value in values))
    if reference in costs:
        table.add_section()
        place = list(costs).index(reference)
        for head, values in heads.items():
            ratios = (f"{value / values[place]:.2f}" for value in values)
            table.add_row(f"{head.split()[0]}, times", *ratios)
    table.add_section()
    for stage in dict.fromkeys(stage for run in runs for stage in run.stage_s):
        cells = (f"{run.stage_s[stage]:.1f}" if stage in run.stage_s else "-" for run in runs)
        table.add_row(stage, *cells)
    return table


def _children_s() -> float:
    used = os.times()
    return used.children_user + used.children_system
