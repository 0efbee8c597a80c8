"""Run `barsight bench lifts`."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import tyro

from barsight.benchmarks.lift_judge.magnet import JudgedMagnet, read_magnet
from barsight.benchmarks.yard.drawn_worlds import (
    MappedWorld,
    judged_yard,
    measured_world,
    noisy_world,
    render_world,
)
from barsight.benchmarks.yard.judged_lifts import (
    JudgedBench,
    JudgedLift,
    bench_table,
    dangerous_table,
    judge_yard,
)
from barsight.benchmarks.yard.liftable_bundles import LiftableBundle, liftable_bundles
from barsight.benchmarks.yard.world_runs import DRAWS, WorldKeys, keep_measured, read_note
from barsight.cli.bench.seeds import over_seeds, parse_seeds
from barsight.cli.progress import stages
from barsight.cli.safe_console import SafeConsole
from barsight.core.errors import ConfigError, MeasurementError
from barsight.core.json_values import write_json
from barsight.mapping.settings import MapSettings
from barsight.measure_folder import measure_into
from barsight.measure_settings import MeasureSettings
from barsight.simulation.settings.travel import PassesSettings
from barsight.simulation.worlds.yards import DrawnYard
from barsight.yard.lift_settings import LiftSettings
from barsight.yard.magnet.description import Magnet, example_magnet, load_magnet

DRAWN_BY = (*DRAWS, "benchmarks/yard/drawn_worlds.py")
"""Sources that decide what a seed's recording is."""


@dataclass(frozen=True)
class YardChoice:
    """Choice of the drawn yards and of how each becomes a map."""

    kind: Literal["by-seed", "orderly", "spilled"] = "by-seed"
    """Kind of the yards. by-seed: seed modulo 10 selects the kind. orderly: whole bundles of one sort in even
    layers. spilled: the same, with single bars that lie along on half of the highest bundles.
    """
    rendered: bool = False
    """Record each yard under drawn light, crane and image faults and measure it, which takes a minute;
    otherwise noise is added to the exact map.
    """
    full_size: bool = False
    """Render pictures of 1280x1024 instead of 640x512, which halves the pixel size on the surface but takes
    four times as long.
    """
    trolley_y_m: tuple[float, ...] = ()
    """Record each rendered yard in several passes, with the trolley at these positions; one by default."""
    carve_gullies: bool = False
    """Measure rendered yards with map.carve_gullies."""

    def __post_init__(self) -> None:
        if self.trolley_y_m and not self.rendered:
            raise ConfigError("bench lifts: trolley-y-m needs --rendered: the exact map has no passes")
        PassesSettings(self.trolley_y_m)
        if self.carve_gullies and not self.rendered:
            raise ConfigError("bench lifts: carve-gullies needs --rendered: it asks the pictures")


def bench_lift_targets(
    seeds: str = "0:8",
    choice: Annotated[YardChoice, tyro.conf.arg(name="")] = YardChoice(),
    placements: int = 40,
    danger_placements: int = 0,
    keep: Path | None = None,
    magnet: Path | None = None,
    workers: int = 1,
    scheduler: str | None = None,
    save: Annotated[Path | None, tyro.conf.arg(name="json")] = None,
) -> None:
    """Judge offered lifts and random placements on drawn yards by exact geometry.

    By default the yards are irregular bundles and heaps of bars, settled by physics among beams, walls and
    stanchions, askew and along X, partly out of sight. The benchmark counts dangerous placements that were
    not vetoed and safe ones that were. The exit code is 5 if a placement without a veto, offered or random,
    is dangerous.

    Args:
        seeds: Seeds of the yards, first:last, where last is not included.
        choice: Choice of the yards.
        placements: Number of random placements on each yard, in addition to the offered lifts.
        danger_placements: Number of further placements on each yard, of which only those without a veto are
            judged, to bound the rate of dangerous ones in less time.
        keep: Folder for the rendered yards; yards already finished there are not repeated, unless the
            sources or settings that they depend on have changed.
        magnet: TOML file of the magnet; an example magnet by default.
        workers: Number of yards processed at a time, each in a process of its own.
        scheduler: Address of a Dask scheduler, tcp://HOST:PORT, whose workers are used instead; they share
            the folder of --keep.
        save: JSON file for all placements, with commit and machine.
    """
    numbers = parse_seeds(seeds, "bench lifts")
    for name, count in (("placements", placements), ("danger-placements", danger_placements)):
        if count < 0:
            raise ConfigError(f"bench lifts: {name} must be 0 or more, not {count}")
    if scheduler is not None and keep is None:
        raise ConfigError("bench lifts: with --scheduler the workers share a folder: name it with --keep")
    found: dict[int, _JudgedYard] = {}
    with tempfile.TemporaryDirectory() as scratch, stages(SafeConsole(stderr=True)) as advance:
        described_at = magnet or Path(scratch) / "magnet.toml"
        if magnet is None:
            described_at.write_text(example_magnet(), encoding="utf-8")
        described, judged = load_magnet(described_at), read_magnet(described_at)
        given = _Given(
            (keep or Path(scratch)).absolute(), described, judged, placements, danger_placements, choice,
            _keys(judged, choice),
        )  # fmt: skip
        for seed, yard in over_seeds(_judge_seed, numbers, given, workers, scheduler):
            found[seed] = yard
            advance("yards", len(found), len(numbers))
            if save is not None:
                write_json(save, _bench(found))
    bench = _bench(found)
    SafeConsole().print(bench_table(bench))
    if bench.dangerous:
        SafeConsole().print(dangerous_table(bench))
        raise MeasurementError(f"bench lifts: dangerous placements without a veto: {len(bench.dangerous)}")


