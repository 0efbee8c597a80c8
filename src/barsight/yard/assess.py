"""One placement of the magnet, judged: what it would take, how it lies, and every reason not to lift."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace

import numpy as np

from barsight.core.arrays import Float64
from barsight.yard.contact import NEWTON_PER_KG, Contact, touch
from barsight.yard.footprint import BEYOND_OPEN_END_M, BundleTable, Grip, Placement, grip
from barsight.yard.lift_settings import LiftSettings
from barsight.yard.load import UPPER, Mass, mass_of
from barsight.yard.magnet import Magnet, Tolerance
from barsight.yard.stability import Footing, footing_vetoes, look_up
from barsight.yard.types import Bundle, HeightMap
from barsight.yard.vetoes import Veto

SCALES = (0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 2.0, 3.0, 4.0)
"""Multiples of the crane's tolerance that are tried for the box within which a lift stays as checked."""
MARGIN_M = 0.02
"""How far beyond its stated outline a bundle may show."""
TALL_CELLS = 5


@dataclass(frozen=True, eq=False)
class Yard:
    """All that lifts are chosen from. vetoes: those that hold for the whole map."""

    heights: HeightMap
    table: BundleTable
    footings: tuple[Footing, ...]
    vetoes: tuple[Veto, ...]


@dataclass(frozen=True, eq=False)
class Lift:
    """A judged placement. All in m, rad, N, kg; NaN where unknown.

    bundles: ids of what would be taken, `count` of them with `count_probability`; straddled: those of them
    that are too many. contact: how the faces lie, None where nothing is known there. needed_n: weight upper
    bound times safety factor. offset_along_m, offset_across_m: magnet's centre minus the load's.
    overhang_m: bars beyond the outermost pole. tolerance: half sides of the box within which all this holds.
    safety: the smallest of pull over needed, capacity over load and tolerance over the crane's; at least 1
    where nothing is vetoed.
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


def assess(
    place: Placement, yard: Yard, magnet: Magnet, settings: LiftSettings, *, search: bool = True
) -> Lift:
    """Judge a placement. Without `search` the tolerance is not looked for (and not vetoed)."""
    near = near_table(yard.table, place, magnet)
    contact = touch(yard.heights, place, magnet, settings.contact_gap_m)
    if contact is None:
        unknown = Veto("unknown-under-footprint", "nothing is known under the magnet")
        nothing = Tolerance(0.0, 0.0, 0.0)
        nan = math.nan
        return Lift(
            place, (), 0, 0.0, (), None, Mass(nan, nan), nan, nan, nan, nan, nothing, 0.0,
            (*yard.vetoes, unknown),
        )  # fmt: skip
    held = grip(place, magnet, magnet.tolerance, near, contact.z_m)
    load = tuple(near.bundles[k] for k in held.gripped)
    mass, middle = _load(load)
    needed = mass.upper_kg * NEWTON_PER_KG * magnet.safety_factor
    away = np.array([place.x_m, place.y_m]) - middle
    along, across = float(away @ place.along), float(away @ place.across)
    overhang = _overhang(place, load, magnet)
    vetoes = [
        *yard.vetoes,
        *_count_vetoes(place, yard, magnet, near, contact, held, settings),
        *_face_vetoes(contact, needed, magnet, settings),
        *_tall_veto(place, yard.heights, magnet, contact),
        *_load_vetoes(load, mass, along, across, overhang, magnet, settings),
        *(v for b in load for v in footing_vetoes(b, near.bundles, yard.footings, settings)),
    ]
    scale = 0.0
    if search and not vetoes:
        scale = _tolerance(place, yard, magnet, near, held, needed, settings)
        if scale < 1:
            vetoes.append(
                Veto("narrow-tolerance", f"it stays as checked within {scale:g} of the crane's tolerance only")
            )
    box = magnet.tolerance
    ratios = (
        contact.pull_low_n / needed if needed > 0 else 0.0,
        min(magnet.capacity_kg, magnet.crane_capacity_kg - magnet.own_mass_kg) / mass.upper_kg
        if mass.upper_kg > 0 else 0.0,
        scale if search else math.inf,
    )  # fmt: skip
    return Lift(
        place, tuple(b.id for b in load), len(load), held.probability,
        tuple(b.id for b in load) if len(load) > settings.bundles else (),
        contact, mass, needed, along, across, overhang,
        Tolerance(box.x_m * scale, box.y_m * scale, min(box.yaw_deg * scale, 20.0)),
        float(np.nan_to_num(min(ratios))), tuple(vetoes),
    )  # fmt: skip


def near_table(table: BundleTable, place: Placement, magnet: Magnet) -> BundleTable:
    """The bundles that the magnet may reach or that stand beside those."""
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


def _count_vetoes(
    place: Placement, yard: Yard, magnet: Magnet, near: BundleTable, contact: Contact, held: Grip,
    settings: LiftSettings,
) -> list[Veto]:  # fmt: skip
    vetoes = []
    count = len(held.gripped)
    ids = ", ".join(str(near.bundles[k].id) for k in held.gripped)
    if contact.unknown_share > settings.max_unknown_share:
        vetoes.append(
            Veto("unknown-under-footprint", f"{100 * contact.unknown_share:.0f} % of the cells under a pole "
                 f"were not seen, {100 * settings.max_unknown_share:.0f} % are allowed")
        )  # fmt: skip
    if count == 0:
        vetoes.append(Veto("no-bundle", "no known bundle lies under the poles within reach"))
    if count > settings.bundles:
        vetoes.append(
            Veto("straddles-neighbour", f"the footprint takes {count} bundles ({ids}), not {settings.bundles}")
        )
    if count < settings.bundles and count:
        vetoes.append(
            Veto("count-uncertain", f"the footprint takes {count} bundles, {settings.bundles} are asked for")
        )
    elif held.probability < settings.least_count_probability:
        worst = near.bundles[int(np.argmax(held.flips))].id
        vetoes.append(
            Veto("count-uncertain", f"{count} bundles with probability {held.probability:.4f} only: bundle "
                 f"{worst} is too near an edge of the footprint")
        )  # fmt: skip
    share = _unexplained(place, yard.heights, magnet, near, contact)
    if share > settings.max_unexplained_share:
        vetoes.append(
            Veto("unexplained-surface", f"{100 * share:.0f} % of what lies within reach of the poles "
                 f"belongs to no known bundle")
        )  # fmt: skip
    return vetoes


def _face_vetoes(contact: Contact, needed_n: float, magnet: Magnet, settings: LiftSettings) -> list[Veto]:
    vetoes = []
    pitch = abs(math.degrees(contact.pitch_rad))
    if pitch > magnet.limits.pitch_deg:
        vetoes.append(
            Veto("tilt", f"the faces slope by {pitch:.1f} deg along the beam, "
                 f"{magnet.limits.pitch_deg:g} are allowed")
        )  # fmt: skip
    narrowest = min(pole.width_m for pole in magnet.poles)
    if contact.rests_off_m > narrowest / 4:
        vetoes.append(
            Veto("tilt", f"the faces rest {1e3 * contact.rests_off_m:.0f} mm beside their middle and would "
                 f"lean further than the {magnet.limits.roll_deg:g} deg that the suspension allows")
        )  # fmt: skip
    if contact.contact_share < magnet.limits.contact_share:
        vetoes.append(
            Veto("gap", f"only {100 * contact.contact_share:.0f} % of a pole's face lies on steel, "
                 f"{100 * magnet.limits.contact_share:.0f} % are needed")
        )  # fmt: skip
    if contact.pull_low_n < needed_n:
        vetoes.append(
            Veto("weak-pull", f"the pull is at least {contact.pull_low_n / 1e3:.1f} kN, "
                 f"{needed_n / 1e3:.1f} kN are needed")
        )  # fmt: skip
    return vetoes


def _load_vetoes(
    load: tuple[Bundle, ...], mass: Mass, along: float, across: float, overhang: float, magnet: Magnet,
    settings: LiftSettings,
) -> list[Veto]:  # fmt: skip
    vetoes = []
    limits = magnet.limits
    for bundle in load:
        if bundle.on_top is not True:
            what = "something lies on" if bundle.on_top is False else "it isn't known what lies on"
            vetoes.append(Veto("covered", f"{what} bundle {bundle.id}"))
        if bundle.confidence < settings.least_confidence:
            vetoes.append(
                Veto("bundle-doubtful", f"bundle {bundle.id} is {100 * bundle.confidence:.0f} % sure: "
                     + ("; ".join(bundle.reasons) or "no reason is given"))
            )  # fmt: skip
        if any(bundle.ends_open):
            ends = " and ".join(e for e, o in zip(("low-y", "high-y"), bundle.ends_open, strict=True) if o)
            vetoes.append(
                Veto("end-open", f"the {ends} end of bundle {bundle.id} was not seen: length, mass and "
                     "balance are not known")
            )  # fmt: skip
    if load and math.isnan(mass.kg):
        vetoes.append(Veto("mass-unknown", "number or diameter of the bars is not known"))
    for carrier, most in (
        ("magnet", magnet.capacity_kg),
        ("crane beside the magnet", magnet.crane_capacity_kg - magnet.own_mass_kg),
    ):
        if mass.upper_kg > most:
            vetoes.append(
                Veto("overweight", f"the load may weigh {mass.upper_kg:.0f} kg, the {carrier} carries {most:.0f}")
            )
    for name, offset, most in (
        ("along", along, limits.offset_along_m),
        ("across", across, limits.offset_across_m),
    ):
        if abs(offset) > most:
            vetoes.append(
                Veto("off-centre", f"the magnet's centre is {1e3 * abs(offset):.0f} mm {name} the bars from "
                     f"the load's, {1e3 * most:.0f} mm are allowed")
            )  # fmt: skip
    if overhang > limits.overhang_m:
        vetoes.append(
            Veto("overhang", f"the bars reach {overhang:.2f} m beyond the outermost pole, "
                 f"{limits.overhang_m:g} m are allowed")
        )  # fmt: skip
    return vetoes


def _load(load: tuple[Bundle, ...]) -> tuple[Mass, Float64]:
    """The load's mass and its centre (x, y); bundles of unknown mass weigh alike."""
    if not load:
        return Mass(math.nan, math.nan), np.full(2, np.nan)
    masses = [mass_of(bundle) for bundle in load]
    total = masses[0]
    for more in masses[1:]:
        total = total + more
    weights = np.nan_to_num([m.kg for m in masses], nan=1.0)
    centres = np.array([b.centre_m[:2] for b in load])
    return total, np.asarray(weights @ centres / weights.sum())


