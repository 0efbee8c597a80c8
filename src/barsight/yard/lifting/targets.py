"""Plan lift targets: for each bundle that may be free, the best placement of the magnet or its vetoes."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType

import numpy as np

from barsight.core.notices import FORBIDS
from barsight.core.parallel import ordered_map
from barsight.core.stamps import seconds_to_ns
from barsight.yard.axes import axes_of, high_side, turn_between
from barsight.yard.events import YardEvent, events_since
from barsight.yard.lift_settings import LiftSettings
from barsight.yard.lifting.assessment import Assessed, assess_place
from barsight.yard.lifting.ground import Ground
from barsight.yard.lifting.lift import Lift, LiftScene, UnseenPlaces
from barsight.yard.lifting.set_down import SetDown, find_set_down, sound_ground
from barsight.yard.lifting.travel_accuracy import Travel
from barsight.yard.lifting.validity import age_checks, validity
from barsight.yard.magnet.description import Magnet
from barsight.yard.magnet.footprint import BundleTable, Placement
from barsight.yard.placement.load import Load, laid_at
from barsight.yard.sections import part_about, split_map
from barsight.yard.stability.blockers import Blocked, find_blocked
from barsight.yard.stability.pile_sides import PileSide, pile_sides
from barsight.yard.stability.stability import Footing, footings, mean_yaw
from barsight.yard.types import Bundle, YardMap
from barsight.yard.vetoes import Veto, check_true, vetoes_of
from barsight.yard.weight import load_centre

ACROSS_M = (0.0, 0.015, -0.015, 0.03, -0.03)
"""Offsets (m) of the magnet across the load's centre that are tried first."""
BETWEEN_M = (0.0075, -0.0075, 0.0225, -0.0225)
"""Offsets (m) across that are tried where some of those hold, but not within the crane's tolerance."""
ALONG_M = (0.1, -0.1, 0.25, -0.25)
"""Offsets (m) along that are tried where none across is free of vetoes."""
BETWEEN_ALONG_M = (0.175, -0.175, 0.05, -0.05)
"""Offsets (m) along that are tried where those have vetoes too, but no veto in common."""
ANYWHERE = frozenset({
    "covered", "bundle-doubtful", "end-open", "mass-unknown", "overweight", "thin-bar",
    "overhanging", "unstable-side", "no-support", "over-stanchion",
})  # fmt: skip
"""Vetoes of the load itself, which another place of the magnet can't change."""
SAME_TOP_M, SAME_YAW_RAD = 0.03, np.radians(2.0)
"""Maximum differences of the tops (m) and the yaws of two bundles that are lifted together."""
SAME_LIFT_GAP_M = 0.1
"""Maximum gap (m) between two bundles that are lifted together."""
RULE = (
    "Lifts are sorted by their safety: the smallest of pull over needed pull, the worst pole's pull over its "
    "share, capacity over load, and tolerance over the crane's tolerance. Of equal ones the higher bundle "
    "comes first."
)


@dataclass(frozen=True, eq=False)
class LiftPlan:
    """The lifts of a yard.

    offered: lifts without any veto, in `RULE`'s order. refused: the best placement of each other bundle.
    vetoes: those of the whole map; with any of them nothing is offered. footings: how each bundle stands.
    sides: of the piles. blocked: what must be moved before each bundle. judged_at_ns: time of the assessment
    on the frames' clock; captured_ns: stamps of the first and last frame, None where the map was given.
    events: in the yard since it was measured. travel: of the map's frames. unseen: what was not seen of the
    refused lifts, None where that wasn't looked for.
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
    events: tuple[YardEvent, ...] = ()
    travel: Travel | None = None
    unseen: UnseenPlaces | None = None

    @property
    def looks_back(self) -> bool:
        """Distinguish lifts judged as of the last frame, which look back, from lifts for a crane."""
        return self.captured_ns is not None and self.judged_at_ns == self.captured_ns[1]


def map_vetoes(
    warnings: Iterable[tuple[str, str]], reference: str, captured_to_ns: int | None, now_ns: int,
    settings: LiftSettings, *, has_magnet: bool,
) -> tuple[Veto, ...]:  # fmt: skip
    """Forbid every lift of a map for its warnings (code, sentence), its frame, its age or a missing magnet.

    captured_to_ns: stamp of its last frame, None where that isn't known; now_ns: on the same clock.
    """
    vetoes = [Veto(FORBIDS[code], text) for code, text in warnings if code in FORBIDS]
    if reference != "yard":
        vetoes.append(
            Veto(
                "no-yard-frame",
                f"the map is in the {reference} frame, because no crane position was recorded",
            )
        )
    if not has_magnet:
        vetoes.append(Veto("no-magnet", "no magnet is described: give its file with --magnet"))
    return (*vetoes, *vetoes_of(age_checks(captured_to_ns, now_ns, settings)))


def offset_vetoes(magnet: Magnet, calibration_id: str, yard_frame_id: str | None) -> tuple[Veto, ...]:
    """Forbid every lift if the magnet's offset was measured with another rig or yard frame than the map."""
    offset = magnet.offset
    if offset is None:
        return ()
    for what, own, here in (
        ("calibration", offset.calibration_id, calibration_id),
        ("yard frame", offset.yard_frame_id, yard_frame_id),
    ):
        if own != here:
            reason = (
                f"the magnet's offset belongs to another {what} ({own}; the map has {here}): touch down again"
            )
            return (Veto("calibration-changed", reason),)
    return ()


