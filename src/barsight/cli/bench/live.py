"""Run `barsight bench live|live-step`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import tyro

from barsight.benchmarks.motion.fixed_lag_speed import bench_live, live_table
from barsight.benchmarks.yard.live_step import bench_live_step, live_step_table
from barsight.cli.safe_console import SafeConsole
from barsight.core.json_values import write_json
from barsight.measure_settings import MeasureSettings
from barsight.motion.settings import MotionSettings


def bench_live_estimate(
    keyframes: int = 1000,
    held: int = 8,
    save: Annotated[Path | None, tyro.conf.arg(name="json")] = None,
) -> None:
    """Measure time per keyframe and memory of the live estimate on a simulated trajectory, without front end.

    Args:
        keyframes: Number of keyframes; a multiple of ten.
        held: Number of frames held at a time.
        save: JSON file for all figures.
    """
    bench = bench_live(keyframes, held)
    SafeConsole().print(live_table(bench))
    if save is not None:
        write_json(save, bench)


def bench_step(
    recording: tyro.conf.Positional[Path],
    preset: Literal["best", "fast"] = "best",
    save: Annotated[Path | None, tyro.conf.arg(name="json")] = None,
) -> None:
    """Time a whole live step: a pair arrives, is rectified and located, and the previous one is in the map.

    Args:
        recording: Any recording that `live --replay` accepts.
        preset: Stereo preset, as in `measure`.
        save: JSON file for all figures, with commit and machine.
    """
    bench = bench_live_step(recording, MeasureSettings(preset=preset, motion=MotionSettings("live")))
    SafeConsole().print(live_step_table(bench))
    if save is not None:
        write_json(save, bench)
