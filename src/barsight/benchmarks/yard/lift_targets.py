"""Judge random placements of the magnet on simulated yards (`barsight bench lifts`) against exact knowledge.

The yard's stages get maps and bundles with errors; the truth says how many bundles the magnet would take and
whether the lift is truly fine: judged by the same limits on the exact map and the exact bundles there is no
veto, and a count by sampling the poles' faces gives the wanted number there and at all corners of the crane's
tolerance.
"""

from __future__ import annotations

import itertools
import math
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from rich.table import Table

from barsight.benchmarks.provenance import Provenance, provenance
from barsight.benchmarks.yard.known_yards import KnownYard, known_yard, seen_bundles, seen_heights
from barsight.core.arrays import Float64
from barsight.simulation.settings import SimulationSettings, YardSettings
from barsight.simulation.stock import stack_yard
from barsight.yard.lift_settings import LiftSettings
from barsight.yard.lifting.assessment import Lift, LiftScene, assess_placement
from barsight.yard.lifting.contact import set_down
from barsight.yard.lifting.footprint import BundleTable, Placement
from barsight.yard.lifting.magnet import Magnet
from barsight.yard.stability.stability import footings
from barsight.yard.types import Bundle, HeightMap

KINDS = ("90mm:7", "60mm:7", "40mm:19", "20mm:37", "60mm:19", "40mm:37", "90mm:7,40mm:19")
LENGTH_M = 5.0
SAMPLE_M = 0.005

Finder = Callable[[HeightMap], tuple[Bundle, ...]]


@dataclass(frozen=True)
class LiftBench:
    """Counts of placements. wrong: count wrong and no veto. fine: truly fine ones; vetoed_fine of those were
    vetoed, for `reasons`. counted: placements without any veto; seconds: of judging, all together.
    """

    yards: int
    placements: int
    wrong: int
    counted: int
    fine: int
    vetoed_fine: int
    reasons: dict[str, int]
    codes: dict[str, int]
    seconds: float
    provenance: Provenance


def bench_yard(number: int) -> tuple[KnownYard, np.random.Generator]:
    """Draw the numbered yard: 1 to 5 layers, seven mixes of bars, gaps of 15 to 60 mm, missing places."""
    rng = np.random.default_rng([7, number])
    settings = SimulationSettings(
        length_m=LENGTH_M, seed=number, bars=KINDS[number % len(KINDS)],
        yard=YardSettings(
            max_layers=1 + number % 5, gap_m=float(rng.uniform(0.015, 0.06)),
            missing_ratio=float(rng.uniform(0.0, 0.25)), skew_deg=float(rng.uniform(0.0, 0.4)),
        ),
    )  # fmt: skip
    return known_yard(stack_yard(settings, rng), settings, rng), rng


def bench_lifts(
    magnet: Magnet, yards: int, placements: int, find: Finder | None, advance: Callable[[int], None]
) -> LiftBench:
    """Judge `placements` random placements, spread over the yards.

    find: finds the bundles in the map; without it the true bundles with errors of a stated sigma are given.
    """
    settings = LiftSettings()
    wrong = counted = fine = vetoed = 0
    reasons: Counter[str] = Counter()
    codes: Counter[str] = Counter()
    seconds = 0.0
    for number in range(yards):
        known, rng = bench_yard(number)
        seen = seen_heights(known.heights, rng)
        bundles = seen_bundles(known, rng) if find is None else find(seen)
        measured, exact = _judged(seen, bundles, settings), _judged(known.heights, known.bundles, settings)
        for _ in range(number, placements, yards):
            place = random_place(known, rng)
            start = time.perf_counter()
            lift = assess_placement(place, measured, magnet, settings)
            seconds += time.perf_counter() - start
            true_count = count_truly(place, known, magnet)
            wrong += not lift.vetoes and lift.count != true_count
            counted += not lift.vetoes
            codes.update({veto.code for veto in lift.vetoes})
            if truly_fine(place, known, exact, magnet, settings):
                fine += 1
                vetoed += bool(lift.vetoes)
                reasons.update({veto.code for veto in lift.vetoes})
        advance(number + 1)
    return LiftBench(
        yards, placements, wrong, counted, fine, vetoed, dict(reasons.most_common()),
        dict(codes.most_common()), seconds, provenance(),
    )  # fmt: skip


def _judged(heights: HeightMap, bundles: tuple[Bundle, ...], settings: LiftSettings) -> LiftScene:
    return LiftScene(heights, BundleTable.of(bundles), footings(heights, bundles, settings))


