"""Assess one placement of the magnet: the bundles taken, how the magnet lies, and every veto."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace

import numpy as np

from barsight.yard.lift_settings import UPPER, LiftSettings
from barsight.yard.lifting.lift import Lift, LiftScene
from barsight.yard.lifting.travel_accuracy import crane_checks, target_covariance
from barsight.yard.lifting.validity import age_checks, disturbed_checks, validity
from barsight.yard.magnet.contact import NEWTON_PER_KG, Contact, rest_magnet
from barsight.yard.magnet.description import Magnet, Tolerance
from barsight.yard.magnet.footprint import (
    BEYOND_OPEN_END_M,
    BundleTable,
    Grip,
    Placement,
    Rectangles,
    count_gripped,
)
from barsight.yard.magnet.holding import (
    WeakestPole,
    hold_load,
    pried_ratio,
    share_checks,
    weakest_bundle,
    weakest_pole,
)
from barsight.yard.magnet.partings import without_parted
from barsight.yard.magnet.reach import reached_strips
from barsight.yard.magnet.seen_edges import seen_clearances
from barsight.yard.map_lookup import nearest_cells
from barsight.yard.placement.checks import (
    area_checks,
    count_checks,
    face_checks,
    load_checks,
    probability_check,
    unknown_check,
)
from barsight.yard.placement.clearance import (
    FacePlane,
    clearance_checks,
    find_obstacle,
)
from barsight.yard.placement.labels import SeenLabel, find_labels, rests_on_label
from barsight.yard.placement.load import leaning_checks, resting_checks
from barsight.yard.placement.thin_bars import (
    beside_checks,
    edge_checks,
    has_pictures,
    may_reach,
    thin_bar_checks,
)
from barsight.yard.stability.stability import footing_checks
from barsight.yard.types import Bundle, HeightMap, known_sigma
from barsight.yard.vetoes import Check, check_min, check_true, vetoes_of
from barsight.yard.weight import Mass, bundle_mass, load_centre

SCALES = (1.0, 1.5, 2.5)
"""Multiples of the crane's tolerance that are tried as the box within which a lift remains as checked."""
SEVERAL = "several labels or other bright plates may be under the faces"
ON_LABEL = "if the faces rest on a label or another bright plate"


@dataclass(frozen=True, eq=False)
class Hold:
    """Hold of a load by resting faces: their contact with its pull, the weakest pole, `pried_ratio` and
    `weakest_bundle`.
    """

    contact: Contact
    weakest: WeakestPole | None
    pried: float
    worst: float

    @classmethod
    def of(
        cls, contact: Contact, place: Placement, magnet: Magnet, load: tuple[Bundle, ...], needed_n: float,
        settings: LiftSettings,
    ) -> Hold:  # fmt: skip
        """Compute it from a contact without a pull."""
        contact = hold_load(contact, magnet, load, settings.strap_m)
        return cls(
            contact, weakest_pole(contact, needed_n, magnet, place, load),
            pried_ratio(contact, needed_n, magnet, place, load),
            weakest_bundle(contact, magnet, place, load, settings.strap_m),
        )  # fmt: skip

    def weaker(self, other: Hold) -> Hold:
        """Take the contact of the smaller pull, and the minimum of each ratio."""
        contact = min(self.contact, other.contact, key=lambda either: either.pull_low_n)
        poles = [one.weakest for one in (self, other) if one.weakest]
        weakest = min(poles, key=lambda pole: pole.ratio, default=None)
        return Hold(contact, weakest, min(self.pried, other.pried), min(self.worst, other.worst))

    def checks(
        self, place: Placement, magnet: Magnet, load: tuple[Bundle, ...], needed_n: float,
        settings: LiftSettings,
    ) -> list[Check]:  # fmt: skip
        """Check how the faces lie and pull, and that they rest on the load."""
        return [
            *face_checks(self.contact, needed_n, magnet, load, settings),
            *share_checks(self.weakest, self.pried, self.worst),
            *resting_checks(place, magnet, self.contact, load, settings.strap_m),
        ]