def _overhang(place: Placement, load: tuple[Bundle, ...], magnet: Magnet) -> float:
    """The longest way from the outermost pole to an end, upper bound; NaN where nothing is taken."""
    beyond = [
        abs((end[:2] - (place.x_m, place.y_m)) @ place.along) - magnet.half_span_m
        + UPPER * float(np.nan_to_num(bundle.sigma.length_m, nan=0.05)) / 2
        for bundle in load for end in bundle.ends_m
    ]  # fmt: skip
    return max(beyond, default=math.nan)


def _pole_points(place: Placement, magnet: Magnet, grow: tuple[float, float], step: float) -> Float64:
    """(N, 3) x, y and pole of places over the faces, grown by (along, across)."""
    points = []
    for number, pole in enumerate(magnet.poles):
        long, wide = pole.length_m / 2 + grow[0], pole.width_m / 2 + grow[1]
        v = np.linspace(-long, long, max(int(2 * long / (2 * step)), 2)) + pole.along_m
        u = np.linspace(-wide, wide, max(int(2 * wide / step), 2)) + pole.across_m
        vv, uu = (a.ravel() for a in np.meshgrid(v, u))
        xy = np.array([place.x_m, place.y_m]) + vv[:, None] * place.along + uu[:, None] * place.across
        points.append(np.column_stack([xy, np.full(len(xy), number)]))
    return np.concatenate(points)