@dataclass(frozen=True)
class _Given:
    """Settings that all seeds share.

    magnet, judged: the magnet as the product and as the judge read its file. keys: of the kept results.
    """

    keep: Path
    magnet: Magnet
    judged: JudgedMagnet
    placements: int
    danger_placements: int
    choice: YardChoice
    keys: WorldKeys


def _keys(magnet: JudgedMagnet, choice: YardChoice) -> WorldKeys:
    """Compute the keys of the kept results; without choices of today those kept before stay valid."""
    passes = (choice.trolley_y_m,) if choice.trolley_y_m else ()
    carved = ("carved",) if choice.carve_gullies else ()
    return WorldKeys.of((magnet.half_span_m, choice.full_size, *passes, *carved), DRAWN_BY)


_JudgedYard = tuple[tuple[JudgedLift, ...], tuple[LiftableBundle, ...]]


def _bench(found: dict[int, _JudgedYard]) -> JudgedBench:
    yards = [yard for _, yard in sorted(found.items())]
    lifts = [lift for lifts, _ in yards for lift in lifts]
    return JudgedBench.of(len(yards), lifts, [bundle for _, bundles in yards for bundle in bundles])


def _judge_seed(seed: int, given: _Given) -> _JudgedYard:
    kind = None if given.choice.kind == "by-seed" else given.choice.kind
    settings, folder = LiftSettings(), given.keep / f"{kind or 'seed'}_{seed}"
    world = judged_yard(seed, given.judged, kind)
    if given.choice.rendered:
        mapped = _measured(world, folder, settings, given)
    else:
        mapped = noisy_world(world, settings)
    counts = given.placements, given.danger_placements
    lifts = tuple(judge_yard(world, mapped, given.magnet, given.judged, settings, *counts))
    offered = {lift.load for lift in lifts if lift.offered}
    return lifts, tuple(liftable_bundles(world, given.judged, offered))


def _measured(world: DrawnYard, folder: Path, settings: LiftSettings, given: _Given) -> MappedWorld:
    """Render and measure the yard where its folder doesn't keep it. Raises MeasurementError where it can't be
    measured.
    """
    full_size, trolley_y_m = given.choice.full_size, given.choice.trolley_y_m
    note = keep_measured(
        folder, read_note(folder, "lifts"), given.keys,
        lambda recording: render_world(world, recording, full_size=full_size, trolley_y_m=trolley_y_m),
        partial(_measure, MapSettings(carve_gullies=given.choice.carve_gullies)),
    )  # fmt: skip
    if note["refused"]:
        raise MeasurementError(f"bench lifts: seed {world.seed} can't be measured: {note['refused']}")
    return measured_world(folder / "measured", settings)


def _measure(mapped: MapSettings, recording: Path, out: Path) -> None:
    passes = sorted(recording.glob("pass_*")) or recording
    measure_into(passes, out, MeasureSettings(map=mapped), report=False, judged_at="end")
