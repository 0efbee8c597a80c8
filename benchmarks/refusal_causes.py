"""Tell what the refusals of truly fine lifts rest on: the map, the bundles found in it, or the limits.

`python benchmarks/refusal_causes.py KEEP FIRST:LAST [PLACEMENTS]`: KEEP has yards that `barsight bench lifts
--rendered --full-size --keep KEEP` measured, with the example magnet. Placements over free bundles that the
independent judge finds fine are assessed on the measured map and on the exact one with noise, with the
bundles found in each and with the true ones.
"""

from __future__ import annotations

import math
import sys
import tempfile
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np

from barsight.benchmarks.lift_judge.judge import Judge, Target
from barsight.benchmarks.lift_judge.magnet import JudgedMagnet, read_magnet
from barsight.benchmarks.yard.drawn_worlds import (
    MappedWorld,
    drawn_scene,
    judged_yard,
    map_world,
    measured_world,
    noisy_world,
)
from barsight.benchmarks.yard.judged_lifts import draw_beside
from barsight.benchmarks.yard.liftable_bundles import over_bundle
from barsight.cli.bench.seeds import parse_seeds
from barsight.simulation.worlds.recording import cover, is_uncovered
from barsight.simulation.worlds.surfaces import owners
from barsight.simulation.worlds.yards import DrawnBundle, DrawnYard
from barsight.yard.bundles.layers import list_neighbours
from barsight.yard.lift_settings import LiftSettings
from barsight.yard.lifting.assessment import assess_placement
from barsight.yard.magnet.description import example_magnet, load_magnet
from barsight.yard.magnet.footprint import Placement
from barsight.yard.types import Bundle, BundleSigma

SETTINGS = LiftSettings()
SIGMA = BundleSigma(0.002, 0.005, 0.001, 0.01, 0.004, 0.001, 0.0005, 1e-5)
"""Of a true bundle: checks that allow for a sigma have next to none to allow for."""
LOWEST_LAYER_M = 0.25
"""A bundle whose underside is lower lies on the floor or its dunnage."""


def true_bundles(world: DrawnYard) -> tuple[Bundle, ...]:
    """Describe the drawn bundles as if all of them were known."""
    scene, owner = drawn_scene(world), owners(world.yard)
    known = []
    for number, drawn in enumerate(world.bundles):
        known.append(_bundle(number, drawn, is_free=is_uncovered(*cover(scene, owner, drawn))))
    return tuple(replace(one, neighbours=list_neighbours(one, known)) for one in known)


def _bundle(number: int, drawn: DrawnBundle, *, is_free: bool) -> Bundle:
    c, s, radius = math.cos(drawn.yaw_rad), math.sin(drawn.yaw_rad), drawn.diameter_m / 2
    low, high = drawn.cross_m.min(axis=0) - radius, drawn.cross_m.max(axis=0) + radius
    middle = (low + high) / 2
    centre = drawn.centre_m + np.array([c * middle[0], s * middle[0], middle[1]])
    ends = centre + np.outer([-0.5, 0.5], [-s, c, 0.0]) * drawn.length_m
    bars = len(drawn.cross_m)
    return Bundle(
        number, centre, drawn.yaw_rad, 0.0, drawn.length_m, ends[np.argsort(ends[:, 1])], (False, False),
        float(high[0] - low[0]), float(drawn.centre_m[2] + high[1]), drawn.diameter_m, bars, bars,
        int(drawn.centre_m[2] + low[1] > LOWEST_LAYER_M), is_free, (), SIGMA, 1.0, 0.99, (),
        ends_sigma_m=(0.005, 0.005), section_m2=bars * math.pi * radius**2,
    )  # fmt: skip


def fine_placements(world: DrawnYard, magnet: JudgedMagnet, count: int) -> list[Placement]:
    """Draw placements over free bundles, and keep those that the judge finds fine."""
    rng, judge = np.random.default_rng((43, world.seed)), Judge(world.yard, magnet)
    if not world.free:
        return []
    drawn = [
        draw_beside(over_bundle(world, world.free[int(rng.integers(len(world.free)))]), rng)
        for _ in range(count)
    ]
    targets = [Target(p.x_m, p.y_m, p.yaw_rad, magnet.tolerance) for p in drawn]
    return [place for place, target in zip(drawn, targets, strict=True) if judge.judge(target).is_fine]


def four_maps(world: DrawnYard, out: Path) -> dict[str, MappedWorld]:
    """Map a yard as measured and exactly, with found and with true bundles."""
    measured, exact, known = measured_world(out, SETTINGS), noisy_world(world, SETTINGS), true_bundles(world)
    maps = {}
    for name, one in (("measured", measured), ("exact", exact)):
        scene = one.scene
        for told, bundles in (("found", scene.table.bundles), ("true", known)):
            maps[f"{name} map, {told} bundles"] = map_world(
                scene.heights, bundles, one.vetoes, scene.travel, scene.now_ns, SETTINGS
            )
    return maps


def main(keep: Path, seeds: range, placements: int) -> None:
    """Print, of all yards together, how many fine placements each map refuses and why."""
    with tempfile.NamedTemporaryFile("w", suffix=".toml") as described:
        described.write(example_magnet())
        described.flush()
        magnet, judged = load_magnet(Path(described.name)), read_magnet(Path(described.name))
    refused, codes, alone, fine = Counter[str](), Counter[tuple[str, str]](), Counter[tuple[str, str]](), 0
    for seed in seeds:
        out = keep / f"seed_{seed}" / "measured"
        if not (out / "bundles.json").is_file():
            continue
        world = judged_yard(seed, judged)
        places = fine_placements(world, judged, placements)
        fine += len(places)
        for name, mapped in four_maps(world, out).items() if places else ():
            for place in places:
                vetoes = assess_placement(place, mapped.scene, magnet, SETTINGS).vetoes
                found = {veto.code for veto in (*mapped.vetoes, *vetoes)}
                refused[name] += bool(found)
                codes.update((name, code) for code in found)
                alone.update((name, code) for code in found if len(found) == 1)
        print(f"{seed} {world.kind}: {len(places)} fine so far {fine}: {dict(refused)}", flush=True)
    for name, count in refused.items():
        why = ", ".join(
            f"{code} {n} ({alone[name, code]} alone)" for (of, code), n in codes.most_common() if of == name
        )
        print(f"{name}: {count} of {fine} refused ({100 * count / fine:.0f} %): {why}")


if __name__ == "__main__":
    if len(sys.argv) < 3:
        sys.exit(__doc__)
    main(
        Path(sys.argv[1]),
        parse_seeds(sys.argv[2], "refusal_causes"),
        int(sys.argv[3]) if len(sys.argv) > 3 else 40,
    )
