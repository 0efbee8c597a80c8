"""Have the independent judge try to prove lifts wrong (`barsight bench lifts`).

The offered lifts, and random placements, are assessed on a measured map of a drawn world. The judge checks
each one without a veto against the world's solids at the stated tolerance; it also checks the vetoed ones
over a bundle on which nothing lies, to find safe lifts that are refused. Of further placements it checks only
those without a veto, which bound the rate of dangerous lifts.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from rich.table import Table
from scipy.stats import beta

from barsight.benchmarks.lift_judge.judge import Judge, Target
from barsight.benchmarks.lift_judge.magnet import JudgedMagnet
from barsight.benchmarks.provenance import Provenance, provenance
from barsight.benchmarks.yard.drawn_worlds import MappedWorld
from barsight.benchmarks.yard.liftable_bundles import LiftableBundle, over_bundle, shifted
from barsight.core.linalg.robust import SIGMAS_95
from barsight.simulation.worlds.yards import DrawnYard
from barsight.yard.lift_settings import LiftSettings
from barsight.yard.lifting.assessment import assess_placement
from barsight.yard.lifting.lift import Lift
from barsight.yard.lifting.targets import plan_lifts
from barsight.yard.magnet.description import Magnet
from barsight.yard.magnet.footprint import Placement

SPREAD = (0.1, 0.012, math.radians(0.1))
"""Standard deviations, m, m, rad, of random placements from a bundle's centre: along, across, yaw."""


@dataclass(frozen=True)
class JudgedLift:
    """One placement and its verdict. offered: it is one of the plan's lifts; vetoes: the planner's codes;
    load: the bundles that lie under the faces.

    dangerous: the judge's reasons; for a vetoed placement that is dangerous at the target itself, only those
    found there. stated_*: values stated by the planner; true_*: values by the judge, NaN if there is no load.
    for_danger: a further placement, listed only because it has no veto; it must not count for the refusals.
    """

    seed: int
    kind: str
    offered: bool
    x_m: float
    y_m: float
    yaw_deg: float
    vetoes: tuple[str, ...]
    dangerous: tuple[str, ...]
    unclear: tuple[str, ...]
    stated_mass_kg: float
    stated_sigma_kg: float
    stated_pull_low_n: float
    true_mass_kg: float
    true_pull_n: float
    load: tuple[int, ...]
    for_danger: bool = False

    @property
    def is_fine(self) -> bool:
        """Tell whether the judge finds every figure within its safe limit."""
        return not self.dangerous and not self.unclear


@dataclass(frozen=True)
class JudgedBench:
    """All judged placements, the bundles that could be lifted, and the number of yards of both."""

    yards: int
    lifts: tuple[JudgedLift, ...]
    bundles: tuple[LiftableBundle, ...]
    provenance: Provenance

    @classmethod
    def of(
        cls, yards: int, lifts: Sequence[JudgedLift], bundles: Sequence[LiftableBundle] = ()
    ) -> JudgedBench:
        """Record the judged placements and the bundles, with commit and machine."""
        return cls(yards, tuple(lifts), tuple(bundles), provenance())

    @property
    def unvetoed(self) -> tuple[JudgedLift, ...]:
        """Return the placements without a veto."""
        return tuple(one for one in self.lifts if not one.vetoes)

    @property
    def dangerous(self) -> tuple[JudgedLift, ...]:
        """Return the placements without a veto that the judge finds dangerous."""
        return tuple(one for one in self.unvetoed if one.dangerous)


def judge_yard(
    world: DrawnYard, mapped: MappedWorld, magnet: Magnet, judged: JudgedMagnet, settings: LiftSettings,
    placements: int, for_danger: int = 0,
) -> Iterator[JudgedLift]:  # fmt: skip
    """Assess and judge the offered lifts and `placements` random placements in one world, and those of
    `for_danger` further placements that have no veto.
    """
    rng, judge = np.random.default_rng((37, world.seed)), Judge(world.yard, judged, settings.bundles)
    scene = mapped.scene
    plan = plan_lifts(
        scene.heights, scene.table.bundles, magnet, settings, mapped.vetoes, scene.travel, scene.now_ns
    )
    for lift in plan.offered:
        yield _judged(world, lift, judge, judged, offered=True)
    offered = [lift.place for lift in plan.offered]
    for number in range(placements + for_danger):
        middles = offered if number % 2 and offered else [over_bundle(world, b) for b in world.free]
        if not middles:
            return
        place = draw_beside(middles[int(rng.integers(len(middles)))], rng)
        lift = replace(assess_placement(place, scene, magnet, settings), map_vetoes=mapped.vetoes)
        more = number >= placements
        if not more or not lift.vetoes:
            yield replace(_judged(world, lift, judge, judged, offered=False), for_danger=more)


