"""Plan lift targets: for every bundle that may be free the best placement of the magnet, ranked, or the
vetoes.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from barsight.yard.events import YardEvent
from barsight.yard.lift_settings import LiftSettings
from barsight.yard.lifting.assessment import Lift, LiftScene, assess_placement
from barsight.yard.lifting.footprint import BundleTable, Placement
from barsight.yard.lifting.magnet import Magnet
from barsight.yard.lifting.set_down import FreePlace, free_places
from barsight.yard.lifting.travel_accuracy import Travel
from barsight.yard.lifting.validity import age_checks
from barsight.yard.sections import split_map
from barsight.yard.stability.pile_sides import PileSide, pile_sides
from barsight.yard.stability.stability import Footing, footings
from barsight.yard.types import Bundle, YardMap
from barsight.yard.vetoes import Veto, vetoes_of

ACROSS_M = (0.0, 0.015, -0.015, 0.03, -0.03)
ALONG_M = (0.1, -0.1, 0.25, -0.25)
ANYWHERE = frozenset({"covered", "bundle-doubtful", "end-open", "mass-unknown", "overweight"})
"""Vetoes of the load itself: another place of the magnet changes nothing."""
SAME_TOP_M = 0.03
SAME_YAW_RAD = np.radians(2.0)
RULE = (
    "Offered lifts come safest first: by the smallest of pull over needed pull, capacity over load, and "
    "tolerance over the crane's tolerance; the higher bundle first where two are equal."
)
FROM_WARNINGS = {
    "calibration": "calibration-drift",
    "calibration-drift": "calibration-drift",
    "one-view": "one-view",
}
"""Which of a result's warnings forbid every lift."""


@dataclass(frozen=True, eq=False)
class LiftPlan:
    """offered: lifts without any veto, in `RULE`'s order. refused: the best placement of each other bundle.

    vetoes: those that hold for the whole map; with any of them nothing is offered. footings: how each bundle
    stands. sides: of the piles. judged_at_ns: when, on the frames' clock; captured_ns: stamps of the first
    and last frame, None where the map is given. free: places to set down the longest and widest bundle, in
    the order of `set_down.RULE`. events: in the yard since it was measured.
    """

    magnet: Magnet
    settings: LiftSettings
    offered: tuple[Lift, ...]
    refused: tuple[Lift, ...]
    vetoes: tuple[Veto, ...]
    footings: tuple[Footing, ...]
    sides: tuple[PileSide, ...]
    free: tuple[FreePlace, ...]
    judged_at_ns: int
    captured_ns: tuple[int, int] | None
    events: tuple[YardEvent, ...] = ()

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
    vetoes = [Veto(FROM_WARNINGS[code], text) for code, text in warnings if code in FROM_WARNINGS]
    if reference != "yard":
        vetoes.append(Veto("no-yard-frame", f"the map is in the {reference} frame: no crane gave its place"))
    if not has_magnet:
        vetoes.append(Veto("no-magnet", "no magnet was described: give its file with --magnet"))
    return (*vetoes, *vetoes_of(age_checks(captured_to_ns, now_ns, settings)))


def plan_lifts(
    yard: YardMap, bundles: tuple[Bundle, ...], magnet: Magnet, settings: LiftSettings,
    vetoes: tuple[Veto, ...], travel: Travel | None = None, now_ns: int = 0,
    events: tuple[YardEvent, ...] = (),
) -> LiftPlan:  # fmt: skip
    """Choose the lifts. vetoes: those that hold for the whole map (`map_vetoes`). travel: of its frames.
    now_ns: when the lifts are judged, on the frames' clock. events: in the yard since it was measured.
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
        here = LiftScene(heights, BundleTable.of(near), standing, travel, now_ns, events)
        for number, group in enumerate(groups):
            if part.owns(group[0].centre_m):
                lifts[number] = _best(group, here, magnet, settings)
    offered, refused = [], []
    for _, lift in sorted(lifts.items()):
        if lift.vetoes or vetoes:
            refused.append(replace(lift, map_vetoes=vetoes))
        else:
            offered.append(lift)
    top = {b.id: b.top_z_m for b in bundles}
    offered.sort(key=lambda lift: (-round(lift.safety, 2), -max(top[i] for i in lift.bundles)))
    wide = max((b.width_m for b in bundles), default=settings.set_down_width_m)
    long = max((b.length_m for b in bundles), default=settings.set_down_length_m)
    free = free_places(yard, wide, long)
    standing = tuple(stands[bundle.id] for bundle in bundles)
    return LiftPlan(
        magnet,
        settings,
        tuple(offered),
        tuple(refused),
        vetoes,
        standing,
        pile_sides(bundles, standing),
        free,
        now_ns,
        travel.captured_ns if travel else None,
        events,
    )


def _groups(bundles: tuple[Bundle, ...], count: int) -> Iterator[tuple[Bundle, ...]]:
    """Group bundles on which nothing lies (or may), each with its next count - 1 neighbours towards
    high x.
    """
    free = sorted((b for b in bundles if b.on_top is not False), key=lambda b: float(b.centre_m[0]))
    for place, first in enumerate(free):
        group = [first]
        for other in free[place + 1 :]:
            if len(group) == count:
                break
            level = abs(other.top_z_m - group[-1].top_z_m) < SAME_TOP_M
            parallel = abs(other.yaw_rad - first.yaw_rad) < SAME_YAW_RAD
            between = float(other.centre_m[0] - group[-1].centre_m[0])
            if level and parallel and between < (other.width_m + group[-1].width_m) / 2 + 0.1:
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
    sound = _sound(quick, yard, magnet, settings)
    wherever = ANYWHERE.intersection(*({veto.code for veto in lift.vetoes} for lift in quick))
    if wherever or (sound is not None and not sound.vetoes):
        return sound or quick[0]
    middle = _offset_across(group, quick[0].place)
    more = tried((along, across) for along in ALONG_M for across in dict.fromkeys((0.0, middle)))
    found = [one for one in (sound, _sound(more, yard, magnet, settings)) if one is not None]
    return min(found or [*quick, *more], key=_worst_first)


def _sound(quick: list[Lift], yard: LiftScene, magnet: Magnet, settings: LiftSettings) -> Lift | None:
    """Find the first that holds within the crane's tolerance too; the best that doesn't, None without any.

    All are tried: were it some, tiny noise would choose which, and with that whether a lift is offered.
    """
    whole = []
    for lift in quick:
        if not lift.vetoes:
            whole.append(assess_placement(lift.place, yard, magnet, settings))
            if not whole[-1].vetoes:
                return whole[-1]
    return min(whole, key=_worst_first, default=None)


def _worst_first(lift: Lift) -> tuple[int, float]:
    return len(lift.vetoes), -lift.safety


def _offset_across(group: tuple[Bundle, ...], place: Placement) -> float:
    centre = np.mean([b.centre_m[:2] for b in group], axis=0)
    return float((np.array([place.x_m, place.y_m]) - centre) @ place.across)


def _place(group: tuple[Bundle, ...], along: float, across: float) -> Placement:
    centre = np.mean([b.centre_m[:2] for b in group], axis=0)
    yaw = float(np.mean([b.yaw_rad for b in group]))
    place = Placement(float(centre[0]), float(centre[1]), yaw)
    moved = centre + along * place.along + across * place.across
    return Placement(float(moved[0]), float(moved[1]), yaw)
