"""Lay thin loose bars across drawn yards, render and measure them, and score what is found of them.

`python benchmarks/thin_bars.py SEED... --keep DIR`. The bars are drawn from geometry: each lies level on the
highest solid under it. Nothing that finds them is used to lay them.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from barsight.benchmarks.lift_judge.solids import NOTHING, Solid, SolidYard, cylinder, envelope
from barsight.benchmarks.lift_judge.worlds import DrawnWorld, draw_world

Array = NDArray[np.float64]
DIAMETERS_M = (0.008, 0.012, 0.016, 0.020, 0.025, 0.030, 0.036)
FIRST_NUMBER = 2000
"""Owner of the first bar that is laid; none of a drawn world's own is as high."""
BAR_LENGTH_M, SPAN_M = 5.4, 3.0
SLOT_M = 0.6
STANDS_OUT_M = 0.06
"""A bar is not laid where it would rest higher than this over the load's own top."""


def lay_thin_bars(seed: int) -> DrawnWorld:
    """Draw the yard of a seed and lay a thin bar across it every SLOT_M along its bars."""
    world = draw_world(seed, BAR_LENGTH_M, SPAN_M)
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


def _bar(world: DrawnWorld, slot: float, number: int, rng: np.random.Generator) -> Solid | None:
    """Lay a bar over a free bundle, two of three nearly across, else at any angle up to 50 degrees from that;
    None where something stands in its way."""
    load = world.yard.bars(int(rng.choice(world.free)))
    radius = float(rng.choice(DIAMETERS_M)) / 2
    length = float(rng.uniform(0.5, 1.8))
    askew = rng.normal(0, 0.1) if rng.random() < 2 / 3 else rng.uniform(-0.87, 0.87)
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


def laid(world: DrawnWorld) -> tuple[Solid, ...]:
    """Return the bars that were laid."""
    return tuple(s for s in world.yard.solids if s.bundle >= FIRST_NUMBER and s.bundle != NOTHING)
