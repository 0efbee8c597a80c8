"""Assess one placement of the magnet: the bundles taken, how the magnet lies, and every veto."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace

import numpy as np

from barsight.core.arrays import Float64
from barsight.yard.lift_settings import UPPER, LiftSettings
from barsight.yard.lifting.hold import SEVERAL, Hold, Task, hold_on_labels, label_check
from barsight.yard.lifting.lift import Lift, LiftScene
from barsight.yard.lifting.travel_accuracy import crane_checks, target_covariance
from barsight.yard.lifting.validity import age_checks, disturbed_checks, validity
from barsight.yard.magnet.contact import NEWTON_PER_KG, Contact, FaceHeights
from barsight.yard.magnet.description import Magnet, Tolerance
from barsight.yard.magnet.footprint import (
    BEYOND_OPEN_END_M,
    BundleTable,
    Grip,
    Placement,
    Rectangles,
    count_gripped,
)
from barsight.yard.magnet.partings import without_parted
from barsight.yard.magnet.reach import reached_strips
from barsight.yard.magnet.seen_edges import seen_clearances
from barsight.yard.map_lookup import nearest_cells
from barsight.yard.placement.checks import (
    area_checks,
    count_checks,
    load_checks,
    probability_check,
    unknown_check,
)
from barsight.yard.placement.clearance import (
    FacePlane,
    find_obstacle,
)
from barsight.yard.placement.labels import SeenLabel, find_labels
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
ON_LABEL = "if the faces rest on a label or another bright plate"


@dataclass(frozen=True, eq=False)
class Assessed:
    """A placement whose tolerance isn't determined yet. near: the bundles about it; held: those taken;
    labels: those under the faces, None where something else forbids the lift.
    """

    lift: Lift
    near: BundleTable
    held: Grip | None = None
    labels: tuple[SeenLabel, ...] | None = None

    def within_tolerance(self, yard: LiftScene, magnet: Magnet, settings: LiftSettings) -> Lift:
        """Determine the tolerance of a lift without a veto, which may itself be a veto."""
        lift = self.lift
        if self.held is None or lift.contact is None or lift.vetoes:
            return replace(lift, safety=0.0)
        load = tuple(self.near.bundles[k] for k in self.held.gripped)
        task = Task(lift.place, yard.heights, magnet, load, lift.needed_n, settings)
        scale, end = _tolerance(task, self, lift.contact)
        reason = f"elsewhere within the crane's tolerance: {end}"
        what = "size of the box in which all checks pass, relative to the crane's tolerance"
        return replace(
            lift, tolerance=_scaled(magnet.tolerance, scale), safety=min(lift.safety, scale),
            checks=(*lift.checks, check_min("narrow-tolerance", what, scale, SCALES[0], "", reason)),
        )  # fmt: skip


def assess_placement(place: Placement, yard: LiftScene, magnet: Magnet, settings: LiftSettings) -> Lift:
    """Assess a placement, and the tolerance within which it holds."""
    return assess_place(place, yard, magnet, settings).within_tolerance(yard, magnet, settings)


def assess_place(place: Placement, yard: LiftScene, magnet: Magnet, settings: LiftSettings) -> Assessed:
    """Assess a placement without its tolerance."""
    near = nearby_bundles(yard.table, place, magnet)
    faces = FaceHeights.of(yard.heights, place, magnet)
    if faces is None:
        return Assessed(_unseen_lift(place), near)
    contact = faces.rest(magnet, settings.contact_gap_m)
    held = _grip(place, yard.heights, magnet, magnet.tolerance, near, contact)
    load = tuple(near.bundles[k] for k in held.gripped)
    valid = validity(yard.travel, place, magnet, load, yard.heights, settings) if yard.travel else None
    mass = _load_mass(load)
    needed = mass.upper_kg * NEWTON_PER_KG * magnet.needed_factor
    task = Task(place, yard.heights, magnet, load, needed, settings)
    hold = task.hold(contact)
    contact = hold.contact
    away = np.array([place.x_m, place.y_m]) - load_centre(load)
    offset = float(away @ place.along), float(away @ place.across)
    overhang = _overhang(place, load, magnet)
    before = [
        *crane_checks(yard.travel, place, magnet, settings),
        *(age_checks(valid.from_ns if valid else None, yard.now_ns, settings) if yard.travel else ()),
        *area_checks(place, magnet, load, settings),
        *disturbed_checks(yard.events, place, magnet, load, valid, settings),
        *count_checks(place, yard.heights, magnet, near, contact, held, settings),
    ]
    resting = [*task.checks(hold), *task.clearance(contact)]
    after = [
        *load_checks(load, mass, offset, overhang, magnet, settings),
        *(check for b in load for check in footing_checks(b, near.bundles, yard.footings, settings)),
    ]
    labels = None
    if not vetoes_of((*before, *resting, *after)):
        labels = find_labels(place, yard.heights, magnet, FacePlane.of(contact))
        hold, resting, reason = hold_on_labels(hold, resting, task, faces, labels)
        if yard.heights.gray is not None:
            after.append(label_check(place, labels, reason))
        after += _thin_checks(task, yard, near, contact)
    lift = Lift(
        place, tuple(b.id for b in load), len(load), held.probability,
        tuple(b.id for b in load) if len(load) > settings.bundles else (),
        hold.contact, mass, needed, *offset, overhang[0] + UPPER * overhang[1],
        _scaled(magnet.tolerance, 0.0), _safety(hold, needed, mass, magnet),
        (*before, *resting, *after), valid,
        target_covariance(
            place, load, math.hypot(contact.gap_sigma_m, hold.contact.over_map_sigma_m),
            _map_sigma(yard.heights, place, magnet), yard.travel, magnet.offset,
        ),
    )  # fmt: skip
    return Assessed(lift, near, held, labels)


def _thin_checks(task: Task, yard: LiftScene, near: BundleTable, contact: Contact) -> list[Check]:
    """Check that no thin bar lies across the load, or across a neighbour and towards the magnet."""
    place, magnet, load = task.place, task.magnet, task.load
    pixel_m = yard.travel.pixel_m(contact.centre_z_m) if yard.travel else None
    checks = thin_bar_checks(yard.heights, yard.thin_line(load), load, pixel_m, task.settings)
    if has_pictures(yard.heights, pixel_m):
        low_z_m = FacePlane.of(contact).centre_z_m - magnet.half_span_m * abs(math.tan(contact.pitch_rad))
        others = [b for b in near.bundles if b not in load and may_reach(b, place, magnet, low_z_m)]
        checks += edge_checks(others)
        checks += beside_checks(place, magnet, tuple((b, yard.thin_lines(b)) for b in others))
    return checks


def _grip(
    place: Placement, heights: HeightMap, magnet: Magnet, tolerance: Tolerance, near: BundleTable,
    contact: Contact,
) -> Grip:  # fmt: skip
    """Count the bundles that the poles take, as certainly as their surface shows."""
    held, reached = _taken(place, heights, magnet, tolerance, near, contact)
    clear = seen_clearances(held, heights, place, magnet, tolerance, near, contact.map_z_m, reached)
    held = count_gripped(place, magnet, tolerance, near, contact.map_z_m, reached, clear)
    return without_parted(held, heights, place, near, reached)


def _taken(
    place: Placement, heights: HeightMap, magnet: Magnet, tolerance: Tolerance, near: BundleTable,
    contact: Contact,
) -> tuple[Grip, Float64]:  # fmt: skip
    """Count the bundles that the poles take, bounded by how far each one reaches on the map; return that too.
    Their surface changes only the probability.
    """
    reached = reached_strips(heights, place, magnet, tolerance, contact.map_z_m)
    return count_gripped(place, magnet, tolerance, near, contact.map_z_m, reached), reached


def _unseen_lift(place: Placement) -> Lift:
    """Refuse a placement under which nothing is known."""
    nan, nothing = math.nan, Tolerance(0.0, 0.0, 0.0)
    reason = "nothing is known under the magnet"
    unseen = check_true("unknown-under-footprint", "something was seen under the magnet", None, reason)
    return Lift(place, (), 0, 0.0, (), None, Mass(nan, nan), nan, nan, nan, nan, nothing, 0.0, (unseen,))


def _safety(hold: Hold, needed_n: float, mass: Mass, magnet: Magnet) -> float:
    """Compute a lift's safety without that of its tolerance: the minimum of pull over needed pull, weakest
    pole's pull over its share, what the load pries off, the worst bundle, and capacity over load.
    """
    capacity_kg = min(magnet.capacity_kg, magnet.crane_capacity_kg - magnet.own_mass_kg)
    ratios = (
        hold.contact.pull_low_n / needed_n if needed_n > 0 else 0.0,
        hold.weakest.ratio if hold.weakest else 0.0,
        capacity_kg / mass.upper_kg if mass.upper_kg > 0 else 0.0,
        hold.pried, hold.worst,
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


def _tolerance(task: Task, assessed: Assessed, contact: Contact) -> tuple[float, str]:
    """Find the largest of SCALES times the crane's tolerance within which the lift remains as checked, and
    the reason why no larger one does. contact: where the faces are bare.
    """
    place, heights, magnet = task.place, task.heights, task.magnet
    found, held, labels = 0.0, assessed.held, assessed.labels or ()
    assert held is not None
    for scale in SCALES:
        box = _scaled(magnet.tolerance, scale)
        if scale > SCALES[0]:
            # The crane's own tolerance is that of the checks that passed already.
            sure = _grip(place, heights, magnet, box, assessed.near, contact).probability
            for veto in vetoes_of([probability_check(sure, len(held.gripped), task.settings)]):
                return found, veto.reason
            wider = replace(task, magnet=replace(magnet, tolerance=box))
            labels = find_labels(place, heights, wider.magnet, FacePlane.of(contact))
            if len(labels) > 1:
                return found, SEVERAL
            for veto in vetoes_of(wider.clearance(contact)):
                return found, veto.reason
        changed = _change(box, task, assessed, labels)
        if changed:
            return found, changed
        found = scale
    return found, ""


def _scaled(tolerance: Tolerance, scale: float) -> Tolerance:
    """Scale the crane's tolerance, up to the maximum that a tolerance may have."""
    return Tolerance(
        min(tolerance.x_m * scale, 1.0), min(tolerance.y_m * scale, 1.0), min(tolerance.yaw_deg * scale, 20.0)
    )


