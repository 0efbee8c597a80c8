"""Run `barsight bench live`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from barsight.benchmarks.motion.fixed_lag_speed import bench_live, live_table
from barsight.cli.safe_console import SafeConsole
from barsight.core.json_values import write_json


def bench_live_estimate(
    keyframes: int = 1000,
    held: int = 8,
    save: Annotated[Path | None, tyro.conf.arg(name="json")] = None,
) -> None:
    """Time a keyframe and memory of the live estimate on a simulated way, front end left out.

    Args:
        keyframes: How many; a multiple of ten.
        held: Frames held at a time.
        save: JSON file for all figures.
    """
    bench = bench_live(keyframes, held)
    SafeConsole().print(live_table(bench))
    if save is not None:
        write_json(save, bench)
