"""Measure bias against the fractional part of the true disparity (`bench subpixel`), and check sigma.

Scenes are rendered (`bar_scenes`): tilted floors, matt bars, glossy bars. Only pixels well inside one surface
that the right image sees are counted. The bias is the median error per tenth of a pixel of the true
disparity's fraction; a method that favours whole disparities shows a wave in it, and its peak-to-peak height
is the score.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from rich.table import Table

from barsight.benchmarks.provenance import Provenance, provenance
from barsight.benchmarks.stereo.bar_renderer import BAR, FLOOR, Rendered, render_pair
from barsight.benchmarks.stereo.bar_scenes import PosedScene, bar_over_floor, tilted_floor
from barsight.benchmarks.stereo.cramer_rao_bound import noise_limit_px
from barsight.benchmarks.stereo.middlebury_scenes import load_scene
from barsight.core.arrays import Bool, Float64, UInt8
from barsight.core.records.disparity import Disparity
from barsight.stereo.method import StereoMethod

BINS = 10
_GROSS_PX = 1.0
_FLOOR_MARGIN_PX, _BAR_MARGIN_PX = 12, 4


@dataclass(frozen=True)
class FractionBias:
    """Errors of one method on one kind of scene.

    bias_px: median error per tenth of a pixel of the true disparity's fraction, from 0. peak_to_peak_px:
    their maximum minus their minimum. median_bias_px: median error of all pixels. median_error_px: median
    absolute error. gross_pct: errors above 1 px. coverage_pct: pixels that have a disparity. within1_pct,
    within2_pct: pixels with errors within 1 and 2 of their sigma. pixels: number of pixels counted.
    """

    bias_px: tuple[float, ...]
    peak_to_peak_px: float
    median_bias_px: float
    median_error_px: float
    gross_pct: float
    coverage_pct: float
    within1_pct: float
    within2_pct: float
    pixels: int


@dataclass(frozen=True)
class SubpixelResult:
    """One method on every kind of scene, by the name of the kind."""

    method: str
    kinds: dict[str, FractionBias]


@dataclass(frozen=True)
class SubpixelBench:
    """The whole run. scenes: number of scenes per kind. limit_px: median of `noise_limit_px` per kind."""

    provenance: Provenance
    scenes: int
    limit_px: dict[str, float]
    methods: tuple[SubpixelResult, ...]


def bench_subpixel(
    methods: Mapping[str, StereoMethod], data: Path | None = None, scenes: int = 6, seed: int = 1
) -> SubpixelBench:
    """Run every method on `scenes` rendered scenes of each kind, and on the real scene `data`/motorcycle
    if there is one. Its truth is sub-pixel too, but its fractions come from one geometry: it is used for
    sigma only.
    """
    gathered: dict[str, dict[str, list[PixelErrors]]] = {name: {} for name in methods}
    limits: dict[str, list[float]] = {kind: [] for kind in _KINDS}
    for kind, make in _KINDS.items():
        for index in range(scenes):
            rng = np.random.default_rng([seed, index, len(kind)])
            posed = make(rng)
            rendered = render_pair(posed.scene, seed=1000 * seed + index)
            where = inner_pixels(rendered, BAR if posed.scene.bar else FLOOR)
            limits[kind].append(noise_limit_px(rendered.pair, where))
            for name, method in methods.items():
                found = method(rendered.pair, posed.candidates)
                gathered[name].setdefault(kind, []).append(pixel_errors(found, rendered.truth_px, where))
    if data is not None and (data / "motorcycle" / "disp.pfm").is_file():
        scene = load_scene(data / "motorcycle")
        for name, method in methods.items():
            found = method(scene.pair, scene.candidates)
            errors = pixel_errors(found, scene.truth_px.astype(np.float64), scene.counted)
            gathered[name]["motorcycle"] = [errors]
    results = tuple(
        SubpixelResult(name, {kind: fraction_bias(errors) for kind, errors in kinds.items()})
        for name, kinds in gathered.items()
    )
    limit_px = {kind: float(np.median(limit)) for kind, limit in limits.items()}
    return SubpixelBench(provenance(), scenes, limit_px, results)


def inner_pixels(rendered: Rendered, surface: int) -> Bool:
    """Select pixels (H, W) of the surface that the right image sees, away from the surface's edges."""
    margin = _BAR_MARGIN_PX if surface == BAR else _FLOOR_MARGIN_PX
    window = np.ones((2 * margin + 1,) * 2, dtype=np.uint8)
    usable: UInt8 = ((rendered.surface == surface) & rendered.visible).astype(np.uint8)
    where: Bool = cv2.erode(usable, window, borderValue=0).astype(np.bool_)
    return where