def _unexplained(
    place: Placement, heights: HeightMap, magnet: Magnet, near: BundleTable, contact: Contact
) -> float:
    """Share of the places under the poles, within reach, that lie outside all bundles' outlines."""
    across = abs(place.across) @ (magnet.tolerance.x_m, magnet.tolerance.y_m)
    points = _pole_points(place, magnet, (0.0, float(across)), 0.02)
    z = look_up(heights, points[:, 0], points[:, 1])
    reached = z > contact.z_m[points[:, 2].astype(np.int64)] - magnet.reach_m
    if not reached.any():
        return 0.0
    away = points[reached, None, :2] - near.centre
    beside = np.abs(away[..., 0] * near.along[:, 1] - away[..., 1] * near.along[:, 0])
    beyond = np.abs((away * near.along).sum(axis=-1))
    wide = near.half[:, 0] + MARGIN_M + 2 * np.hypot(near.sigma[:, 0], near.sigma[:, 3])
    long = near.half[:, 1] + MARGIN_M + 2 * np.hypot(near.sigma[:, 1], near.sigma[:, 4])
    long = long + near.open_ends.any(axis=1) * BEYOND_OPEN_END_M
    own = ((beside < wide) & (beyond < long)).any(axis=1)
    return float((~own).sum() / len(points))


