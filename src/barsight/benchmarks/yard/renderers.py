"""Compare yards drawn by our renderer with the same yards path-traced by Mitsuba, by what is measured."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from rich.box import SIMPLE_HEAD
from rich.table import Table

from barsight.benchmarks.provenance import Provenance
from barsight.evaluation.score import Figures, score_folder
from barsight.simulation.effects.settings import LightSettings
from barsight.simulation.settings.recording import SimulationSettings
from barsight.simulation.settings.rig import CameraSettings, SensorSettings
from barsight.simulation.settings.yard import YardSettings
from barsight.simulation.simulate import simulate

RENDERERS: tuple[Literal["barsight", "mitsuba"], ...] = ("barsight", "mitsuba")
SCENE = SimulationSettings(
    length_m=1.4,
    frames=5,
    depth_views=0,
    camera=CameraSettings(
        width_px=400, height_px=320, focal_px=625.0, baseline_m=0.3, above_floor_m=4.2, trolley_y_m=0.0
    ),
    yard=YardSettings(bar_length_m=2.4, max_layers=2, ribbed_ratio=0.0, texture_ratio=0.6),
    sensors=SensorSettings(laser_y_m=(0.45, -0.6)),
    light=LightSettings(ambient=0.5, bounce_ratio=0.5),
)
"""A small yard seen from near, with pixels as wide as those of a full-size picture from 8 m, and light and
texture in the middle of what drawn worlds have.
"""
PLACES = {
    "contour, smooth places": "contours",
    "height, smooth stack": "stack",
    "height, seen by two": "all cells",
}
FIGURES = {"median": "median_mm", "bias": "bias_mm", "P95": "p95_mm", "in 95 %": "within_95_pct"}


@dataclass(frozen=True)
class RenderedScene:
    """One kind of bars, by one renderer. figures: of `score_folder`, by what they describe."""

    bars: str
    renderer: str
    figures: dict[str, Figures]


@dataclass(frozen=True)
class RendererBench:
    """All scenes, one after the other by both renderers."""

    scenes: tuple[RenderedScene, ...]
    provenance: Provenance


def render_scenes(
    bars: Sequence[str], seed: int, paths: int, folder: Path, measure: Callable[[Path, Path], None],
    done: Callable[[RenderedScene], None],
) -> tuple[RenderedScene, ...]:  # fmt: skip
    """Simulate and measure a scene of each kind of bars by both renderers, in subfolders of `folder`.

    Recordings and measured folders that are there are kept. done: called after each.
    """
    scenes = []
    for number, kind in enumerate(bars):
        for renderer in RENDERERS:
            settings = replace(SCENE, bars=kind, seed=seed + number, renderer=renderer, paths=paths)
            own = folder / f"{kind.replace(':', '_')}_{settings.seed}_{renderer}"
            own = own.with_name(f"{own.name}_{paths}") if renderer == "mitsuba" else own
            if not (own / "recording").exists():
                own.mkdir(parents=True, exist_ok=True)
                simulate(own / "recording", settings)
            if not (own / "measured" / "result.json").is_file():
                measure(own / "recording", own / "measured")
            scene = RenderedScene(kind, renderer, score_folder(own / "recording", own / "measured"))
            scenes.append(scene)
            done(scene)
    return tuple(scenes)


def renderer_table(bench: RendererBench) -> Table:
    """Tabulate both renderers: contours and stack on smooth places, and all cells that two views see."""
    table = Table("bars", "places", title="barsight | mitsuba, mm and %", box=SIMPLE_HEAD)
    for name in FIGURES:
        table.add_column(name, justify="right")
    pairs = zip(bench.scenes[::2], bench.scenes[1::2], strict=True)
    for ours, theirs in pairs:
        for places, name in PLACES.items():
            figures = [scene.figures.get(places, {}) for scene in (ours, theirs)]
            values = [
                " | ".join(f"{one.get(key, math.nan):.1f}" for one in figures) for key in FIGURES.values()
            ]
            table.add_row(ours.bars, name, *values)
        table.add_section()
    return table
