"""Simulate a recording, with its truth, of a whole world drawn from a seed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from barsight.core.arrays import Int64
from barsight.simulation.passes import simulate_passes
from barsight.simulation.rays import cast_rays
from barsight.simulation.scene import Scene
from barsight.simulation.settings.recording import SimulationSettings
from barsight.simulation.simulate import LaidYard, simulate
from barsight.simulation.textures import label_codes
from barsight.simulation.truth import label_rows
from barsight.simulation.worlds.conditions import draw_conditions
from barsight.simulation.worlds.solids import SolidYard
from barsight.simulation.worlds.surfaces import draw_finishes, owners, scene_of
from barsight.simulation.worlds.yards import LOOSE, DrawnBundle, DrawnYard, bow_at, draw_yard, kind_of

GENERATOR = 1
"""Version of the generator: incremented whenever the same seed draws a different world."""
ABOVE_M = 50.0
COVER_STEP_M = 0.004
"""Spacing of the vertical rays that look down on a bundle, m: a quarter of the thinnest diameter."""
COVERED_RATIO = 0.02
"""Hidden share of a bundle, seen from above, at and above which the bundle counts as covered."""
CROSSED_RATIO = 0.1
"""Hidden share of a bundle's width, anywhere along it, at and above which the bundle counts as covered."""
DIM_RATIO, BLURRED_S = 0.7, 0.004


@dataclass(frozen=True, eq=False)
class DrawnWorld:
    """A yard, its surfaces, and the conditions under which it is recorded."""

    drawn: DrawnYard
    finishes: dict[int, str]
    scene: Scene
    settings: SimulationSettings


def draw_world(seed: int, given: SimulationSettings) -> DrawnWorld:
    """Draw a whole world from a seed; see `draw_conditions` for the settings taken from `given`.

    The travel is as long as the yard has become, with as many pairs per metre as in `given`.
    """
    settings = draw_conditions(seed, given, hides=kind_of(seed) == "unseen")
    drawn = draw_yard(seed, settings.yard.bar_length_m, settings.length_m)
    length = round(max(drawn.size_m[0], 1.0), 2)
    frames = max(round(given.frames * length / given.length_m), 4)
    settings = replace(settings, length_m=length, frames=frames, depth_views=min(given.depth_views, frames))
    rng = np.random.default_rng((29, seed))
    finishes = draw_finishes(drawn.yard.bundles, rng)
    scene = scene_of(drawn.yard, finishes, rng, settings.yard.label_m)
    return DrawnWorld(drawn, finishes, scene, settings)


def simulate_world(out: Path, world: DrawnWorld, progress: Callable[[int, int], None] | None = None) -> None:
    """Write the recording of a world, with its truth, to the new folder `out`; see `simulate`."""
    rows = bundle_truth(world)
    laid = LaidYard(world.scene, {"bundles.json": rows, "world.json": world_truth(world)})
    if max(world.settings.yard.label_m) > 0:
        truth = {**laid.truth, "labels.json": label_rows(world.scene, world.drawn.seed)}
        laid = LaidYard(world.scene, truth, label_codes(world.drawn.seed, len(rows)))
    write = simulate_passes if world.settings.passes.trolley_y_m else simulate
    write(out, world.settings, progress, laid)


def bundle_truth(world: DrawnWorld) -> list[dict[str, Any]]:
    """Describe the bundles, and the bars that belong to none, in the format of `bundles.json`."""
    owner = owners(world.drawn.yard)
    return [_row(bundle, world, owner) for bundle in world.drawn.bundles]


def _row(bundle: DrawnBundle, world: DrawnWorld, owner: Int64) -> dict[str, Any]:
    cross, radius = bundle.cross_m, bundle.diameter_m / 2
    low, high = cross.min(axis=0) - radius, cross.max(axis=0) + radius
    covered, crossed = cover(world.scene, owner, bundle)
    return {
        "sec": bundle.section, "lay": bundle.layer, "col": bundle.number, "center": bundle.centre_m.tolist(),
        "yaw_deg": float(np.degrees(bundle.yaw_rad)),
        "bundle_radius": float(np.hypot(*cross.T).max()) + radius, "width": float(high[0] - low[0]),
        "bar_diameter": bundle.diameter_m, "bars": len(cross), "length": bundle.length_m,
        "top_z": float(bundle.centre_m[2] + high[1]), "mass_kg": world.drawn.yard.load(bundle.number)[0],
        "covered": round(covered, 4), "on_top": is_uncovered(covered, crossed),
        "is_loose": bundle.number >= LOOSE, "manner": bundle.manner, "bow": bundle.bow_m,
        "finish": world.finishes[bundle.number], "cross": np.round(cross, 5).tolist(),
    }  # fmt: skip


