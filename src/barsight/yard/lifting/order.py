"""Order the lifts that dig a bundle out: which lift uncovers which bundle, and how each load travels.

Only the first lift of an order is offered: once a load has been lifted or set down somewhere, nothing is
known about that place until it is measured again.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from barsight.core.arrays import Float64
from barsight.core.errors import Failed
from barsight.yard.axes import axes_of
from barsight.yard.events import events_since
from barsight.yard.lift_settings import LiftSettings
from barsight.yard.lifting.bearing import magnet_reach
from barsight.yard.lifting.ground import SHADOW_M, Ground
from barsight.yard.lifting.set_down import SetDown, find_set_down, sound_ground
from barsight.yard.lifting.targets import LiftPlan, ended_with_floor, put_down
from barsight.yard.magnet.description import Magnet
from barsight.yard.placement.load import Load
from barsight.yard.types import Bundle, YardMap


@dataclass(frozen=True)
class LiftStep:
    """One lift of an order. travel_z_m: height of the load's underside on its way. is_offered: the plan
    offers it; otherwise it has to be confirmed by a measurement after the previous step.
    """

    bundle: int
    set_down: SetDown
    travel_z_m: float
    is_offered: bool


@dataclass(frozen=True)
class LiftOrder:
    """Lifts that dig a bundle out, from first to last; the last one is the bundle's own."""

    bundle: int
    steps: tuple[LiftStep, ...]


def order_lifts(
    bundle_id: int, yard: YardMap, bundles: tuple[Bundle, ...], plan: LiftPlan
) -> LiftOrder | Failed:
    """Find the order that digs a bundle out, or the reason why there is none.

    Among the lifts that nothing blocks, the highest comes first; the first of all must be an offered one.
    """
    by_id = {bundle.id: bundle for bundle in bundles}
    if bundle_id not in by_id:
        return Failed("no-such-bundle", f"there is no bundle {bundle_id}; bundles.json lists them")
    if plan.vetoes:
        return Failed("no-lift", f"no lift is offered: {plan.vetoes[0].reason}")
    blockers = {each.bundle: each.blockers for each in plan.blocked}
    queue = _sequence(bundle_id, by_id, blockers, _offered(plan))
    if isinstance(queue, Failed):
        return queue
    since = events_since(plan.events, plan.captured_ns)
    ground = sound_ground(
        Ground.of(yard), bundles, plan.footings, plan.settings, since, plan.travel, plan.judged_at_ns
    )
    for bundle in queue:
        ground = ground.apart_from(Load.of((bundle,)))
    steps = list[LiftStep]()
    for bundle in queue:
        load = Load.of((bundle,))
        place = find_set_down(ground, load, plan.magnet, plan.settings)
        if place is None:
            return Failed("no-set-down", f"no place is known where bundle {bundle.id} can be set down")
        height = travel_height(ground, load, place, plan.magnet, plan.settings)
        if isinstance(height, Failed):
            return height
        steps.append(LiftStep(bundle.id, place, height, not steps))
        cells = ground.inside(load, place.x_m, place.y_m, place.yaw_rad, SHADOW_M)
        ground = ground.with_load(cells, place.z_m + load.height_m)
    return LiftOrder(bundle_id, tuple(steps))


def begin_order(order: LiftOrder, plan: LiftPlan, bundles: tuple[Bundle, ...], yard: YardMap) -> LiftPlan:
    """Set down the load of the offered lift that begins an order where the order puts it, clear of the
    bundles that are dug out.
    """
    first = order.steps[0]
    load = tuple(bundle for bundle in bundles if bundle.id == first.bundle)
    offered = []
    for lift in plan.offered:
        if lift.bundles == (first.bundle,):
            laid = put_down(lift, Load.of(load), first.set_down)
            lift = ended_with_floor(laid, load, yard, plan.travel, plan.magnet, plan.settings)
        offered.append(lift)
    return replace(plan, offered=tuple(offered))


def travel_height(
    ground: Ground, load: Load, place: SetDown, magnet: Magnet, settings: LiftSettings
) -> float | Failed:
    """Find a height (m) of the load's underside that clears everything load and magnet may pass over, or the
    reason why there is none.

    Bridge and trolley may move one after the other, and the load may turn and swing. So the whole rectangle
    between both places counts, widened by how far load and magnet reach and by the swing.
    """
    ends = np.array([[load.x_m, load.y_m], [place.x_m, place.y_m]])
    reach = _reach(load, place, magnet, settings)
    unseen = math.inf if settings.max_stack_m is None else settings.max_stack_m
    highest = ground.highest_m(ends.min(axis=0) - reach, ends.max(axis=0) + reach, unseen)
    if not math.isfinite(highest):
        return Failed(
            "unseen-way",
            f"the path of bundle {load.bundles[0]} passes over places that were not seen: measure them, or "
            "give max_stack_m, the most that may stand there",
        )
    return highest + settings.travel_clear_m


def _reach(load: Load, place: SetDown, magnet: Magnet, settings: LiftSettings) -> Float64:
    """Return how far (x, y) load and magnet reach from the load's middle on the way, including the swing."""
    half = np.maximum((load.width_m / 2, load.length_m / 2), magnet_reach(load, magnet))
    yaws = load.yaw_rad + math.radians(place.turn_deg) * np.linspace(0, 1, 19)
    reaches = [half @ np.abs(axes_of(float(yaw))) for yaw in yaws]
    return np.asarray(np.max(reaches, axis=0) + settings.swing_m)


def _offered(plan: LiftPlan) -> set[int]:
    return {lift.bundles[0] for lift in plan.offered if len(lift.bundles) == 1}


def _sequence(
    bundle_id: int, by_id: dict[int, Bundle], blockers: dict[int, tuple[int, ...]], offered: set[int]
) -> list[Bundle] | Failed:
    """Sort the bundles to be moved, the requested one last, so that none is lifted from under another."""
    needed, open_ = set[int](), [bundle_id]
    while open_:
        one = open_.pop()
        if one in needed:
            continue
        needed.add(one)
        open_ += blockers[one]
        unexplained = not by_id[one].is_free and not blockers[one]
        if unexplained:
            return Failed("covered", f"what lies on bundle {one} is not known")
    queue = list[Bundle]()
    while needed:
        free = [one for one in needed if not needed & set(blockers[one])]
        if not free:
            return Failed(
                "ring", f"bundles {', '.join(map(str, sorted(needed)))} lie on each other in a ring"
            )
        if not queue:
            free = [one for one in free if one in offered]
        if not free:
            return Failed("no-lift", _why_not_first(needed, blockers))
        highest = max(free, key=lambda one: (by_id[one].top_z_m, -one))
        queue.append(by_id[highest])
        needed.remove(highest)
    return queue


def _why_not_first(needed: set[int], blockers: dict[int, tuple[int, ...]]) -> str:
    free = sorted(one for one in needed if not needed & set(blockers[one]))
    return f"none of the bundles to begin with ({', '.join(map(str, free))}) may be lifted: see their vetoes"