def draw_beside(middle: Placement, rng: np.random.Generator) -> Placement:
    """Draw a placement around the given one, with the standard deviations SPREAD."""
    along, across, turn = (float(one) for one in rng.normal(0, SPREAD))
    return replace(shifted(middle, along, across), yaw_rad=middle.yaw_rad + turn)


def _judged(world: DrawnYard, lift: Lift, judge: Judge, magnet: JudgedMagnet, *, offered: bool) -> JudgedLift:
    place, contact = lift.place, lift.contact
    target = Target(place.x_m, place.y_m, place.yaw_rad, magnet.tolerance)
    if not lift.vetoes and contact is not None:
        box = lift.tolerance.x_m, lift.tolerance.y_m, math.radians(lift.tolerance.yaw_deg)
        plane = contact.centre_z_m, math.tan(contact.pitch_rad), math.tan(contact.roll_rad)
        target = Target(
            place.x_m, place.y_m, place.yaw_rad, box, plane, lift.mass.upper_kg, contact.pull_low_n
        )
    verdict = None
    if lift.vetoes:
        # If it is dangerous at the target itself, the corners needn't be checked.
        verdict = judge.judge(replace(target, box=(0.0, 0.0, 0.0)))
    if verdict is None or not verdict.dangerous:
        verdict = judge.judge(target)
    return JudgedLift(
        world.seed, world.kind, offered, place.x_m, place.y_m, place.yaw_deg,
        tuple(sorted({veto.code for veto in lift.vetoes})), verdict.dangerous, verdict.unclear,
        lift.mass.kg, lift.mass.sigma_kg, contact.pull_low_n if contact else math.nan,
        verdict.mass_kg, verdict.pull_n, verdict.load,
    )  # fmt: skip


def upper_bound(found: int, of: int) -> float:
    """Compute the one-sided 95 % upper confidence bound of a proportion [Clopper 1934]."""
    return float(beta.ppf(0.95, found + 1, of - found)) if found < of else 1.0


def bench_table(bench: JudgedBench) -> Table:
    """Tabulate the results for the terminal."""
    table = Table("figure", "value", title=f"{len(bench.lifts)} placements on {bench.yards} yards")
    free, bad = bench.unvetoed, bench.dangerous
    fine = [one for one in bench.lifts if one.is_fine and not one.for_danger]
    refused = [one for one in fine if one.vetoes]
    codes = Counter(code for one in refused for code in one.vetoes)
    reasons = Counter(reason.split(":")[0] for one in bad for reason in one.dangerous)
    low = [one.stated_pull_low_n <= one.true_pull_n for one in free]
    mass = [
        abs(one.stated_mass_kg - one.true_mass_kg) <= SIGMAS_95 * one.stated_sigma_kg
        for one in free if math.isfinite(one.stated_mass_kg)
    ]  # fmt: skip
    bad_yards, free_yards = (len({one.seed for one in part}) for part in (bad, free))
    for name, value in (
        ("without a veto", f"{len(free)}, {sum(one.offered for one in free)} of them offered"),
        # Placements on one yard fail together: only yards count as independent.
        ("of these dangerous", f"{_share(len(bad), len(free))}, on {bad_yards} of {free_yards} yards; 95 % "
         f"upper bound {100 * upper_bound(bad_yards, free_yards):.1f} % of such yards"),
        ("offered and dangerous", f"{sum(one.offered for one in bad)}"),
        ("why dangerous", _counts(reasons)),
        ("neither dangerous nor fine", f"{len(free) - len(bad) - sum(one.is_fine for one in free)}"),
        ("truly fine", f"{len(fine)}"),
        ("of these vetoed", _share(len(refused), len(fine))),
        ("why those were vetoed", _counts(codes)),
        ("bundles with a fine placement, offered",
         _share(sum(one.offered for one in bench.bundles), len(bench.bundles))),
        ("lower bound of the pull holds", _share(sum(low), len(low))),
        ("mass in its 95 % interval", _share(sum(mass), len(mass))),
    ):  # fmt: skip
        table.add_row(name, value)
    return table


def dangerous_table(bench: JudgedBench) -> Table:
    """List each dangerous placement without a veto, with its reasons."""
    table = Table("seed", "kind", "offered", "x m", "y m", "yaw deg", "why")
    for one in bench.dangerous:
        table.add_row(
            str(one.seed), one.kind, "yes" if one.offered else "", f"{one.x_m:.3f}", f"{one.y_m:.3f}",
            f"{one.yaw_deg:.2f}", "; ".join(one.dangerous),
        )  # fmt: skip
    return table


def _share(count: int, of: int) -> str:
    return f"{count} of {of} ({100 * count / of:.1f} %)" if of else "0 of 0"


def _counts(found: Counter[str]) -> str:
    return ", ".join(f"{name} {count}" for name, count in found.most_common()) or "-"