def _tall_veto(place: Placement, heights: HeightMap, magnet: Magnet, contact: Contact) -> list[Veto]:
    """Whether anything under the beam, or beside it within the tolerance, stands higher than its underside."""
    tolerance = magnet.tolerance
    long, wide = magnet.beam.length_m / 2, magnet.beam.width_m / 2
    grow = max(tolerance.x_m, tolerance.y_m) + math.radians(tolerance.yaw_deg) * long
    v, u = np.arange(-long - grow, long + grow, 0.02), np.arange(-wide - grow, wide + grow, 0.02)
    vv, uu = (a.ravel() for a in np.meshgrid(v, u))
    xy = np.array([place.x_m, place.y_m]) + vv[:, None] * place.along + uu[:, None] * place.across
    z = look_up(heights, xy[:, 0], xy[:, 1])
    under = contact.centre_z_m + vv * math.tan(contact.pitch_rad) + magnet.beam.above_faces_m
    rises = z - under
    if int((rises > 0).sum()) < TALL_CELLS:
        return []
    return [
        Veto("obstructed", f"something stands up to {1e3 * float(np.nanmax(rises)):.0f} mm above the beam's "
             "underside")
    ]  # fmt: skip


def _tolerance(
    place: Placement, yard: Yard, magnet: Magnet, near: BundleTable, held: Grip, needed_n: float,
    settings: LiftSettings,
) -> float:  # fmt: skip
    """The largest of SCALES times the crane's tolerance within which the lift stays as checked."""
    found = 0.0
    for scale in SCALES:
        box = Tolerance(
            min(magnet.tolerance.x_m * scale, 1.0), min(magnet.tolerance.y_m * scale, 1.0),
            min(magnet.tolerance.yaw_deg * scale, 20.0),
        )  # fmt: skip
        if not _stays(place, box, yard, magnet, near, held, needed_n, settings):
            break
        found = scale
    return found


def _stays(
    place: Placement, box: Tolerance, yard: Yard, magnet: Magnet, near: BundleTable, held: Grip,
    needed_n: float, settings: LiftSettings,
) -> bool:  # fmt: skip
    for dx, dy, dyaw in itertools.product((-1, 1), repeat=3):
        moved = replace(
            place, x_m=place.x_m + dx * box.x_m, y_m=place.y_m + dy * box.y_m,
            yaw_rad=place.yaw_rad + dyaw * math.radians(box.yaw_deg),
        )  # fmt: skip
        contact = touch(yard.heights, moved, magnet, settings.contact_gap_m)
        if contact is None or contact.unknown_share > settings.max_unknown_share:
            return False
        if _face_vetoes(contact, needed_n, magnet, settings):
            return False
        exact = grip(moved, magnet, Tolerance(0.0, 0.0, 0.0), near, contact.z_m)
        if exact.gripped != held.gripped:
            return False
    contact = touch(yard.heights, place, magnet, settings.contact_gap_m)
    assert contact is not None
    whole = grip(place, magnet, box, near, contact.z_m)
    return whole.probability >= settings.least_count_probability