def subpixel_table(bench: SubpixelBench) -> Table:
    """Tabulate the errors, one row per method and kind of scene."""
    table = Table(
        title="Below the pixel",
        caption="bias: median error per tenth of a pixel of the true disparity's fraction; "
        f"{bench.scenes} rendered scenes of each kind. Limit that noise sets over the long support, 1 sigma: "
        + ", ".join(f"{kind} {limit:.3f} px" for kind, limit in bench.limit_px.items()),
    )
    for heading in ("method", "scene"):
        table.add_column(heading)
    for heading in (
        "bias p-p px",
        "bias px",
        "median error px",
        "> 1 px %",
        "coverage %",
        "within 1 sigma %",
        "within 2 sigma %",
    ):
        table.add_column(heading, justify="right")
    for result in bench.methods:
        for kind, bias in result.kinds.items():
            table.add_row(
                result.method,
                kind,
                f"{bias.peak_to_peak_px:.3f}",
                f"{bias.median_bias_px:+.3f}",
                f"{bias.median_error_px:.3f}",
                f"{bias.gross_pct:.2f}",
                f"{bias.coverage_pct:.1f}",
                f"{bias.within1_pct:.1f}",
                f"{bias.within2_pct:.1f}",
            )
    return table


@dataclass(frozen=True, eq=False)
class PixelErrors:
    """Per counted pixel: fraction of the true disparity, error (NaN if missing), and error over sigma."""

    fraction: Float64
    error_px: Float64
    ratio: Float64


def pixel_errors(found: Disparity, truth_px: Float64, where: Bool) -> PixelErrors:
    """Collect the errors of the pixels in `where`, (H, W) bool."""
    truth = truth_px[where]
    error = found.disparity_px[where] - truth
    return PixelErrors(truth - np.floor(truth), error, error / found.sigma_px[where])


def fraction_bias(parts: list[PixelErrors]) -> FractionBias:
    """Summarise the errors of all pixels together; NaN if there are none."""
    fraction = np.concatenate([part.fraction for part in parts])
    error = np.concatenate([part.error_px for part in parts])
    ratio = np.abs(np.concatenate([part.ratio for part in parts]))
    has = np.isfinite(error)
    fraction, error, ratio = fraction[has], error[has], ratio[has]
    if error.size == 0:
        nothing = float("nan")
        return FractionBias((nothing,) * BINS, *(nothing,) * 4, 0.0, nothing, nothing, has.size)
    bins = np.minimum((fraction * BINS).astype(np.intp), BINS - 1)
    biases = [
        float(np.median(error[bins == index])) if (bins == index).any() else float("nan")
        for index in range(BINS)
    ]
    return FractionBias(
        bias_px=tuple(biases),
        peak_to_peak_px=float(np.nanmax(biases) - np.nanmin(biases)),
        median_bias_px=float(np.median(error)),
        median_error_px=float(np.median(np.abs(error))),
        gross_pct=100 * float((np.abs(error) > _GROSS_PX).mean()),
        coverage_pct=100 * float(has.mean()),
        within1_pct=100 * float((ratio <= 1).mean()),
        within2_pct=100 * float((ratio <= 2).mean()),
        pixels=int(has.size),
    )


def _plane(rng: np.random.Generator) -> PosedScene:
    return tilted_floor(rng, rng.uniform(5, 9), rng.uniform(10, 25))


def _matt_bar(rng: np.random.Generator) -> PosedScene:
    return bar_over_floor(rng, rng.uniform(2, 3.5), gloss=0.0)


def _glossy_bar(rng: np.random.Generator) -> PosedScene:
    return bar_over_floor(rng, rng.uniform(2, 3.5), gloss=rng.uniform(10, 40))


_KINDS: dict[str, Callable[[np.random.Generator], PosedScene]] = {
    "tilted plane": _plane,
    "matt bar": _matt_bar,
    "glossy bar": _glossy_bar,
}
