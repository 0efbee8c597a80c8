"""Judge one placement of the magnet: what it would take, how it lies, and every reason not to lift."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace

import numpy as np

from barsight.core.arrays import Float64
from barsight.yard.lift_settings import UPPER, LiftSettings
from barsight.yard.lifting.checks import count_vetoes, face_vetoes, load_vetoes
from barsight.yard.lifting.clearance import clearance_vetoes, resting_vetoes
from barsight.yard.lifting.contact import NEWTON_PER_KG, Contact, set_down
from barsight.yard.lifting.footprint import BEYOND_OPEN_END_M, BundleTable, Grip, Placement, count_gripped
from barsight.yard.lifting.holding import hold_load, share_vetoes, weakest_pole
from barsight.yard.lifting.magnet import Magnet, Tolerance
from barsight.yard.lifting.travel_accuracy import Travel, travel_vetoes
from barsight.yard.lifting.validity import Validity, age_vetoes, validity
from barsight.yard.stability.stability import Footing, footing_vetoes
from barsight.yard.types import Bundle, HeightMap
from barsight.yard.vetoes import Veto
from barsight.yard.weight import Mass, bundle_mass

SCALES = (1.0, 1.5, 2.5)
"""Multiples of the crane's tolerance that are tried for the box within which a lift stays as checked."""


@dataclass(frozen=True, eq=False)
class LiftScene:
    """All that lifts are chosen from. vetoes: those that hold for the whole map. travel: None where the map
    is not measured but given. now_ns: when lifts are judged, on the frames' clock.
    """

    heights: HeightMap
    table: BundleTable
    footings: tuple[Footing, ...]
    vetoes: tuple[Veto, ...]
    travel: Travel | None = None
    now_ns: int = 0


@dataclass(frozen=True, eq=False)
class Lift:
    """A judged placement. All in m, rad, N, kg; NaN where unknown.

    bundles: ids of what would be taken, `count` of them with `count_probability`; straddled: those of them
    that are too many. contact: how the faces lie, None where nothing is known there. needed_n: weight upper
    bound times safety factor. offset_along_m, offset_across_m: magnet's centre minus the load's.
    overhang_m: bars beyond the outermost pole. tolerance: half sides of the box within which all this holds.
    safety: the smallest of pull over needed, capacity over load and tolerance over the crane's; at least 1
    where nothing is vetoed. validity: in time, None where no frame is known to have seen the place.
    """

    place: Placement
    bundles: tuple[int, ...]
    count: int
    count_probability: float
    straddled: tuple[int, ...]
    contact: Contact | None
    mass: Mass
    needed_n: float
    offset_along_m: float
    offset_across_m: float
    overhang_m: float
    tolerance: Tolerance
    safety: float
    vetoes: tuple[Veto, ...]
    validity: Validity | None = None


def assess_placement(
    place: Placement, yard: LiftScene, magnet: Magnet, settings: LiftSettings, *, search: bool = True
) -> Lift:
    """Judge a placement. Without `search` the tolerance is not looked for (and not vetoed)."""
    near = nearby_bundles(yard.table, place, magnet)
    contact = set_down(yard.heights, place, magnet, settings.contact_gap_m)
    if contact is None:
        unknown = Veto("unknown-under-footprint", "nothing is known under the magnet")
        nothing = Tolerance(0.0, 0.0, 0.0)
        nan = math.nan
        return Lift(
            place, (), 0, 0.0, (), None, Mass(nan, nan), nan, nan, nan, nan, nothing, 0.0,
            (*yard.vetoes, unknown),
        )  # fmt: skip
    held = count_gripped(place, magnet, magnet.tolerance, near, contact.z_m)
    load = tuple(near.bundles[k] for k in held.gripped)
    valid = validity(yard.travel, place, settings) if yard.travel else None
    mass, middle = _load(load)
    needed = mass.upper_kg * NEWTON_PER_KG * magnet.needed_factor
    contact = hold_load(contact, magnet, load, settings.strap_m)
    weakest = weakest_pole(contact, needed, magnet, place, load)
    away = np.array([place.x_m, place.y_m]) - middle
    along, across = float(away @ place.along), float(away @ place.across)
    overhang = _overhang(place, load, magnet)
    vetoes = [
        *yard.vetoes,
        *(travel_vetoes(yard.travel, place, magnet, settings) if yard.travel else ()),
        *(age_vetoes(valid.from_ns, yard.now_ns, settings) if valid else ()),
        *count_vetoes(place, yard.heights, magnet, near, contact, held, settings),
        *face_vetoes(contact, needed, magnet, settings),
        *share_vetoes(weakest),
        *clearance_vetoes(place, yard.heights, magnet, contact),
        *resting_vetoes(place, magnet, contact, load),
        *load_vetoes(load, mass, along, across, overhang, magnet, settings),
        *(v for b in load for v in footing_vetoes(b, near.bundles, yard.footings, settings)),
    ]
    scale = 0.0
    if search and not vetoes:
        scale, end = _tolerance(place, yard, magnet, near, held, needed, contact, settings)
        if scale < 1:
            vetoes.append(Veto("narrow-tolerance", f"within the crane's tolerance {end}"))
    box = magnet.tolerance
    ratios = (
        contact.pull_low_n / needed if needed > 0 else 0.0,
        weakest.ratio if weakest else 0.0,
        min(magnet.capacity_kg, magnet.crane_capacity_kg - magnet.own_mass_kg) / mass.upper_kg
        if mass.upper_kg > 0 else 0.0,
        scale if search else math.inf,
    )  # fmt: skip
    return Lift(
        place, tuple(b.id for b in load), len(load), held.probability,
        tuple(b.id for b in load) if len(load) > settings.bundles else (),
        contact, mass, needed, along, across, overhang,
        Tolerance(box.x_m * scale, box.y_m * scale, min(box.yaw_deg * scale, 20.0)),
        float(np.nan_to_num(min(ratios))), tuple(vetoes), valid,
    )  # fmt: skip