def random_place(known: KnownYard, rng: np.random.Generator) -> Placement:
    """Draw a placement: three in five well over a free bundle, one in five beside one, one in five
    anywhere.
    """
    free = [b for b in known.bundles if b.on_top]
    bundle = free[int(rng.integers(len(free)))]
    kind = rng.random()
    if kind < 0.6:
        along, across, turn = rng.normal(0, 0.1), rng.normal(0, 0.012), rng.normal(0, 0.1)
    elif kind < 0.8:
        along, across = rng.uniform(-1, 1), rng.uniform(-1, 1) * bundle.width_m
        turn = rng.uniform(-1, 1)
    else:
        heights = known.heights
        rows, columns = heights.z_m.shape
        x = heights.x0_m + rng.uniform(0, columns) * heights.cell_m
        y = heights.y0_m + rng.uniform(0.3, 0.7) * rows * heights.cell_m
        return Placement(float(x), float(y), math.radians(rng.uniform(-5, 5)))
    place = Placement(0.0, 0.0, bundle.yaw_rad + math.radians(float(turn)))
    x, y = bundle.centre_m[:2] + along * place.along + across * place.across
    return Placement(float(x), float(y), place.yaw_rad)


def count_truly(place: Placement, known: KnownYard, magnet: Magnet) -> int:
    """Count bundles within whose true outline a pole has a part, and whose top lies within the magnet's
    reach.
    """
    contact = set_down(known.heights, place, magnet, 0.003)
    if contact is None:
        return 0
    taken: set[int] = set()
    for pole, face_z in zip(magnet.poles, contact.z_m, strict=True):
        v = np.arange(-pole.length_m / 2, pole.length_m / 2 + SAMPLE_M / 2, SAMPLE_M) + pole.along_m
        u = np.arange(-pole.width_m / 2, pole.width_m / 2 + SAMPLE_M / 2, SAMPLE_M) + pole.across_m
        vv, uu = (a.ravel() for a in np.meshgrid(v, u))
        points = np.array([place.x_m, place.y_m]) + vv[:, None] * place.along + uu[:, None] * place.across
        taken |= {
            bundle.id for bundle in known.bundles
            if bundle.top_z_m > face_z - magnet.reach_m and _inside(points, bundle)
        }  # fmt: skip
    return len(taken)


def _inside(points: Float64, bundle: Bundle) -> bool:
    away = points - bundle.centre_m[:2]
    cos, sin = math.cos(bundle.yaw_rad), math.sin(bundle.yaw_rad)
    beside = np.abs(away @ (cos, sin)) < bundle.width_m / 2
    return bool((beside & (np.abs(away @ (-sin, cos)) < bundle.length_m / 2)).any())


def truly_fine(
    place: Placement, known: KnownYard, exact: LiftScene, magnet: Magnet, settings: LiftSettings
) -> bool:
    """Check that exact knowledge finds nothing against the lift, and the right count all over the
    tolerance.
    """
    lift: Lift = assess_placement(place, exact, magnet, settings)
    if lift.vetoes:
        return False
    box = magnet.tolerance
    corners = itertools.product((-1, 1), repeat=3)
    moved = (
        Placement(
            place.x_m + a * box.x_m, place.y_m + b * box.y_m, place.yaw_rad + c * math.radians(box.yaw_deg)
        )
        for a, b, c in corners
    )
    return all(count_truly(p, known, magnet) == settings.bundles for p in (place, *moved))


def lift_table(bench: LiftBench) -> Table:
    """Tabulate the bench for people."""
    table = Table("figure", "value", title=f"{bench.placements} placements on {bench.yards} yards")
    share = 100 * bench.vetoed_fine / bench.fine if bench.fine else math.nan
    for name, value in (
        ("wrong count without a veto", f"{bench.wrong}"),
        ("placements without a veto", f"{bench.counted}"),
        ("truly fine placements", f"{bench.fine}"),
        ("of those vetoed", f"{bench.vetoed_fine} ({share:.1f} %)"),
        ("why those were vetoed", ", ".join(f"{c} {n}" for c, n in bench.reasons.items()) or "-"),
        ("vetoes", ", ".join(f"{c} {n}" for c, n in bench.codes.items())),
        ("time to judge one", f"{1e3 * bench.seconds / max(bench.placements, 1):.1f} ms"),
    ):
        table.add_row(name, value)
    return table
