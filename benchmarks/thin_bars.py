"""Lay thin loose bars across drawn yards, render and measure them, and score what is found of them.

`python benchmarks/thin_bars.py KEEP SEED...`: KEEP takes the yards. The bars are drawn from geometry: each
lies level on the highest solid under it. Nothing that finds them is used to lay them. A seed after `plain` is
taken as drawn, with none laid.
"""

from __future__ import annotations

import math
import sys
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np

from barsight.benchmarks.lift_judge.envelopes import envelope
from barsight.benchmarks.yard.drawn_worlds import render_world
from barsight.measure_folder import measure_into
from barsight.measure_settings import MeasureSettings
from barsight.result_folder import read_heights
from barsight.simulation.worlds.solids import Solid, SolidYard, cylinder
from barsight.simulation.worlds.yards import LOOSE, DrawnYard, draw_yard
from barsight.yard.inventory.bundle_file import read_bundles
from barsight.yard.thin_lines import MAX_STRENGTH, line_strengths
from barsight.yard.types import Bundle

DIAMETERS_M = (0.008, 0.012, 0.016, 0.020, 0.025, 0.030, 0.036)
FIRST_NUMBER = 2000
"""Owner of the first bar that is laid; none of a drawn world's own is as high."""
BAR_LENGTH_M, SPAN_M = 5.4, 3.0
SLOT_M = 0.6
STANDS_OUT_M = 0.06
"""A bar is not laid where it would rest higher than this over the load's own top."""


def lay_thin_bars(seed: int) -> DrawnYard:
    """Draw the yard of a seed and lay a thin bar across it every SLOT_M along its bars."""
    world = draw_yard(seed, BAR_LENGTH_M, SPAN_M, min_length_ratio=1.0)
    if not world.free:
        raise SystemExit(f"seed {seed} draws a yard on which every bundle is covered")
    rng = np.random.default_rng((41, seed))
    number = FIRST_NUMBER
    for slot in np.arange(-2.2, 2.3, SLOT_M):
        for _ in range(10):
            bar = _bar(world, float(slot + rng.uniform(-0.1, 0.1)), number, rng)
            if bar is not None:
                world = replace(world, yard=SolidYard((*world.yard.solids, bar)))
                number += 1
                break
    return world


def _bar(world: DrawnYard, slot: float, number: int, rng: np.random.Generator) -> Solid | None:
    """Lay a bar over a free bundle, one of three square to it as straps are, one nearly so, one at any angle
    up to 50 degrees from that; None where something stands in its way."""
    load = world.yard.bars(int(rng.choice(world.free)))
    radius = float(rng.choice(DIAMETERS_M)) / 2
    length = float(rng.uniform(0.5, 1.8))
    askew = (rng.normal(0, 0.01), rng.normal(0, 0.1), rng.uniform(-0.87, 0.87))[int(rng.integers(3))]
    along = load[0].axes[0]
    middle = np.mean([b.centre for b in load], axis=0) + slot * along
    angle = math.atan2(along[1], along[0]) - math.pi / 2 + float(askew)
    direction = np.array([math.cos(angle), math.sin(angle), 0.0])
    middle += float(rng.uniform(-0.35, 0.35)) * length * direction
    reach = np.abs(direction[:2]) * length / 2 + radius
    low, high = middle[:2] - reach, middle[:2] + reach
    drawn = envelope(world.yard, (low[0], low[1]), (high[0], high[1]), step=0.005)
    x, y = (start + 0.005 * np.arange(n) for start, n in zip(low, drawn.z.shape, strict=True))
    away = (x[:, None] - middle[0]) * -direction[1] + (y[None] - middle[1]) * direction[0]
    top = float(drawn.z[np.abs(away) < radius + 0.003].max())
    if top > max(b.bounds[1, 2] for b in load) + STANDS_OUT_M:
        return None
    return cylinder("bar", np.array([*middle[:2], top + 0.0005 + radius]), direction, radius, length, number)


def crossings(world: DrawnYard, bundle: Bundle) -> list[tuple[float, float, float, float]]:
    """List the single bars across a found bundle: place along its axis from its middle, slope, the share of
    its width that they cover, and diameter: NaN of one more than 0.05 m under or 0.15 m over its top."""
    axis = np.array([-math.sin(bundle.yaw_rad), math.cos(bundle.yaw_rad)])
    frame, found = np.array([[axis[1], -axis[0]], axis]), []
    for bar in (s for s in world.yard.solids if s.part == "bar" and s.bundle >= LOOSE):
        ends = [bar.centre + side * bar.half[0] * bar.axes[0] - bundle.centre_m for side in (-1, 1)]
        (u0, v0), (u1, v1) = sorted((frame @ end[:2]).tolist() for end in ends)
        low, high = max(u0, -bundle.width_m / 2), min(u1, bundle.width_m / 2)
        slope = (v1 - v0) / max(u1 - u0, 1e-6)
        at = v0 - slope * u0
        if high > low and abs(at) < bundle.length_m / 2 - 0.12:
            on_it = -0.05 < bar.bounds[1, 2] - bundle.top_z_m < 0.15
            diameter = 2 * float(bar.half[1]) if on_it else math.nan
            found.append((at, slope, (high - low) / bundle.width_m, diameter))
    return found


def score(world: DrawnYard, out: Path, found: dict[float, list[bool]], alarms: list[float]) -> None:
    """Score a measured yard's uncovered bundles of 2 m and more: whether each bar that covers 0.9 of one's
    width is found, by diameter; the strongest line on each that nothing lies on."""
    heights = read_heights(out).whole()
    for bundle in read_bundles(out / "bundles.json"):
        strengths = line_strengths(heights, bundle)
        if bundle.length_m < 2 or bundle.on_top is False or strengths is None:
            continue
        along, strength = strengths[0], strengths[1].max(axis=0)
        across = crossings(world, bundle)
        for at, _, share, diameter in across:
            if share >= 0.9 and not math.isnan(diameter):
                near = np.abs(along - at) < 0.06
                found[round(diameter, 3)].append(bool((strength[near] > MAX_STRENGTH).any()))
        if not across:
            alarms.append(float(strength.max()))


def main(arguments: list[str]) -> None:
    """Render, measure and score the seeds; what is finished in the folder is not done again."""
    found, alarms, plain = defaultdict[float, list[bool]](list), list[float](), False
    for argument in arguments[1:]:
        if argument == "plain":
            plain = True
            continue
        seed = int(argument)
        world = draw_yard(seed, BAR_LENGTH_M, SPAN_M, min_length_ratio=1.0) if plain else lay_thin_bars(seed)
        folder = Path(arguments[0]) / f"seed_{seed}"
        folder.mkdir(parents=True, exist_ok=True)
        if not (folder / "recording").is_dir():
            render_world(world, folder / "recording")
        if not (folder / "measured/result.json").is_file():
            measure_into(
                folder / "recording", folder / "measured", MeasureSettings(), report=False, judged_at="end"
            )
        score(world, folder / "measured", found, alarms)
    for diameter, hits in sorted(found.items()):
        print(f"{1e3 * diameter:.0f} mm: {sum(hits)} of {len(hits)} found")
    over = sum(strength > MAX_STRENGTH for strength in alarms)
    print(f"false alarms: {over} of {len(alarms)} bundles; strengths P50, P95, max:", end=" ")
    print(np.percentile(alarms, [50, 95, 100]).round(1) if alarms else "none")


if __name__ == "__main__":
    main(sys.argv[1:])
