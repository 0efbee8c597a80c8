"""Dig bundles out of drawn yards and judge every lift: `python benchmarks/digging.py 0:500`.

Each number is one order: a yard is drawn (bars along Y, along X or askew), a covered bundle named, and the
order asked for. Its first lift is made with the crane's error, the yard measured anew, and so on until the
bundle is out or the answer is a refusal. `digging_judge.py` judges each set-down and way on exact geometry.
"""

from __future__ import annotations

import math
import sys
import time
from collections import Counter
from dataclasses import asdict, replace

import numpy as np
from digging_judge import CELL_M, Bars, Beam, World, judge_set_down, judge_way, undermined
from drawn_errors import SIGMA, seen_heights

from barsight.core.errors import Failed
from barsight.simulation.settings.recording import SimulationSettings
from barsight.simulation.settings.yard import YardSettings
from barsight.simulation.stock import stack_yard
from barsight.yard.lift_settings import LiftSettings
from barsight.yard.lifting.order import order_lifts
from barsight.yard.lifting.targets import plan_lifts
from barsight.yard.magnet.description import load_magnet
from barsight.yard.types import Bundle, HeightMap

KINDS = ("90mm:7", "60mm:7", "40mm:19", "60mm:19", "40mm:37", "90mm:7,40mm:19")
MAX_LIFTS = 8
MAX_S = 270.0
"""After this long the run ends with the order it is at."""