def _change(box: Tolerance, task: Task, assessed: Assessed, labels: tuple[SeenLabel, ...]) -> str:
    """Find what changes at a corner of the box where the faces come to rest there, on labels or not; empty
    if nothing does.
    """
    heights, load, settings, held = task.heights, task.load, task.settings, assessed.held
    exact = replace(task.magnet, tolerance=Tolerance(0.0, 0.0, 0.0))
    for dx, dy, dyaw in itertools.product((-1, 1), repeat=3):
        at = task.place
        moved = replace(
            at, x_m=at.x_m + dx * box.x_m, y_m=at.y_m + dy * box.y_m,
            yaw_rad=at.yaw_rad + dyaw * math.radians(box.yaw_deg),
        )  # fmt: skip
        faces = FaceHeights.of(heights, moved, exact)
        if faces is None:
            return "nothing is known under the magnet"
        there = replace(task, place=moved)
        bare = faces.rest(exact, settings.contact_gap_m)
        rests = list(there.rests(faces, bare, labels))
        for contact in (bare, *rests):
            checks = there.hold(contact).checks(moved, task.magnet, load, task.needed_n, settings)
            for veto in vetoes_of([unknown_check(contact, settings), *checks]):
                return veto.reason if contact is bare else f"{ON_LABEL}: {veto.reason}"
        # The whole box was checked against the limits with their sigmas; only the faces' rest is new.
        obstacle = find_obstacle(moved, heights, exact, FacePlane.of(bare, rests), load, careful=False)
        if obstacle is not None:
            return obstacle.reason
        taken, _ = _taken(moved, heights, exact, exact.tolerance, assessed.near, bare)
        if held is None or taken.gripped != held.gripped:
            return f"the magnet would take {len(taken.gripped)} bundles"
    return ""