def assess_placement(
    place: Placement, yard: LiftScene, magnet: Magnet, settings: LiftSettings, *, search: bool = True
) -> Lift:
    """Assess a placement. Without `search`, the tolerance isn't determined, and can't be a veto."""
    near = nearby_bundles(yard.table, place, magnet)
    contact = rest_magnet(yard.heights, place, magnet, settings.contact_gap_m)
    if contact is None:
        return _unseen_lift(place)
    held = _grip(place, yard.heights, magnet, magnet.tolerance, near, contact)
    load = tuple(near.bundles[k] for k in held.gripped)
    valid = validity(yard.travel, place, magnet, load, yard.heights, settings) if yard.travel else None
    mass = _load_mass(load)
    needed = mass.upper_kg * NEWTON_PER_KG * magnet.needed_factor
    hold = Hold.of(contact, place, magnet, load, needed, settings)
    contact = hold.contact
    away = np.array([place.x_m, place.y_m]) - load_centre(load)
    offset = float(away @ place.along), float(away @ place.across)
    overhang = _overhang(place, load, magnet)
    checks = [
        *crane_checks(yard.travel, place, magnet, settings),
        *(age_checks(valid.from_ns if valid else None, yard.now_ns, settings) if yard.travel else ()),
        *area_checks(place, magnet, load, settings),
        *disturbed_checks(yard.events, place, magnet, load, valid, settings),
        *count_checks(place, yard.heights, magnet, near, contact, held, settings),
        *hold.checks(place, magnet, load, needed, settings),
        *clearance_checks(place, yard.heights, magnet, contact, load, settings.stanchions),
        *leaning_checks(place, magnet, contact, load, settings.strap_m),
        *load_checks(load, mass, offset, overhang, magnet, settings),
        *(check for b in load for check in footing_checks(b, near.bundles, yard.footings, settings)),
    ]
    if not vetoes_of(checks):
        hold, on_label = _on_label(hold, place, yard, magnet, load, needed, settings)
        checks += on_label
        pixel_m = yard.travel.pixel_m(contact.centre_z_m) if yard.travel else None
        checks += thin_bar_checks(yard.heights, yard.thin_line(load), load, pixel_m, settings)
        if has_pictures(yard.heights, pixel_m):
            low_z_m = FacePlane.of(contact).centre_z_m - magnet.half_span_m * abs(math.tan(contact.pitch_rad))
            others = [b for b in near.bundles if b not in load and may_reach(b, place, magnet, low_z_m)]
            checks += edge_checks(others)
            checks += beside_checks(place, magnet, tuple((b, yard.thin_lines(b)) for b in others))
    scale = 0.0
    if search and not vetoes_of(checks):
        scale, end = _tolerance(place, yard, magnet, near, held, needed, contact, settings)
        reason = f"elsewhere within the crane's tolerance: {end}"
        what = "size of the box in which all checks pass, relative to the crane's tolerance"
        checks.append(check_min("narrow-tolerance", what, scale, SCALES[0], "", reason))
    return Lift(
        place, tuple(b.id for b in load), len(load), held.probability,
        tuple(b.id for b in load) if len(load) > settings.bundles else (),
        hold.contact, mass, needed, *offset, overhang[0] + UPPER * overhang[1],
        _scaled(magnet.tolerance, scale),
        _safety(hold, needed, mass, magnet, scale if search else math.inf),
        tuple(checks), valid, target_covariance(
            place, load, contact.gap_sigma_m, _map_sigma(yard.heights, place, magnet), yard.travel,
            magnet.offset,
        ),
    )  # fmt: skip


def _on_label(
    hold: Hold, place: Placement, yard: LiftScene, magnet: Magnet, load: tuple[Bundle, ...], needed_n: float,
    settings: LiftSettings,
) -> tuple[Hold, list[Check]]:  # fmt: skip
    """Check that the faces hold the load wherever a label under one may bear them; and the weakest hold."""
    if yard.heights.gray is None:
        return hold, []
    labels = find_labels(place, yard.heights, magnet, FacePlane.of(hold.contact))
    reason = SEVERAL if len(labels) > 1 else ""
    rests = (rests_on_label(label, place, yard.heights, magnet, settings) for label in labels[:1])
    for contact in itertools.chain.from_iterable(() if reason else rests):
        one = Hold.of(contact, place, magnet, load, needed_n, settings)
        failed = vetoes_of([
            *one.checks(place, magnet, load, needed_n, settings),
            *clearance_checks(place, yard.heights, magnet, one.contact, load, settings.stanchions),
            *leaning_checks(place, magnet, one.contact, load, settings.strap_m),
        ])  # fmt: skip
        if failed:
            reason = failed[0].reason
            break
        hold = hold.weaker(one)
    if reason:
        along, across = labels[0].place_under(place)
        reason = (
            f"a label or another bright plate is under a face, {along:+.2f} m along and {across:+.2f} m "
            f"across the beam, and may hold the faces off the bars: {reason}"
        )
    return hold, [check_true("gap", "a label under a face leaves the load held", not reason, reason)]