def plan_lifts(
    yard: YardMap, bundles: tuple[Bundle, ...], magnet: Magnet, settings: LiftSettings,
    vetoes: tuple[Veto, ...], travel: Travel | None = None, now_ns: int = 0,
    events: tuple[YardEvent, ...] = (), contradicted: Mapping[int, str] = MappingProxyType({}),
) -> LiftPlan:  # fmt: skip
    """Choose the lifts.

    vetoes: those of the whole map (`map_vetoes`). travel: of its frames. now_ns: time for which the lifts are
    judged, on the frames' clock. events: in the yard since it was measured. contradicted: bundles, by id,
    that the stock list contradicts, and what it says.
    """
    parts, stands = split_map(yard), dict[int, Footing]()
    for part in parts:
        own = tuple(bundle for bundle in bundles if part.owns(bundle.centre_m))
        stands |= {one.bundle: one for one in footings(yard.part(part.rows, part.columns), own, settings)}
    groups = list(_groups(bundles, settings.bundles))
    lifts = dict[int, Lift]()
    for part in parts:
        near = tuple(bundle for bundle in bundles if part.reaches(bundle.centre_m, *bundle.ends_m))
        heights, standing = yard.part(part.rows, part.columns), tuple(stands[bundle.id] for bundle in near)
        here = LiftScene(heights, BundleTable.of(near), standing, travel, now_ns, events)
        own_groups = [n for n, group in enumerate(groups) if part.owns(group[0].centre_m)]
        chosen = ordered_map(
            partial(_best, yard=here, magnet=magnet, settings=settings), (groups[n] for n in own_groups)
        )
        lifts |= dict(zip(own_groups, chosen, strict=True))
    offered, refused = [], []
    for _, lift in sorted(lifts.items()):
        listed = tuple(
            check_true("stock-list", "what the stock list says of it", False, contradicted[i])
            for i in lift.bundles if i in contradicted
        )  # fmt: skip
        if lift.vetoes or vetoes or listed:
            refused.append(replace(lift, map_vetoes=vetoes, checks=(*lift.checks, *listed)))
        else:
            offered.append(lift)
    top = {b.id: b.top_z_m for b in bundles}
    offered.sort(key=lambda lift: (-round(lift.safety, 2), -max(top[i] for i in lift.bundles)))
    standing, captured_ns = tuple(stands[b.id] for b in bundles), travel.captured_ns if travel else None
    if offered:
        since = events_since(events, captured_ns)
        ground = sound_ground(Ground.of(yard), bundles, standing, settings, since, travel, now_ns)
        offered = _with_set_downs(offered, bundles, ground, travel, magnet, settings)
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
        captured_ns,
        events,
        travel,
    )


def put_down(lift: Lift, load: Load, place: SetDown | None) -> Lift:
    """Set a lift's load down; the magnet keeps its place on the load, whether that is the middle or not."""
    if place is None:
        return replace(lift, set_down=None, magnet_down=None)
    held = axes_of(load.yaw_rad) @ (lift.place.x_m - load.x_m, lift.place.y_m - load.y_m)
    turn = math.radians(place.turn_deg)
    x, y = np.array([place.x_m, place.y_m]) + held @ axes_of(load.yaw_rad + turn)
    return replace(lift, set_down=place, magnet_down=Placement(float(x), float(y), lift.place.yaw_rad + turn))


def _with_set_downs(
    lifts: list[Lift], bundles: tuple[Bundle, ...], ground: Ground, travel: Travel | None, magnet: Magnet,
    settings: LiftSettings,
) -> list[Lift]:  # fmt: skip
    """Find a place for each lift where its load can be set down."""
    by_id = {bundle.id: bundle for bundle in bundles}

    def with_set_down(lift: Lift) -> Lift:
        taken = tuple(by_id[number] for number in lift.bundles)
        load = Load.of(taken)
        laid = put_down(lift, load, find_set_down(ground, load, magnet, settings))
        return ended_with_floor(laid, taken, ground.yard, travel, magnet, settings)

    return list(ordered_map(with_set_down, lifts))