def is_uncovered(covered: float, crossed: float) -> bool:
    """Tell from a bundle's `cover` whether nothing lies on it."""
    return covered < COVERED_RATIO and crossed < CROSSED_RATIO


def cover(scene: Scene, owner: Int64, bundle: DrawnBundle) -> tuple[float, float]:
    """Compute the share of a bundle's bars hidden from above, and the largest share on a line across it.

    owner: (P + 1,) bundle of each primitive of the scene, the floor last. Surfaces seen beyond a bar's end
    and between two bars are lower than the bars and hide nothing.
    """
    x, z, radius = bundle.cross_m[:, 0], bundle.cross_m[:, 1], bundle.diameter_m / 2
    u = np.arange(x.min() - radius + COVER_STEP_M / 2, x.max() + radius, COVER_STEP_M)
    rise = radius**2 - (u[:, None] - x) ** 2
    own = np.where(rise > 0, z + np.sqrt(np.maximum(rise, 0)), -np.inf).max(axis=1) + bundle.centre_m[2]
    u, own = u[np.isfinite(own)], own[np.isfinite(own)]
    v = np.linspace(-0.5, 0.5, max(3, round(bundle.length_m / COVER_STEP_M))) * bundle.length_m
    c, s = np.cos(bundle.yaw_rad), np.sin(bundle.yaw_rad)
    across, along = np.array([c, s, 0.0]), np.array([-s, c, 0.0])
    aside = u + bow_at(bundle.bow_m, bundle.length_m, v)[:, None]
    origins = bundle.centre_m + aside[..., None] * across + v[:, None, None] * along
    origins[..., 2] = ABOVE_M
    distance, found = cast_rays(scene, origins.reshape(-1, 3), np.tile([0.0, 0.0, -1.0], (aside.size, 1)))
    is_own = (owner[found] == bundle.number).reshape(aside.shape)
    hidden = ~is_own & (ABOVE_M - distance.reshape(aside.shape) > own)
    asked = np.count_nonzero(is_own | hidden, axis=1)
    lines = hidden.sum(axis=1)[asked > 0] / asked[asked > 0]
    return float(hidden.sum() / asked.sum()), float(lines.max())


def world_truth(world: DrawnWorld) -> dict[str, Any]:
    """Describe the drawn world for `world.json`: its kind, its conditions, and flags to split scores by."""
    drawn, settings = world.drawn, world.settings
    finishes = sorted(world.finishes.values())
    return {
        "generator": GENERATOR, "seed": drawn.seed, "kind": drawn.kind, "size_m": list(drawn.size_m),
        "manners": sorted({b.manner for b in drawn.bundles}),
        "finish": max(set(finishes), key=finishes.count),
        "bundles": sum(b.number < LOOSE for b in drawn.bundles),
        "loose_bars": sum(b.number >= LOOSE for b in drawn.bundles),
        "parts": _parts(drawn.yard),
        "conditions": conditions(settings),
        "light": asdict(settings.light), "motion": asdict(settings.motion),
        "sensors": asdict(settings.sensors), "faults": asdict(settings.faults),
    }  # fmt: skip


def conditions(settings: SimulationSettings) -> dict[str, bool]:
    """Flag what is out of the ordinary in light, crane and images, to split scores by."""
    light, faults, motion = settings.light, settings.faults, settings.motion
    return {
        "sun": light.sun_ratio > 0,
        "dim": light.lamp_ratio < DIM_RATIO,
        "stops": motion.stops > 0,
        "trolley": motion.trolley_m != 0,
        "blur": faults.exposure_s > BLURRED_S,
        "haze": faults.haze_ratio > 0,
        "dirt": faults.dirt_spots + faults.drops > 0,
        "dead pixels": faults.dead_pixels > 0,
        "exposure steps": faults.exposure_step_ratio > 0,
        "flicker": faults.flicker_ratio > 0,
        "glare": faults.glare_ratio > 0,
    }


def _parts(yard: SolidYard) -> dict[str, int]:
    parts = [s.part for s in yard.solids]
    return {part: parts.count(part) for part in sorted(set(parts))}
