"""Measure a 90 mm bar at eight ranges by each method (`bench target-size`, the paper's Table 1).

The paper states neither its camera nor its way of measuring. Assumed here: the crane's camera (1250 px, 0.5
m, `bar_scenes`); one round bar on supports 0.3 m above a floor, darker than the floor and glossy to a varying
degree; random poses (sub-pixel position, roll, tilt of the floor, lamp, texture). Two sizes are measured,
both from the same rough guess as a person's click would give (15 % off):

- `map`: one cylinder above a floor plane, fitted to the disparity map alone (`bar_fit`);
- `size`: the bar's outlines in the images, searched for near those of the map, at the distance given by the
  disparities of the bar's points (`bar_edges`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from rich.table import Table

from barsight.benchmarks.provenance import Provenance, provenance
from barsight.benchmarks.stereo.bar_edges import edge_diameter
from barsight.benchmarks.stereo.bar_fit import BarGuess, fit_bar
from barsight.benchmarks.stereo.bar_renderer import RenderedBar, render_pair
from barsight.benchmarks.stereo.bar_scenes import BAR_DIAMETER_M, bar_over_floor
from barsight.core.arrays import Float64
from barsight.core.errors import Failed
from barsight.core.parallel import ordered_map
from barsight.core.records.disparity import Disparity
from barsight.core.records.pairs import RectifiedPair
from barsight.stereo.method import StereoMethod

RANGES_MM = (1800, 2500, 3000, 3600, 4500, 5000, 5600, 8500)
MIN_POSES = 10
_RAISED_M = 0.3
_MAX_GLOSS = 40.0
_GUESS_ERROR = 0.15


@dataclass(frozen=True)
class SizeErrors:
    """Relative errors of one size, %: their mean, their mean absolute value and their standard deviation
    over the poses that could be measured. failed: number of poses that couldn't.
    """

    mean_pct: float
    mean_abs_pct: float
    spread_pct: float
    failed: int


@dataclass(frozen=True)
class RangeResult:
    """One method at one range: sizes from outlines and disparities, and from the map alone."""

    range_mm: int
    size: SizeErrors
    map: SizeErrors


@dataclass(frozen=True)
class TargetSizeResult:
    """One method at every range."""

    method: str
    ranges: tuple[RangeResult, ...]


@dataclass(frozen=True)
class TargetSizeBench:
    """The whole run."""

    provenance: Provenance
    diameter_mm: float
    poses: int
    methods: tuple[TargetSizeResult, ...]


def bench_target_size(
    methods: Mapping[str, StereoMethod],
    poses: int = MIN_POSES,
    ranges_mm: Sequence[int] = RANGES_MM,
    seed: int = 1,
) -> TargetSizeBench:
    """Render `poses` poses at each range and measure the bar in every method's disparities."""
    poses_at = [(range_mm, pose) for range_mm in ranges_mm for pose in range(poses)]
    jobs = (job for range_mm, pose in poses_at for job in _matched(methods, range_mm, pose, seed))
    # Rendering and matching use all cores but a fit only one, so fits run alongside on a pool of threads.
    measured = np.array(list(ordered_map(lambda job: measure_bar(*job), jobs)))
    found = measured.reshape(len(ranges_mm), poses, len(methods), 2)
    results = tuple(
        TargetSizeResult(
            name,
            tuple(
                RangeResult(range_mm, _errors(at_range[:, place, 0]), _errors(at_range[:, place, 1]))
                for range_mm, at_range in zip(ranges_mm, found, strict=True)
            ),
        )
        for place, name in enumerate(methods)
    )
    return TargetSizeBench(provenance(), 1000 * BAR_DIAMETER_M, poses, results)


def _matched(
    methods: Mapping[str, StereoMethod], range_mm: int, pose: int, seed: int
) -> Iterator[tuple[Disparity, RectifiedPair, BarGuess]]:
    """Match one pose by each method; yields disparities, the pair, and the guess from which fits start."""
    rng = np.random.default_rng([seed, range_mm, pose])
    posed = bar_over_floor(rng, range_mm / 1000, rng.uniform(0, _MAX_GLOSS), _RAISED_M)
    assert posed.scene.bar is not None
    pair = render_pair(posed.scene, seed=seed * 100_000 + range_mm + pose).pair
    guess = _rough_guess(rng, posed.scene.bar)
    for method in methods.values():
        yield method(pair, posed.candidates), pair, guess


def measure_bar(disparity: Disparity, pair: RectifiedPair, guess: BarGuess) -> tuple[float, float]:
    """Measure the diameter, m, from outlines and disparities, and from the map alone; NaN if that failed."""
    fitted = fit_bar(disparity, pair.camera, guess)
    if isinstance(fitted, Failed):
        return math.nan, math.nan
    size = edge_diameter(disparity, pair, fitted)
    return (math.nan if isinstance(size, Failed) else size), 2 * fitted.radius_m


def target_size_table(bench: TargetSizeBench) -> Table:
    """Tabulate ranges by methods: mean absolute error and spread of `size`, in brackets those of `map`."""
    table = Table(
        title=f"A bar of {bench.diameter_mm:.0f} mm: mean |error| ± spread, %",
        caption=f"{bench.poses} poses each. First line: outlines in the images at the distance that the "
        "disparities say. Second line: a cylinder fitted to the disparity map alone.",
    )
    table.add_column("range mm", justify="right")
    for result in bench.methods:
        table.add_column(result.method, justify="right")
    for index, row in enumerate(bench.methods[0].ranges):
        cells = [result.ranges[index] for result in bench.methods]
        table.add_row(
            str(row.range_mm), *[f"{_cell(one.size)}\n[dim]{_cell(one.map)}[/dim]" for one in cells]
        )
    return table


def _rough_guess(rng: np.random.Generator, bar: RenderedBar) -> BarGuess:
    """Draw a rough bar as a person would point at it: position and radius off by up to 15 % of the radius."""
    shift = bar.radius_m * _GUESS_ERROR * rng.uniform(-1, 1, 3)
    radius = bar.radius_m * (1 + _GUESS_ERROR * rng.uniform(-1, 1))
    return BarGuess(bar.centre_m + shift, bar.axis, radius)


def _errors(diameter_m: Float64) -> SizeErrors:
    error = 100 * (diameter_m / BAR_DIAMETER_M - 1)
    good = error[np.isfinite(error)]
    if good.size == 0:
        return SizeErrors(math.nan, math.nan, math.nan, int(error.size))
    spread = float(good.std(ddof=1)) if good.size > 1 else math.nan
    return SizeErrors(float(good.mean()), float(np.abs(good).mean()), spread, int(error.size - good.size))


def _cell(errors: SizeErrors) -> str:
    failed = f" ({errors.failed} failed)" if errors.failed else ""
    return f"{errors.mean_abs_pct:.2f} ± {errors.spread_pct:.2f}{failed}"
