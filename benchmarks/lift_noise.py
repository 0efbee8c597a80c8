"""Count offers that tiny noise turns into vetoes, or back: `python benchmarks/lift_noise.py 20:61 [WORKERS]`.

Draws a yard per seed from geometry alone, chooses its lifts, and chooses them again for maps with 0.05 mm of
noise and bundles with 0.01 mm. A flip is told where every veto of the refused side says that its figure lies
within its sigma of the limit.
"""

from __future__ import annotations

import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from barsight.cli.bench.seeds import over_seeds, parse_seeds
from barsight.core.records.heights import HeightSource
from barsight.yard.lifting.targets import LiftPlan, plan_lifts
from barsight.yard.types import Bundle, HeightMap
from lift_yards import MAGNET, SETTINGS, SIGMA, map_of, record
from yard_maps import Laid

MAP_NOISE_M, BUNDLE_NOISE_M = 5e-5, 1e-5
REPEATS = 6
TOLD = "of the limit"


def main() -> None:
    """Count over the seeds and print."""
    seeds, workers = parse_seeds(sys.argv[1], "lift noise"), int(sys.argv[2]) if len(sys.argv) > 2 else 1
    counted = [one for _, one in over_seeds(count, seeds, None, workers, None)]
    told, offers = (sum(one[place] for one in counted) for place in (0, 2))
    untold, refusals = (sum((one[place] for one in counted), Counter[str]()) for place in (1, 3))
    print(f"offers {offers}, refused for {dict(refusals.most_common())}")
    print(f"{REPEATS * offers} offers with noise: {told} flips told, {untold.total()} not: {dict(untold)}")


def count(seed: int, _: object) -> tuple[int, Counter[str], int, Counter[str]]:
    """Count of a seed the flips that are told, those that aren't by codes, offers, and which codes refuse."""
    told, untold = 0, Counter[str]()
    rng = np.random.default_rng(seed)
    heights, bundles = draw(rng)
    magnet = replace(MAGNET, safety_factor=float(rng.uniform(2.0, 2.8)))
    plain = plan_lifts(heights, bundles, magnet, SETTINGS, ())
    for _ in range(REPEATS):
        noisy = plan_lifts(*disturbed(rng, heights, bundles), magnet, SETTINGS, ())
        for reasons in flips(plain, noisy):
            if all(TOLD in reason for _, reason in reasons):
                told += 1
            else:
                untold[",".join(sorted({code for code, _ in reasons}))] += 1
    refusals = Counter({veto.code for lift in plain.refused for veto in lift.vetoes})
    return told, untold, len(plain.offered), refusals


def draw(rng: np.random.Generator) -> tuple[HeightMap, tuple[Bundle, ...]]:
    """A row of bundles on dunnage, some with another on top, blocks beside and over them, unseen spots."""
    stock, x = list[Laid](), 0.0
    covered = set[int]()
    for _ in range(6):
        bars = int(rng.choice([7, 7, 19]))
        diameter = float(rng.uniform(0.06, 0.11) if bars == 7 else rng.uniform(0.035, 0.06))
        roll = float(rng.choice([0.0, rng.uniform(-3, 3), rng.uniform(0, 60)]))
        one = Laid(0.0, float(rng.normal(0, 0.1)), 0.0, float(rng.normal(0, 0.5)), diameter, bars,
                   float(rng.uniform(5.0, 8.0)), roll)  # fmt: skip
        x += one.width_m / 2
        stock.append(replace(one, x_m=x, z_m=one.width_m / 2 + float(rng.uniform(0.02, 0.25))))
        x += one.width_m / 2 + float(rng.choice([rng.uniform(0.005, 0.06), rng.uniform(0.06, 0.3)]))
    for number in range(6):
        if rng.random() < 0.2:
            below = stock[number]
            covered.add(number)
            shift = float(rng.normal(0, 0.05))
            stock.append(replace(below, x_m=below.x_m + shift, z_m=below.top_z_m + below.width_m / 2 + 0.05))
    heights = map_of(stock, sigma_m=float(rng.uniform(0.001, 0.004)), seed=int(rng.integers(1 << 30)))
    for _ in range(2):
        near = stock[int(rng.integers(len(stock)))]
        block(rng, heights, near, unseen=rng.random() < 0.3)
    found = []
    for number, one in enumerate(stock):
        told = record(one, number, on_top=number not in covered, layer=int(number >= 6))
        found.append(moved(rng, told, 0.002))
    return heights, tuple(found)


def block(rng: np.random.Generator, heights: HeightMap, near: Laid, *, unseen: bool) -> None:
    """Lay a block on or beside a bundle, from 0 to 60 mm over its top, or hide what lies there."""
    x, y = near.x_m + rng.normal(0, 0.15), near.y_m + rng.uniform(-2.5, 2.5)
    long, wide = rng.uniform(0.02, 0.4, 2)
    row, column = (np.arange(n) * heights.cell_m for n in heights.shape)
    rows = np.flatnonzero(np.abs(heights.y0_m + row - y) < long / 2)[:, None]
    columns = np.flatnonzero(np.abs(heights.x0_m + column - x) < wide / 2)
    if unseen:
        heights.source[rows, columns] = HeightSource.UNKNOWN
    else:
        top = np.float32(near.top_z_m + rng.uniform(-0.01, 0.04))
        heights.z_m[rows, columns] = np.maximum(heights.z_m[rows, columns], top)


def disturbed(
    rng: np.random.Generator, heights: HeightMap, bundles: tuple[Bundle, ...]
) -> tuple[HeightMap, tuple[Bundle, ...]]:
    noise = rng.normal(0, MAP_NOISE_M, heights.shape).astype(np.float32)
    return replace(heights, z_m=heights.z_m + noise), tuple(moved(rng, b, BUNDLE_NOISE_M) for b in bundles)


def moved(rng: np.random.Generator, one: Bundle, by_m: float) -> Bundle:
    """A bundle whose every figure is off by so much."""
    centre = one.centre_m + rng.normal(0, by_m, 3)
    length, width, top = (v + rng.normal(0, by_m) for v in (one.length_m, one.width_m, one.top_z_m))
    yaw = one.yaw_rad + rng.normal(0, by_m / 3)
    along = np.array([-np.sin(yaw), np.cos(yaw), 0.0]) * length / 2
    return replace(one, centre_m=centre, length_m=length, width_m=width, top_z_m=top, yaw_rad=yaw,
                   ends_m=np.stack([centre - along, centre + along]), sigma=SIGMA)  # fmt: skip


def flips(one: LiftPlan, other: LiftPlan) -> list[list[tuple[str, str]]]:
    """Code and reason of the vetoes of each bundle that only one of both plans offers."""
    found = []
    for here, there in ((one, other), (other, one)):
        offered = {lift.bundles for lift in here.offered}
        refused = {frozenset(lift.bundles): lift for lift in there.refused}
        for ids in offered - {lift.bundles for lift in there.offered}:
            lift = refused.get(frozenset(ids))
            found.append([(v.code, v.reason) for v in lift.vetoes] if lift else [("gone", "")])
    return found


if __name__ == "__main__":
    main()
