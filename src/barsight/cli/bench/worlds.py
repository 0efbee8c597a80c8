"""Run `barsight bench worlds`."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Annotated

import tyro

from barsight.benchmarks.provenance import provenance
from barsight.benchmarks.yard.world_runs import WorldKeys, run_world
from barsight.benchmarks.yard.world_scores import (
    WorldBench,
    WorldScore,
    world_list,
    world_rows,
    world_table,
)
from barsight.cli.bench.seeds import over_seeds, parse_seeds
from barsight.cli.safe_console import SafeConsole
from barsight.core.errors import ConfigError
from barsight.core.json_values import write_json
from barsight.measure_folder import measure_into
from barsight.measure_settings import MeasureSettings
from barsight.simulation.settings.recording import SimulationSettings
from barsight.simulation.settings.rig import CameraSettings

WIDTH_PX, FOCAL_PX, ASPECT = 1280, 1250.0, 0.8


def bench_worlds(
    seeds: str = "1000:1006",
    keep: Annotated[Path | None, tyro.conf.arg(aliases=("-o",))] = None,
    looked_at: str = "",
    length_m: float = 3.5,
    frames: int = 10,
    width_px: int = 640,
    workers: int = 1,
    scheduler: str | None = None,
    save: Annotated[Path | None, tyro.conf.arg(name="json")] = None,
) -> None:
    """Draw whole worlds, render and measure them, and score map, poses and bundles against truth.

    A world takes about a minute with small pictures. The table has medians, worst cases and the shares within
    the stated 95 % intervals, over all worlds and by kind.

    Args:
        seeds: Seeds of the worlds, first:last, where last is not included; the kind is the seed modulo 10.
        keep: Folder for the worlds. Worlds already finished there are not repeated, unless the sources or
            settings that they depend on have changed.
        looked_at: Reason why these seeds no longer count as unseen, such as a threshold tuned on them; it is
            kept in the folder and printed with the tables.
        length_m: Approximate length of each world, in metres.
        frames: Number of stereo pairs over that length.
        width_px: Width of the pictures; they show the same part of the yard at any width.
        workers: Number of worlds processed at a time, each in a process of its own.
        scheduler: Address of a Dask scheduler, tcp://HOST:PORT, whose workers are used instead; they share
            the folder of --keep.
        save: JSON file for all figures, with commit and machine.
    """
    numbers = parse_seeds(seeds, "bench worlds")
    if looked_at and keep is None:
        raise ConfigError("bench worlds: --looked-at is kept in a folder: name it with --keep")
    if scheduler is not None and keep is None:
        raise ConfigError("bench worlds: with --scheduler the workers share a folder: name it with --keep")
    camera = CameraSettings(
        width_px=width_px, height_px=round(ASPECT * width_px), focal_px=FOCAL_PX * width_px / WIDTH_PX
    )
    given = SimulationSettings(length_m=length_m, frames=frames, depth_views=0, camera=camera)
    console = SafeConsole()

    with tempfile.TemporaryDirectory() as scratch:
        folder = (keep or Path(scratch)).absolute()
        shared = (folder, given, WorldKeys.of(given), looked_at)
        scores: dict[int, WorldScore] = {}
        for seed, score in over_seeds(_run, numbers, shared, workers, scheduler):
            scores[seed] = score
            what = score.refused or f"{score.counts['found']} of {score.counts['free']} free bundles found"
            console.print(f"seed {seed}, {score.kind}: {what}", highlight=False, markup=False)
    worlds = tuple(scores[seed] for seed in numbers)
    bench = WorldBench(worlds, world_rows(worlds), provenance())
    console.print(world_list(bench))
    console.print(world_table(bench))
    if save is not None:
        write_json(save, bench)


def _run(seed: int, shared: tuple[Path, SimulationSettings, WorldKeys, str]) -> WorldScore:
    folder, given, keys, looked_at = shared
    return run_world(folder, seed, given, keys, _measure, looked_at)


def _measure(recording: Path, out: Path) -> None:
    measure_into(recording, out, MeasureSettings(), report=False, judged_at="end")