def draw(number: int) -> tuple[World, LiftSettings, np.random.Generator]:
    """Draw the yard of an order, and how its crane may turn and what dunnage is laid."""
    rng = np.random.default_rng([17, number])
    yard = YardSettings(
        max_layers=2 + number % 3, gap_m=float(rng.uniform(0.05, 0.35)), skew_deg=float(rng.uniform(0, 0.4)),
        missing_ratio=float(rng.uniform(0, 0.3)), bar_length_m=float(rng.uniform(5.5, 7.5)),
        dunnage_m=float(rng.uniform(0.05, 0.12)), crossed_ratio=0.3 if number % 4 == 3 else 0.0,
    )  # fmt: skip
    drawn = SimulationSettings(
        length_m=float(rng.uniform(1.0, 2.0)), seed=number, bars=KINDS[number % 6], yard=yard
    )
    stock = stack_yard(drawn, rng)
    turn = (0.0, math.pi / 2, float(rng.uniform(-0.3, 0.3)))[number % 3]
    cos, sin = math.cos(turn), math.sin(turn)
    matrix = np.array([[cos, -sin], [sin, cos]])
    bundles = []
    for k, one in enumerate(stock.bundles):
        x, y = matrix @ one.centre_m[:2]
        yaw = (one.yaw_rad + turn + math.pi / 2) % math.pi - math.pi / 2
        bundles.append(
            Bars(
                k, float(x), float(y), float(one.centre_m[2]), yaw,
                _turned(one.cross_m, one.yaw_rad + turn, yaw), one.kind.diameter_m, one.length_m,
            )
        )  # fmt: skip
    beams = tuple(
        Beam(np.append(matrix @ b.centre_m[:2], b.centre_m[2]), b.half_m, b.yaw_rad + turn)
        for b in stock.beams
    )
    axes = np.array([(-math.sin(b.yaw_rad), math.cos(b.yaw_rad)) for b in bundles])
    half = np.array([b.length_m / 2 for b in bundles])[:, None] * axes
    middle = np.array([(b.x_m, b.y_m) for b in bundles])
    ends = np.concatenate([middle - half, middle + half])
    world = World(tuple(bundles), beams, np.floor(ends.min(axis=0) - 2.5), np.ceil(ends.max(axis=0) + 2.5))
    settings = LiftSettings(max_turn_deg=(5.0, 90.0)[number % 2], dunnage_m=(0.0, 0.09)[number // 2 % 2])
    return world, settings, rng


def _turned(cross_m: np.ndarray, drawn_rad: float, yaw_rad: float) -> np.ndarray:
    """The section as seen along the axis, which runs the other way where the yaw was wrapped."""
    flipped = math.cos(drawn_rad - yaw_rad) < 0
    return np.asarray(cross_m * (-1, 1) if flipped else cross_m)


def measured(world: World, rng: np.random.Generator) -> tuple[HeightMap, tuple[Bundle, ...]]:
    """Draw the map and the bundles as a measurement would have them, errors and unseen cells included."""
    z = world.raster().astype(np.float32)
    exact = HeightMap(
        float(world.low_m[0]), float(world.low_m[1]), CELL_M, z, np.full_like(z, 1e-4), np.full_like(z, 5.0),
        np.ones(z.shape, np.uint8),
    )  # fmt: skip
    ordered = sorted(world.bundles, key=lambda b: b.number)
    return seen_heights(exact, rng), tuple(_seen(b, world, rng) for b in ordered)


def _seen(bars: Bars, world: World, rng: np.random.Generator) -> Bundle:
    yaw = bars.yaw_rad + rng.normal(0, SIGMA.yaw_rad)
    along = np.array([-math.sin(yaw), math.cos(yaw), 0.0])
    side = np.array([math.cos(yaw), math.sin(yaw), 0.0])
    centre = np.array([bars.x_m, bars.y_m, bars.z_m])
    centre = centre + side * rng.normal(0, SIGMA.lateral_m) + along * rng.normal(0, SIGMA.along_m)
    length = bars.length_m + rng.normal(0, SIGMA.length_m)
    return Bundle(
        id=bars.number, centre_m=centre, yaw_rad=yaw, pitch_rad=0.0, length_m=length,
        ends_m=np.stack([centre + s * length / 2 * along for s in (-1, 1)]), ends_open=(False, False),
        width_m=bars.width_m + rng.normal(0, SIGMA.width_m),
        top_z_m=bars.top_z_m + rng.normal(0, SIGMA.top_z_m),
        bar_diameter_m=bars.diameter_m + rng.normal(0, SIGMA.bar_diameter_m), visible_bars=3,
        bars=len(bars.cross_m), layer=int(bars.bottom_z_m > 0.2), on_top=not undermined(world, bars.number),
        neighbours=(), sigma=SIGMA, known_share=1.0, confidence=0.99, reasons=(),
    )  # fmt: skip


def _needed(world: World, target: int) -> set[int]:
    """The bundle and all that truly lie over it, one on the other."""
    needed, open_ = set[int](), [target]
    while open_:
        one = open_.pop()
        if one not in needed:
            needed.add(one)
            open_ += undermined(world, one)
    return needed


def dig(number: int) -> Counter[str]:
    """Make one order and judge it."""
    world, settings, rng = draw(number)
    example, told = load_magnet(None), Counter[str]()
    # As narrow as its poles, to reach down between taller neighbours.
    magnet = replace(example, beam=replace(example.beam, width_m=0.1))
    box, beam = magnet.tolerance, magnet.beam
    covered = [b.number for b in world.bundles if undermined(world, b.number)]
    target = int(rng.choice(covered or [b.number for b in world.bundles]))
    for lift in range(MAX_LIFTS):
        heights, bundles = measured(world, rng)
        # The plan is asked for what this order may begin with: the others stay where they are as obstacles.
        needed = _needed(world, target)
        asked = tuple(b if b.id in needed else replace(b, on_top=False) for b in bundles)
        plan = plan_lifts(heights, asked, magnet, settings, ())
        order = order_lifts(target, heights, bundles, plan)
        if isinstance(order, Failed):
            told[f"refused, {order.code}"] += 1
            told.update({f"  veto {veto.code}" for refused in plan.refused for veto in refused.vetoes})
            told["begun and refused"] += lift > 0
            return told
        step = order.steps[0]
        (load,) = (b for b in world.bundles if b.number == step.bundle)
        error = tuple(rng.uniform(-1, 1, 3) * (box.x_m, box.y_m, math.radians(box.yaw_deg)))
        lies, beams, unsupported, collides = judge_set_down(
            world, load, asdict(step.set_down), error, settings.dunnage_m,
            (beam.length_m, beam.width_m, beam.above_faces_m),
        )  # fmt: skip
        collides += judge_way(world, load, lies, step.travel_z_m, 0.8 * settings.swing_m)
        told["lifts"] += 1
        told["set down turned"] += abs(step.set_down.turn_deg) > 45
        told["set down on bundles"] += step.set_down.z_m > settings.dunnage_m + 0.1
        told["lifted from under another"] += bool(undermined(world, load.number))
        told["unsupported"] += bool(unsupported)
        told["collisions"] += bool(collides)
        for reason in unsupported + collides:
            print(f"order {number}, lift {lift + 1} of bundle {step.bundle}: {reason}", flush=True)
        if step.bundle == target:
            told["dug out"] += 1
            return told
        world = world.changed(lies, load.number, beams)
    told["unfinished"] += 1
    return told


def main() -> None:
    """Make the orders and print the counts."""
    first, last = (int(part) for part in sys.argv[1].split(":"))
    total, start = Counter[str](), time.perf_counter()
    for number in range(first, last):
        total += dig(number)
        total["orders"] += 1
        if time.perf_counter() - start > MAX_S:
            break
    for name, count in sorted(total.items()):
        print(f"{name}: {count}")
    print(f"{first}:{number + 1} in {time.perf_counter() - start:.0f} s")


if __name__ == "__main__":
    main()
