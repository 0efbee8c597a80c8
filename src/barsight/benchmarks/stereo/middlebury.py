"""Run every stereo method on Middlebury-style folders (`bench stereo`), side by side in one run."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.table import Table

from barsight.benchmarks.provenance import (
    MIN_REPEATS,
    Provenance,
    Timing,
    provenance,
    summarise_times,
    time_repeats,
)
from barsight.benchmarks.stereo.middlebury_scenes import StereoScene, load_scenes
from barsight.benchmarks.stereo.scores import StereoScore, score_disparity
from barsight.stereo.method import StereoMethod


@dataclass(frozen=True)
class SceneResult:
    """One method on one scene. mask: the pixels that are scored, see `StereoScene`."""

    scene: str
    mask: str
    megapixels: float
    score: StereoScore
    per_megapixel: Timing


@dataclass(frozen=True)
class MethodResult:
    """One method: its scenes, the mean of their scores, and its time over all scenes per megapixel."""

    method: str
    scenes: tuple[SceneResult, ...]
    mean: StereoScore
    per_megapixel: Timing


@dataclass(frozen=True)
class StereoBench:
    """The whole run."""

    provenance: Provenance
    data: str
    masks: str
    methods: tuple[MethodResult, ...]


_MASKS = (
    "bad: percent of the pixels, a missing disparity is bad; counted: those white in nonocc.png, seen "
    "in both images, or where a scene has none every pixel with known truth; "
    "all: every pixel with known truth"
)
_CAPTION = (
    "Percent of pixels wrong by more than 0.5, 1, 2 px, missing ones counted: of those in nonocc.png, where "
    "a scene has one, else of all with known truth. Time: median (range)."
)
_HEADINGS = (
    "counted\nbad-0.5",
    "\nbad-1",
    "\nbad-2",
    "\ncover %",
    "all\nbad-0.5",
    "\nbad-1",
    "\nbad-2",
    "\nerror px",
    "\nms/MP",
)


def bench_stereo(data: Path, methods: Mapping[str, StereoMethod], repeats: int = MIN_REPEATS) -> StereoBench:
    """Run every method on every scene in `data`, with the candidates of `load_scene`. Raises `InputError`."""
    scenes = load_scenes(data)
    results = tuple(_bench_method(name, method, scenes, repeats) for name, method in methods.items())
    return StereoBench(provenance(), data.name, _MASKS, results)


def stereo_table(bench: StereoBench) -> Table:
    """Tabulate the means over the scenes, one row per method."""
    table = Table(title=f"{bench.data}: mean of {len(bench.methods[0].scenes)} scenes", caption=_CAPTION)
    table.add_column("method")
    for heading in _HEADINGS:
        table.add_column(heading, justify="right")
    for result in bench.methods:
        table.add_row(result.method, *_cells(result.mean, result.per_megapixel))
    return table


def scene_table(bench: StereoBench) -> Table:
    """Tabulate the score of every method on every scene."""
    table = Table(title=f"{bench.data}: scene by scene", caption=_CAPTION)
    table.add_column("method")
    table.add_column("scene")
    table.add_column("counted")
    for heading in _HEADINGS:
        table.add_column(heading, justify="right")
    for result in bench.methods:
        for scene in result.scenes:
            table.add_row(result.method, scene.scene, scene.mask, *_cells(scene.score, scene.per_megapixel))
    return table


def _bench_method(
    name: str, method: StereoMethod, scenes: tuple[StereoScene, ...], repeats: int
) -> MethodResult:
    results, seconds = [], []
    for scene in scenes:
        disparity, taken = time_repeats(lambda scene=scene: method(scene.pair, scene.candidates), repeats)  # type: ignore[misc]
        score = score_disparity(disparity, scene.truth_px, scene.counted)
        per_mp = summarise_times([one / scene.megapixels for one in taken])
        results.append(SceneResult(scene.name, scene.mask, scene.megapixels, score, per_mp))
        seconds.append(taken)
    pixels = sum(scene.megapixels for scene in scenes)
    whole = summarise_times([sum(run) / pixels for run in zip(*seconds, strict=True)])
    return MethodResult(name, tuple(results), _mean([one.score for one in results]), whole)


def _mean(scores: list[StereoScore]) -> StereoScore:
    names = [field.name for field in dataclasses.fields(StereoScore)]
    return StereoScore(**{name: float(np.mean([getattr(score, name) for score in scores])) for name in names})


def _cells(score: StereoScore, time: Timing) -> tuple[str, ...]:
    return (
        f"{score.counted_bad05_pct:.2f}",
        f"{score.counted_bad1_pct:.2f}",
        f"{score.counted_bad2_pct:.2f}",
        f"{score.counted_coverage_pct:.1f}",
        f"{score.bad05_pct:.2f}",
        f"{score.bad1_pct:.2f}",
        f"{score.bad2_pct:.2f}",
        f"{score.average_px:.3f}",
        f"{time.median_ms:.0f} ({time.fastest_ms:.0f}-{time.slowest_ms:.0f})",
    )