def _grip(
    place: Placement, heights: HeightMap, magnet: Magnet, tolerance: Tolerance, near: BundleTable,
    contact: Contact,
) -> Grip:  # fmt: skip
    """Count the bundles that the poles take, bounded by how far each one reaches on the map."""
    reached = reached_strips(heights, place, magnet, tolerance, contact.map_z_m)
    held = count_gripped(place, magnet, tolerance, near, contact.map_z_m, reached)
    clear = seen_clearances(held, heights, place, magnet, tolerance, near, contact.map_z_m, reached)
    held = count_gripped(place, magnet, tolerance, near, contact.map_z_m, reached, clear)
    return without_parted(held, heights, place, near, reached)


def _unseen_lift(place: Placement) -> Lift:
    """Refuse a placement under which nothing is known."""
    nan, nothing = math.nan, Tolerance(0.0, 0.0, 0.0)
    reason = "nothing is known under the magnet"
    unseen = check_true("unknown-under-footprint", "something was seen under the magnet", None, reason)
    return Lift(place, (), 0, 0.0, (), None, Mass(nan, nan), nan, nan, nan, nan, nothing, 0.0, (unseen,))


def _safety(hold: Hold, needed_n: float, mass: Mass, magnet: Magnet, scale: float) -> float:
    """Compute a lift's safety: the minimum of pull over needed pull, weakest pole's pull over its share, what
    the load pries off, the worst bundle, capacity over load, and tolerance over the crane's, `scale`.
    """
    capacity_kg = min(magnet.capacity_kg, magnet.crane_capacity_kg - magnet.own_mass_kg)
    ratios = (
        hold.contact.pull_low_n / needed_n if needed_n > 0 else 0.0,
        hold.weakest.ratio if hold.weakest else 0.0,
        capacity_kg / mass.upper_kg if mass.upper_kg > 0 else 0.0,
        hold.pried, hold.worst, scale,
    )  # fmt: skip
    return float(np.nan_to_num(np.min(ratios)))


def nearby_bundles(table: BundleTable, place: Placement, magnet: Magnet) -> BundleTable:
    """Select the bundles that the magnet may reach, and those beside them."""
    reach = magnet.half_span_m + 1.0
    all_of = table.rectangles
    away = np.array([place.x_m, place.y_m]) - all_of.centre
    beside = np.abs(away[:, 0] * all_of.along[:, 1] - away[:, 1] * all_of.along[:, 0])
    beyond = np.abs((away * all_of.along).sum(axis=1)) - all_of.half[:, 1]
    beyond -= all_of.open_ends.any(axis=1) * BEYOND_OPEN_END_M
    near = (beside < reach + all_of.half[:, 0]) & (beyond < reach)
    bundles = tuple(b for b, take in zip(table.bundles, near, strict=True) if take)
    return BundleTable(bundles, Rectangles(*(array[near] for array in all_of)))


def _load_mass(load: tuple[Bundle, ...]) -> Mass:
    """Sum the load's mass; NaN where one bundle's mass isn't known, or nothing is taken."""
    masses = [bundle_mass(bundle) for bundle in load]
    return sum(masses[1:], masses[0]) if masses else Mass(math.nan, math.nan)


def _map_sigma(heights: HeightMap, place: Placement, magnet: Magnet) -> float:
    """Return the median of the map's sigma along the poles' centre lines; NaN where nothing was seen."""
    parts = np.linspace(-0.5, 0.5, 20)
    v = np.concatenate([pole.along_m + parts * pole.length_m for pole in magnet.poles])
    u = np.repeat([pole.across_m for pole in magnet.poles], parts.size)
    xy = np.array([place.x_m, place.y_m]) + v[:, None] * place.along + u[:, None] * place.across
    column, row, inside = nearest_cells(heights, xy[:, 0], xy[:, 1])
    sigma = heights.sigma_m[row, column][inside]
    seen = sigma[np.isfinite(sigma)]
    return float(np.median(seen)) if seen.size else math.nan