def ended_with_floor(
    lift: Lift, load: tuple[Bundle, ...], yard: YardMap, travel: Travel | None, magnet: Magnet,
    settings: LiftSettings,
) -> Lift:  # fmt: skip
    """End a lift's validity when that of its set-down ends: `max_age_s` after the survey began where no frame
    certainly saw the set-down.
    """
    place, down = lift.set_down, lift.magnet_down
    if travel is None or travel.captured_ns is None or None in (place, down, lift.validity):
        return lift
    assert place is not None and down is not None and lift.validity is not None
    laid = laid_at(load, place.x_m, place.y_m, place.yaw_rad)
    reach = max(*magnet.size_m, laid.length_m, laid.width_m)
    about = part_about(yard, *(np.array([at - reach, at + reach]) for at in (down.x_m, down.y_m)))
    floor = validity(travel, down, magnet, (laid,), about, settings)
    until_ns = travel.captured_ns[0] + seconds_to_ns(settings.max_age_s) if floor is None else floor.until_ns
    until_ns = min(lift.validity.until_ns, until_ns)
    return replace(lift, validity=replace(lift.validity, until_ns=until_ns))


def _groups(bundles: tuple[Bundle, ...], count: int) -> Iterator[tuple[Bundle, ...]]:
    """Group bundles that are or may be free, each with its count - 1 next neighbours on its high side."""
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
            reach = (other.width_m + last.width_m) / 2 + SAME_LIFT_GAP_M
            between = away - float((last.centre_m - first.centre_m)[:2] @ across)
            shift = abs(float((other.centre_m - first.centre_m)[:2] @ first.direction[:2]))
            if level and between < reach and shift < first.length_m / 2:
                group.append(other)
        if len(group) == count:
            yield tuple(group)


def _best(group: tuple[Bundle, ...], yard: LiftScene, magnet: Magnet, settings: LiftSettings) -> Lift:
    """Choose the placement with the fewest vetoes, then the safest; the middle if the load is vetoed."""

    def tried(offsets: Iterable[tuple[float, float]]) -> list[Assessed]:
        places = (_place(group, magnet, along, across) for along, across in offsets)
        return [assess_place(place, yard, magnet, settings) for place in places]

    limit = magnet.limits.offset_across_m
    quick = tried([(0.0, 0.0)])
    if set(quick[0].lift.bundles) == {bundle.id for bundle in group} and _forbidden_anywhere(quick):
        return quick[0].lift
    quick += tried((0.0, across) for across in ACROSS_M if 0 < abs(across) < limit)
    quick.sort(key=lambda one: _best_first(one.lift))
    sound = _sound(quick, yard, magnet, settings)
    if _forbidden_anywhere(quick) or (sound is not None and not sound.vetoes):
        return sound or quick[0].lift
    middle = _offset_across(group, quick[0].lift.place)
    found = [] if sound is None else [sound]
    between = [(0.0, across) for across in BETWEEN_M if sound is not None and abs(across) < limit]
    for lengths, others in ((ALONG_M, between), (BETWEEN_ALONG_M, [])):
        beside = [(along, across) for along in lengths for across in dict.fromkeys((0.0, middle))]
        more = sorted(tried([*others, *beside]), key=lambda one: _best_first(one.lift))
        quick += more
        best = _sound(more, yard, magnet, settings)
        found += [] if best is None else [best]
        if (best is not None and not best.vetoes) or _shared_codes(quick):
            break
    return min(found or (one.lift for one in quick), key=_best_first)


def _forbidden_anywhere(quick: list[Assessed]) -> bool:
    """Check whether all lifts have the same veto of the load itself."""
    return bool(ANYWHERE & _shared_codes(quick))


def _shared_codes(quick: list[Assessed]) -> set[str]:
    """Return the codes of the vetoes that all lifts have."""
    return set.intersection(*({veto.code for veto in one.lift.vetoes} for one in quick))


def _sound(quick: list[Assessed], yard: LiftScene, magnet: Magnet, settings: LiftSettings) -> Lift | None:
    """Find the first lift that also holds within the crane's tolerance; otherwise the best, None without any.

    All are tried: if only some were, noise would decide which ones, and so whether a lift is offered.
    """
    whole = list[Lift]()
    for one in quick:
        if not one.lift.vetoes:
            whole.append(one.within_tolerance(yard, magnet, settings))
            if not whole[-1].vetoes:
                return whole[-1]
    return min(whole, key=_best_first, default=None)


def _best_first(lift: Lift) -> tuple[int, float]:
    """Return the key that sorts lifts: the fewest vetoes first, then the safest."""
    return len(lift.vetoes), -lift.safety


def _offset_across(group: tuple[Bundle, ...], place: Placement) -> float:
    centre = load_centre(group)
    return float((np.array([place.x_m, place.y_m]) - centre) @ place.across)


def _place(group: tuple[Bundle, ...], magnet: Magnet, along: float, across: float) -> Placement:
    centre = load_centre(group)
    yaw = mean_yaw(group)
    yaw = yaw if magnet.offset is None else magnet.offset.beam_yaw(yaw)
    place = Placement(float(centre[0]), float(centre[1]), yaw)
    moved = centre + along * place.along + across * place.across
    return Placement(float(moved[0]), float(moved[1]), yaw)
