"""Judge bounds of pull and mass: `python benchmarks/pull_and_mass.py pull 100:220 [WORKERS]`, `mass 100:150`.

Each seed draws bundles, their map and a place for the magnet; the truth is the steel itself, on which the
faces are lowered and over which the pull is summed here (`drawn_packs`), and weighed.
"""

from __future__ import annotations

import math
import sys

import numpy as np
from drawn_packs import HEXAGONS, draw_pack, edges, gaps, rest_on, seen_map

from barsight.cli.bench.seeds import over_seeds, parse_seeds
from barsight.yard.bundles.detection import find_bundles
from barsight.yard.bundles.fitting.settings import BundleSettings
from barsight.yard.lift_settings import LiftSettings
from barsight.yard.magnet.contact import rest_magnet
from barsight.yard.magnet.description import load_magnet
from barsight.yard.magnet.footprint import Placement
from barsight.yard.magnet.holding import hold_load
from barsight.yard.types import Bundle, BundleSigma
from barsight.yard.weight import bundle_mass

SIGMA = BundleSigma(0.003, 0.02, 0.0006, 0.03, 0.006, 0.003, 0.001)


def pull(seed: int, _: object) -> list[tuple[float, ...]]:
    """Return of a seed: pull and its lower bound over the true one, the least pole's bound over its true one,
    the plane's error in sigmas and in m."""
    magnet, settings = load_magnet(None), LiftSettings()
    poles = magnet.pole_table
    rng = np.random.default_rng([17, seed])
    pack = draw_pack(rng, irregular=seed % 2 == 1)
    heights = seen_map([pack], (-0.6, 0.6), (-3.9, 3.9), rng)
    x, y, yaw = rng.normal(0, [0.01, 0.1, 0.002])
    contact = rest_magnet(heights, Placement(x, y, yaw), magnet, settings.contact_gap_m)
    assert contact is not None
    bar = pack.diameter_m
    width = float(np.ptp(pack.axes_m[:, 0])) + bar
    bundle = Bundle(
        0, np.array([0, 0, 0.0]), 0.0, 0.0, pack.length_m, np.zeros((2, 3)), (False, False), width,
        0.0, bar + rng.normal(0, 0.001), 3, 0, 0, True, (), SIGMA, 1.0, 0.9, (),
    )  # fmt: skip
    contact = hold_load(contact, magnet, (bundle,), settings.strap_m)
    rest = rest_on([pack], (x, y, yaw), poles, math.tan(math.radians(magnet.limits.roll_deg)))
    plate = magnet.pull.on_plate(math.pi / 4 * bar, 0.1)
    true = np.array([
        1e3 * pole[2] * pole[3]
        * np.interp(gaps([pack], (x, y, yaw), pole, rest), magnet.pull.gap_m, plate, right=0).mean()
        for pole in poles
    ])  # fmt: skip
    low = np.array([pole.pull_low_n for pole in contact.poles])
    return [(
        contact.pull_n / true.sum(), low.sum() / true.sum(), float((low / true).max()),
        (contact.centre_z_m - rest[0]) / contact.sigma_m, contact.centre_z_m - rest[0],
    )]  # fmt: skip


def mass(seed: int, _: object) -> list[tuple[float, ...]]:
    """Return of a seed, per bundle found in four packs: whether its pack is irregular, its true
    mass, the estimate and its sigma (NaN where none is given), bars told (0 where none) and true ones.
    """
    rng = np.random.default_rng([23, seed])
    packs, at = [], 0.0
    for _ in range(4):
        pack = draw_pack(rng, irregular=bool(rng.random() < 0.75), length_m=3.0)
        left, right = (float(end) for end in edges(pack))
        pack.axes_m[:] += [at - left, rng.choice([0.0, 0.05, 0.1])]
        at += right - left + rng.uniform(0.03, 0.25)
        packs.append(pack)
    found = find_bundles(seen_map(packs, (-0.4, at + 0.4), (-2, 2), rng), BundleSettings())
    told_of = list[tuple[float, ...]]()
    for pack in packs:
        left, right = edges(pack)
        bars = len(pack.axes_m)
        for bundle in (one for one in found if left < one.centre_m[0] < right):
            told = bundle_mass(bundle)
            told_of.append(
                (
                    float(bars not in HEXAGONS),
                    pack.mass_kg,
                    told.kg,
                    told.sigma_kg,
                    bundle.bars or 0,
                    bars,
                )
            )
    return told_of


def print_masses(table: np.ndarray) -> None:
    """Print how often the true mass lies in the interval that is told."""
    for name, rows in (
        ("irregular", table[table[:, 0] == 1]), ("hexagons", table[table[:, 0] == 0]), ("all", table),
    ):  # fmt: skip
        told = rows[np.isfinite(rows[:, 2])]
        off = (told[:, 1] - told[:, 2]) / told[:, 3]
        counted = rows[rows[:, 4] > 0]
        inside, under = 100 * (np.abs(off) < 1.96).mean(), 100 * (off < 1.645).mean()
        print(f"{name}: {len(rows)} found, mass told of {len(told)}, in its 95 % interval {inside:.1f} %, "
              f"under the upper bound {under:.1f} %, sigma {100 * np.median(told[:, 3] / told[:, 2]):.0f} %; "
              f"counted {len(counted)}, rightly {(counted[:, 4] == counted[:, 5]).sum()}")  # fmt: skip


def main() -> None:
    """Print the table."""
    seeds, workers = parse_seeds(sys.argv[2], sys.argv[1]), int(sys.argv[3]) if len(sys.argv) > 3 else 1
    run = mass if sys.argv[1] == "mass" else pull
    table = np.array([row for _, rows in over_seeds(run, seeds, None, workers, None) for row in rows])
    if run is mass:
        print_masses(table)
        return
    over, bound, worst, sigmas, plane = table.T
    print(f"pull over the true: median {np.median(over):.2f}, P5 {np.quantile(over, 0.05):.2f}, "
          f"P95 {np.quantile(over, 0.95):.2f}")  # fmt: skip
    print(f"lower bound over it: median {np.median(bound):.2f}; holds in {100 * (bound <= 1).mean():.1f} "
          f"% of {len(table)}, every pole's in {100 * (worst <= 1).mean():.1f} %")  # fmt: skip
    print(f"height within 1.645 sigma in {100 * (np.abs(sigmas) <= 1.645).mean():.1f} %; plane minus truth "
          f"{1e3 * plane.mean():.1f} +- {1e3 * plane.std():.1f} mm")  # fmt: skip


if __name__ == "__main__":
    main()
