"""Find the bundles that could be lifted, by exact geometry: those over which the judge finds a fine place."""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Iterator
from dataclasses import dataclass

from barsight.benchmarks.lift_judge.judge import Judge, Target
from barsight.benchmarks.lift_judge.magnet import JudgedMagnet
from barsight.simulation.worlds.yards import DrawnYard
from barsight.yard.magnet.footprint import Placement

ALONG_RATIOS, ACROSS_RATIOS = (0.0, 1 / 3, -1 / 3, 2 / 3, -2 / 3), (0.0, 0.3, -0.3, 0.6, -0.6)
"""Places that are searched beside the centre of mass, along and across, relative to the magnet's limits."""
OF_THE_LOAD = "covered over a width of", "load over what may be carried"
"""Beginnings of the judge's reasons that no other place of the magnet changes."""


@dataclass(frozen=True)
class LiftableBundle:
    """A bundle that could be lifted: its number, a fine place for the magnet, whether the plan offers it."""

    seed: int
    bundle: int
    x_m: float
    y_m: float
    yaw_deg: float
    offered: bool


def liftable_bundles(
    world: DrawnYard, magnet: JudgedMagnet, offered: Collection[tuple[int, ...]]
) -> Iterator[LiftableBundle]:
    """Find a fine place for each bundle on which nothing lies. offered: loads of the plan's lifts."""
    judge = Judge(world.yard, magnet)
    for bundle in world.free:
        place = _fine_place(world, judge, magnet, bundle)
        if place is not None:
            yield LiftableBundle(
                world.seed, bundle, place.x_m, place.y_m, place.yaw_deg, (bundle,) in offered
            )


def over_bundle(world: DrawnYard, bundle: int) -> Placement:
    """Place the magnet over a bundle's centre of mass, along its bars."""
    _, centre = world.yard.load(bundle)
    along = world.yard.bars(bundle)[0].axes[0]
    return Placement(float(centre[0]), float(centre[1]), math.atan2(-along[0], along[1]))


def shifted(place: Placement, along_m: float, across_m: float) -> Placement:
    """Shift a placement along its beam and across it."""
    x, y = (place.x_m, place.y_m) + along_m * place.along + across_m * place.across
    return Placement(float(x), float(y), place.yaw_rad)


def _fine_place(world: DrawnYard, judge: Judge, magnet: JudgedMagnet, bundle: int) -> Placement | None:
    """Find a place over a bundle that the judge finds fine within the crane's tolerance."""
    middle = over_bundle(world, bundle)
    for across, along in itertools.product(ACROSS_RATIOS, ALONG_RATIOS):
        place = shifted(middle, along * magnet.offset_along_m, across * magnet.offset_across_m)
        for box in ((0.0, 0.0, 0.0), magnet.tolerance):
            verdict = judge.judge(Target(place.x_m, place.y_m, place.yaw_rad, box))
            if not verdict.is_fine:
                break
        else:
            if verdict.load == (bundle,):
                return place
        if any(reason.startswith(OF_THE_LOAD) for reason in (*verdict.dangerous, *verdict.unclear)):
            return None
    return None