def _overhang(place: Placement, load: tuple[Bundle, ...], magnet: Magnet) -> tuple[float, float]:
    """Compute the longest distance by which bars extend beyond the outermost pole, and its sigma; NaN where
    nothing is taken.
    """
    first = min(pole.along_m - pole.length_m / 2 for pole in magnet.poles)
    last = max(pole.along_m + pole.length_m / 2 for pole in magnet.poles)
    beyond = []
    for bundle in load:
        sigma = known_sigma(bundle.sigma.length_m) / 2
        ends = (bundle.ends_m[:, :2] - (place.x_m, place.y_m)) @ place.along
        beyond += [(max(end - last, first - end), sigma) for end in ends.tolist()]
    return max(beyond, key=lambda way: way[0] + UPPER * way[1], default=(math.nan, math.nan))


def _tolerance(
    place: Placement, yard: LiftScene, magnet: Magnet, near: BundleTable, held: Grip, needed_n: float,
    contact: Contact, settings: LiftSettings,
) -> tuple[float, str]:  # fmt: skip
    """Find the largest of SCALES times the crane's tolerance within which the lift remains as checked, and
    the reason why no larger one does.
    """
    found, load = 0.0, tuple(near.bundles[k] for k in held.gripped)
    for scale in SCALES:
        box = _scaled(magnet.tolerance, scale)
        sure = _grip(place, yard.heights, magnet, box, near, contact).probability
        unsure = vetoes_of([probability_check(sure, len(held.gripped), settings)])
        if unsure:
            return found, unsure[0].reason
        wider = replace(magnet, tolerance=box)
        labels = find_labels(place, yard.heights, wider, FacePlane.of(contact))
        if len(labels) > 1:
            return found, SEVERAL
        changed = _change(place, box, yard, magnet, near, held, needed_n, settings, labels)
        if changed:
            return found, changed
        clear = clearance_checks(place, yard.heights, wider, contact, load, settings.stanchions)
        for veto in vetoes_of(clear):
            return found, veto.reason
        found = scale
    return found, ""


def _scaled(tolerance: Tolerance, scale: float) -> Tolerance:
    """Scale the crane's tolerance, up to the maximum that a tolerance may have."""
    return Tolerance(
        min(tolerance.x_m * scale, 1.0), min(tolerance.y_m * scale, 1.0), min(tolerance.yaw_deg * scale, 20.0)
    )


def _change(
    place: Placement, box: Tolerance, yard: LiftScene, magnet: Magnet, near: BundleTable, held: Grip,
    needed_n: float, settings: LiftSettings, labels: tuple[SeenLabel, ...],
) -> str:  # fmt: skip
    """Find what changes at a corner of the box where the faces come to rest there, on labels or not; empty if
    nothing does.
    """
    load = tuple(near.bundles[k] for k in held.gripped)
    exact = replace(magnet, tolerance=Tolerance(0.0, 0.0, 0.0))
    for dx, dy, dyaw in itertools.product((-1, 1), repeat=3):
        moved = replace(
            place, x_m=place.x_m + dx * box.x_m, y_m=place.y_m + dy * box.y_m,
            yaw_rad=place.yaw_rad + dyaw * math.radians(box.yaw_deg),
        )  # fmt: skip
        bare = rest_magnet(yard.heights, moved, magnet, settings.contact_gap_m)
        if bare is None:
            return "nothing is known under the magnet"
        rests = (rests_on_label(label, moved, yard.heights, magnet, settings) for label in labels)
        for contact in itertools.chain((bare,), *rests):
            hold = Hold.of(contact, moved, magnet, load, needed_n, settings)
            held_checks = hold.checks(moved, magnet, load, needed_n, settings)
            for veto in vetoes_of([unknown_check(contact, settings), *held_checks]):
                return veto.reason if contact is bare else f"{ON_LABEL}: {veto.reason}"
            # The whole box was checked against the limits with their sigmas; only the faces' rest is new.
            obstacle = find_obstacle(moved, yard.heights, exact, FacePlane.of(contact), load, careful=False)
            if obstacle is not None:
                return obstacle.reason
        there = _grip(moved, yard.heights, magnet, exact.tolerance, near, bare)
        if there.gripped != held.gripped:
            return f"the magnet would take {len(there.gripped)} bundles"
    return ""