def nearby_bundles(table: BundleTable, place: Placement, magnet: Magnet) -> BundleTable:
    """Select the bundles that the magnet may reach or that stand beside those."""
    reach = magnet.half_span_m + 1.0
    away = np.array([place.x_m, place.y_m]) - table.centre
    beside = np.abs(away[:, 0] * table.along[:, 1] - away[:, 1] * table.along[:, 0])
    beyond = np.abs((away * table.along).sum(axis=1)) - table.half[:, 1]
    beyond -= table.open_ends.any(axis=1) * BEYOND_OPEN_END_M
    near = (beside < reach + table.half[:, 0]) & (beyond < reach)
    return BundleTable(
        tuple(b for b, take in zip(table.bundles, near, strict=True) if take),
        table.centre[near], table.along[near], table.half[near], table.top[near], table.slope[near],
        table.sigma[near], table.sigma_top[near], table.open_ends[near],
    )  # fmt: skip


def _load(load: tuple[Bundle, ...]) -> tuple[Mass, Float64]:
    """Sum the load's mass and its centre (x, y); bundles of unknown mass weigh alike."""
    if not load:
        return Mass(math.nan, math.nan), np.full(2, np.nan)
    masses = [bundle_mass(bundle) for bundle in load]
    total = masses[0]
    for more in masses[1:]:
        total = total + more
    weights = np.nan_to_num([m.kg for m in masses], nan=1.0)
    centres = np.array([b.centre_m[:2] for b in load])
    return total, np.asarray(weights @ centres / weights.sum())


def _overhang(place: Placement, load: tuple[Bundle, ...], magnet: Magnet) -> float:
    """Compute the longest way from the outermost pole to an end, upper bound; NaN where nothing is taken."""
    beyond = [
        abs((end[:2] - (place.x_m, place.y_m)) @ place.along) - magnet.half_span_m
        + UPPER * float(np.nan_to_num(bundle.sigma.length_m, nan=0.05)) / 2
        for bundle in load for end in bundle.ends_m
    ]  # fmt: skip
    return max(beyond, default=math.nan)


def _tolerance(
    place: Placement, yard: LiftScene, magnet: Magnet, near: BundleTable, held: Grip, needed_n: float,
    contact: Contact, settings: LiftSettings,
) -> tuple[float, str]:  # fmt: skip
    """Find the largest of SCALES times the crane's tolerance within which the lift stays as checked, and what
    ends it there.
    """
    found = 0.0
    for scale in SCALES:
        box = Tolerance(
            min(magnet.tolerance.x_m * scale, 1.0), min(magnet.tolerance.y_m * scale, 1.0),
            min(magnet.tolerance.yaw_deg * scale, 20.0),
        )  # fmt: skip
        sure = count_gripped(place, magnet, box, near, contact.z_m).probability
        if sure < settings.min_count_probability:
            return found, f"a count of {len(held.gripped)} has the probability {sure:.4f} only"
        changed = _change(place, box, yard, magnet, near, held, needed_n, settings)
        if changed:
            return found, changed
        for veto in clearance_vetoes(place, yard.heights, replace(magnet, tolerance=box), contact):
            return found, veto.reason
        found = scale
    return found, ""


def _change(
    place: Placement, box: Tolerance, yard: LiftScene, magnet: Magnet, near: BundleTable, held: Grip,
    needed_n: float, settings: LiftSettings,
) -> str:  # fmt: skip
    """Find what changes at a corner of the box; empty where nothing does."""
    for dx, dy, dyaw in itertools.product((-1, 1), repeat=3):
        moved = replace(
            place, x_m=place.x_m + dx * box.x_m, y_m=place.y_m + dy * box.y_m,
            yaw_rad=place.yaw_rad + dyaw * math.radians(box.yaw_deg),
        )  # fmt: skip
        contact = set_down(yard.heights, moved, magnet, settings.contact_gap_m)
        if contact is None or contact.unknown_share > settings.max_unknown_ratio:
            return "too much under the poles was not seen"
        load = tuple(near.bundles[k] for k in held.gripped)
        contact = hold_load(contact, magnet, load, settings.strap_m)
        weakest = weakest_pole(contact, needed_n, magnet, moved, load)
        vetoes = face_vetoes(contact, needed_n, magnet, settings) + share_vetoes(weakest)
        if vetoes:
            return f"{vetoes[0].reason}"
        exact = count_gripped(moved, magnet, Tolerance(0.0, 0.0, 0.0), near, contact.z_m)
        if exact.gripped != held.gripped:
            return f"it takes {len(exact.gripped)} bundles"
    return ""
