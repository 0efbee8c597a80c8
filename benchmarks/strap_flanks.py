"""Judge bundles' flanks by the ends of their straps in the pictures, `barsight.bundle_pictures.flanks`.

`python benchmarks/strap_flanks.py KEEP FIRST:LAST`: KEEP has yards that `barsight bench lifts --rendered
--full-size --keep KEEP` measured with the example magnet; their bundles are found anew. Width, middle and
mass of the free ones are held against the drawn ones, by the map alone and by the pictures.
"""

from __future__ import annotations

import math
import sys
import tomllib
from pathlib import Path

import numpy as np
from pitch_spectra import KeptYard, aside_m

from barsight.benchmarks.lift_judge.magnet import magnet_of
from barsight.bundle_pictures.measuring import measure_from_pictures
from barsight.cli.bench.seeds import parse_seeds
from barsight.core.arrays import Float64
from barsight.simulation.worlds.yards import DrawnBundle
from barsight.yard.magnet.description import example_magnet
from barsight.yard.types import Bundle
from barsight.yard.weight import STEEL_KG_PER_M3, bundle_mass


def errors(bundle: Bundle, drawn: DrawnBundle) -> tuple[float, ...]:
    """Compute a bundle's errors of width and middle with their sigmas, m, that of its mass with its sigma,
    and the true mass over its upper bound.
    """
    width_m = float(np.ptp(drawn.cross_m[:, 0])) + drawn.diameter_m
    kg = len(drawn.cross_m) * math.pi / 4 * drawn.diameter_m**2 * drawn.length_m * STEEL_KG_PER_M3
    mass, sigma = bundle_mass(bundle), bundle.sigma
    return (
        bundle.width_m - width_m, sigma.width_m, aside_m(bundle, drawn), sigma.lateral_m, mass.kg - kg,
        mass.sigma_kg, kg / mass.upper_kg,
    )  # fmt: skip


def table(name: str, rows: Float64) -> str:
    """Print how errors (N, 7) of `errors` lie."""
    text = f"{name}: {len(rows)} free bundles"
    for what, first, unit in (("width", 0, 1e3), ("middle", 2, 1e3), ("mass", 4, 1.0)):
        error, sigma = rows[np.isfinite(rows[:, first]), first : first + 2].T
        inside = (abs(error) < 1.96 * sigma).mean()
        low, middle, high = unit * np.quantile(error, [0.025, 0.5, 0.975])
        text += (
            f"\n  {what:6} known of {error.size}: P2.5 {low:.0f}, median {middle:.0f}, P97.5 {high:.0f} "
            f"{'kg' if first == 4 else 'mm'}, sigma {unit * np.median(sigma):.0f}, in 95 % {inside:.3f}"
        )
    bound = rows[np.isfinite(rows[:, 6]), 6]
    return (
        text + f"\n  mass's bound is too low for {(bound > 1).mean():.3f}, at worst {bound.max():.2f} times"
    )


def main(keep: Path, seeds: range) -> None:
    """Measure the yards' bundles and print the tables."""
    magnet = magnet_of(tomllib.loads(example_magnet()))
    rows = dict[str, list[tuple[float, ...]]](map=[], pictures=[])
    changed = list[bool]()
    for seed in seeds:
        if not (keep / f"seed_{seed}" / "measured" / "result.json").is_file():
            continue
        yard = KeptYard.of(keep, seed, magnet)
        placed = measure_from_pictures(yard.pairs, yard.poses, yard.heights, yard.bundles)
        for told, one, drawn in zip(yard.bundles, placed, yard.drawn_ones(), strict=True):
            if drawn is not None and drawn[1]:
                rows["map"].append(errors(told, drawn[0]))
                rows["pictures"].append(errors(one, drawn[0]))
                changed.append(one.width_m != told.width_m)
        print(f"{seed}: {len(changed)} bundles so far, {sum(changed)} by straps", file=sys.stderr, flush=True)
    for name, own in rows.items():
        print(table(name, np.array(own)))
        print(table(f"{name}, those that straps tell", np.array(own)[changed]))


if __name__ == "__main__":
    main(Path(sys.argv[1]), parse_seeds(sys.argv[2], "strap flanks"))
