"""Plan lift targets: for every bundle that may be free the best placement of the magnet, ranked, or the
vetoes.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from barsight.core.notices import FORBIDS
from barsight.yard.lift_settings import LiftSettings
from barsight.yard.lifting.assessment import Lift, LiftScene, assess_placement
from barsight.yard.lifting.footprint import BundleTable, Placement
from barsight.yard.lifting.ground import Ground
from barsight.yard.lifting.load import Load
from barsight.yard.lifting.magnet import Magnet
from barsight.yard.lifting.set_down import find_set_down, sound_ground
from barsight.yard.lifting.travel_accuracy import Travel
from barsight.yard.lifting.validity import age_vetoes
from barsight.yard.sections import split_map
from barsight.yard.stability.blockers import Blocked, find_blocked
from barsight.yard.stability.pile_sides import PileSide, pile_sides
from barsight.yard.stability.stability import Footing, footings, high_side, turn_between
from barsight.yard.types import Bundle, YardMap
from barsight.yard.vetoes import Veto

ACROSS_M = (0.0, 0.015, -0.015, 0.03, -0.03)
ALONG_M = (0.1, -0.1, 0.25, -0.25)
FINALISTS = 3
SAME_TOP_M = 0.03
SAME_YAW_RAD = np.radians(2.0)
RULE = (
    "Offered lifts come safest first: by the smallest of pull over needed pull, capacity over load, and "
    "tolerance over the crane's tolerance; the higher bundle first where two are equal."
)


@dataclass(frozen=True, eq=False)
class LiftPlan:
    """offered: lifts without any veto, in `RULE`'s order. refused: the best placement of each other bundle.

    vetoes: those that hold for the whole map; with any of them nothing is offered. footings: how each bundle
    stands. sides: of the piles. blocked: what must go before each bundle. judged_at_ns: when, on the frames'
    clock; captured_ns: stamps of the first and last frame, None where the map is given.
    """

    magnet: Magnet
    settings: LiftSettings
    offered: tuple[Lift, ...]
    refused: tuple[Lift, ...]
    vetoes: tuple[Veto, ...]
    footings: tuple[Footing, ...]
    sides: tuple[PileSide, ...]
    blocked: tuple[Blocked, ...]
    judged_at_ns: int
    captured_ns: tuple[int, int] | None

    @property
    def looks_back(self) -> bool:
        """Tell lifts judged as of the last frame, to look back, from those for a crane."""
        return self.captured_ns is not None and self.judged_at_ns == self.captured_ns[1]


def map_vetoes(
    warnings: Iterable[tuple[str, str]], reference: str, captured_to_ns: int | None, now_ns: int,
    settings: LiftSettings, *, has_magnet: bool,
) -> tuple[Veto, ...]:  # fmt: skip
    """Forbid every lift of a map for its warnings (code, sentence), frame, age or want of a magnet.

    captured_to_ns: stamp of its last frame, None where that isn't known; now_ns: on the same clock.
    """
    vetoes = [Veto(FORBIDS[code], text) for code, text in warnings if code in FORBIDS]
    if reference != "yard":
        vetoes.append(Veto("no-yard-frame", f"the map is in the {reference} frame: no crane gave its place"))
    if not has_magnet:
        vetoes.append(Veto("no-magnet", "no magnet was described: give its file with --magnet"))
    vetoes += age_vetoes(captured_to_ns, now_ns, settings)
    return tuple(vetoes)


def plan_lifts(
    yard: YardMap, bundles: tuple[Bundle, ...], magnet: Magnet, settings: LiftSettings,
    vetoes: tuple[Veto, ...], travel: Travel | None = None, now_ns: int = 0,
    contradicted: Mapping[int, str] = MappingProxyType({}),
) -> LiftPlan:  # fmt: skip
    """Choose the lifts. vetoes: those that hold for the whole map (`map_vetoes`). travel: of its frames.
    now_ns: when the lifts are judged, on the frames' clock. contradicted: bundles, by id, of which the stock
    list says something else, and what.
    """
    parts, stands = split_map(yard), dict[int, Footing]()
    for part in parts:
        own = tuple(bundle for bundle in bundles if part.owns(bundle.centre_m))
        stands |= {one.bundle: one for one in footings(yard.part(part.rows, part.columns), own, settings)}
    groups = list(_groups(bundles, settings.bundles))
    lifts = dict[int, Lift]()
    for part in parts:
        near = tuple(bundle for bundle in bundles if part.reaches(bundle.centre_m))
        heights, standing = yard.part(part.rows, part.columns), tuple(stands[bundle.id] for bundle in near)
        here = LiftScene(heights, BundleTable.of(near), standing, (), travel, now_ns)
        for number, group in enumerate(groups):
            if part.owns(group[0].centre_m):
                lifts[number] = _best(group, here, magnet, settings)
    offered, refused = [], []
    for _, lift in sorted(lifts.items()):
        listed = tuple(Veto("stock-list", contradicted[i]) for i in lift.bundles if i in contradicted)
        if lift.vetoes or vetoes or listed:
            refused.append(_with(lift, (*vetoes, *listed)))
        else:
            offered.append(lift)
    top = {b.id: b.top_z_m for b in bundles}
    offered.sort(key=lambda lift: (-round(lift.safety, 2), -max(top[i] for i in lift.bundles)))
    standing = tuple(stands[bundle.id] for bundle in bundles)
    if offered:
        ground = sound_ground(Ground.of(yard), bundles, standing, settings)
        by_id = {bundle.id: bundle for bundle in bundles}
        loads = (Load.of(tuple(by_id[k] for k in lift.bundles)) for lift in offered)
        places = (find_set_down(ground, load, magnet, settings) for load in loads)
        offered = [replace(lift, set_down=place) for lift, place in zip(offered, places, strict=True)]
    return LiftPlan(
        magnet,
        settings,
        tuple(offered),
        tuple(refused),
        vetoes,
        standing,
        pile_sides(bundles, standing),
        find_blocked(bundles, standing, settings),
        now_ns,
        travel.captured_ns if travel else None,
    )


def _with(lift: Lift, vetoes: tuple[Veto, ...]) -> Lift:
    said = {veto.code for veto in vetoes}
    own = (veto for veto in lift.vetoes if veto.code not in said)
    return Lift(**{**vars(lift), "vetoes": (*vetoes, *own)})


def _groups(bundles: tuple[Bundle, ...], count: int) -> Iterator[tuple[Bundle, ...]]:
    """Group bundles on which nothing lies (or may), each with its next count - 1 neighbours towards its high
    side.
    """
    free = [bundle for bundle in bundles if bundle.on_top is not False]
    for first in free:
        group, across = [first], high_side(first.yaw_rad)
        beyond = sorted(
            (float((b.centre_m - first.centre_m)[:2] @ across), n)
            for n, b in enumerate(free) if abs(turn_between(first.yaw_rad, b.yaw_rad)) < SAME_YAW_RAD
        ) if count > 1 else []  # fmt: skip
        for away, number in beyond:
            last, other = group[-1], free[number]
            if away <= 0 or len(group) == count:
                continue
            level = abs(other.top_z_m - last.top_z_m) < SAME_TOP_M
            between = away - float((last.centre_m - first.centre_m)[:2] @ across)
            shift = abs(float((other.centre_m - first.centre_m)[:2] @ first.direction[:2]))
            if level and between < (other.width_m + last.width_m) / 2 + 0.1 and shift < first.length_m / 2:
                group.append(other)
        if len(group) == count:
            yield tuple(group)


def _best(group: tuple[Bundle, ...], yard: LiftScene, magnet: Magnet, settings: LiftSettings) -> Lift:
    """Choose the placement with the fewest vetoes, then the safest."""

    def tried(offsets: Iterable[tuple[float, float]]) -> list[Lift]:
        places = (_place(group, along, across) for along, across in offsets)
        found = [assess_placement(place, yard, magnet, settings, search=False) for place in places]
        return sorted(found, key=_worst_first)

    limit = magnet.limits.offset_across_m
    quick = tried((0.0, across) for across in ACROSS_M if abs(across) < limit)
    if quick[0].vetoes:
        across = quick[0].offset_across_m if np.isfinite(quick[0].offset_across_m) else 0.0
        quick = sorted([*quick, *tried((along, across) for along in ALONG_M)], key=_worst_first)
    if quick[0].vetoes:
        return quick[0]
    finalists = []
    for lift in quick[:FINALISTS]:
        if not lift.vetoes:
            finalists.append(assess_placement(lift.place, yard, magnet, settings))
            if not finalists[-1].vetoes:
                break
    return min(finalists, key=_worst_first)


def _worst_first(lift: Lift) -> tuple[int, float]:
    return len(lift.vetoes), -lift.safety


def _place(group: tuple[Bundle, ...], along: float, across: float) -> Placement:
    centre = np.mean([b.centre_m[:2] for b in group], axis=0)
    first = group[0].yaw_rad
    yaw = first + float(np.mean([turn_between(first, b.yaw_rad) for b in group]))
    place = Placement(float(centre[0]), float(centre[1]), yaw)
    moved = centre + along * place.along + across * place.across
    return Placement(float(moved[0]), float(moved[1]), yaw)
