"""Check a placement for vetoes: the count under it, how the faces lie, the load, what stands around."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from barsight.core.arrays import Float64, frozen
from barsight.yard.lift_settings import LiftSettings
from barsight.yard.lifting.contact import Contact
from barsight.yard.lifting.footprint import BEYOND_OPEN_END_M, BundleTable, Grip, Placement
from barsight.yard.lifting.magnet import Magnet
from barsight.yard.stability.stability import lookup_heights
from barsight.yard.types import Bundle, HeightMap
from barsight.yard.vetoes import Veto
from barsight.yard.weight import Mass

MARGIN_M = 0.02
"""How far beyond its stated outline a bundle may show."""
STEP_M = 0.02


def count_vetoes(
    place: Placement, heights: HeightMap, magnet: Magnet, near: BundleTable, contact: Contact, held: Grip,
    settings: LiftSettings,
) -> list[Veto]:  # fmt: skip
    """Check what the footprint takes: too much, too little, unsure, unseen, unknown."""
    vetoes = []
    count = len(held.gripped)
    ids = ", ".join(str(near.bundles[k].id) for k in held.gripped)
    if contact.unknown_share > settings.max_unknown_ratio:
        vetoes.append(
            Veto("unknown-under-footprint", f"{100 * contact.unknown_share:.0f} % of the cells under a pole "
                 f"were not seen, {100 * settings.max_unknown_ratio:.0f} % are allowed")
        )  # fmt: skip
    if count == 0:
        vetoes.append(Veto("no-bundle", "no known bundle lies under the poles within reach"))
    if count > settings.bundles:
        vetoes.append(
            Veto(
                "straddles-neighbour", f"the footprint takes {count} bundles ({ids}), not {settings.bundles}"
            )
        )
    if count < settings.bundles and count:
        vetoes.append(
            Veto("count-uncertain", f"the footprint takes {count} bundles, {settings.bundles} are asked for")
        )
    elif held.probability < settings.min_count_probability:
        worst = near.bundles[int(np.argmax(held.flips))].id
        vetoes.append(
            Veto("count-uncertain", f"a count of {count} has the probability {held.probability:.4f} only: "
                 f"bundle {worst} may be in or out")
        )  # fmt: skip
    share = _unexplained(place, heights, magnet, near, contact)
    if share > settings.max_unexplained_ratio:
        vetoes.append(
            Veto("unexplained-surface", f"{100 * share:.0f} % of what lies within reach of the poles "
                 f"belongs to no known bundle")
        )  # fmt: skip
    return vetoes


def face_vetoes(contact: Contact, needed_n: float, magnet: Magnet, settings: LiftSettings) -> list[Veto]:
    """Check how the faces lie and pull."""
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
    if math.isinf(contact.widest_gap_m):
        vetoes.append(Veto("gap", "under one of the poles no steel is known"))
    elif contact.widest_gap_m > magnet.limits.gap_m:
        vetoes.append(
            Veto("gap", f"a pole hangs {1e3 * contact.widest_gap_m:.0f} mm above the steel, "
                 f"{1e3 * magnet.limits.gap_m:.0f} mm are allowed")
        )  # fmt: skip
    elif contact.contact_share < magnet.limits.contact_share:
        vetoes.append(
            Veto("gap", f"only {100 * contact.contact_share:.0f} % of the faces lie on steel, "
                 f"{100 * magnet.limits.contact_share:.0f} % are needed")
        )  # fmt: skip
    if contact.pull_low_n < needed_n:
        vetoes.append(
            Veto("weak-pull", f"the pull is at least {contact.pull_low_n / 1e3:.1f} kN, "
                 f"{needed_n / 1e3:.1f} kN are needed")
        )  # fmt: skip
    return vetoes


def load_vetoes(
    load: tuple[Bundle, ...], mass: Mass, along: float, across: float, overhang: float, magnet: Magnet,
    settings: LiftSettings,
) -> list[Veto]:  # fmt: skip
    """Check the load: covered, doubtful, open, heavy, off balance."""
    vetoes = []
    limits = magnet.limits
    for bundle in load:
        if bundle.on_top is not True:
            what = "something lies on" if bundle.on_top is False else "it isn't known what lies on"
            vetoes.append(Veto("covered", f"{what} bundle {bundle.id}"))
        if bundle.confidence < settings.min_confidence:
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
                Veto(
                    "overweight",
                    f"the load may weigh {mass.upper_kg:.0f} kg, the {carrier} carries {most:.0f}",
                )
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


@lru_cache(maxsize=64)
def _face_grid(magnet: Magnet, wider_mm: int) -> Float64:
    """Sample places (N, 3), along, across and pole, over the faces, made wider to either side."""
    points = []
    for number, pole in enumerate(magnet.poles):
        long, wide = pole.length_m / 2, pole.width_m / 2 + wider_mm / 1e3
        v = np.linspace(-long, long, max(int(long / STEP_M), 2)) + pole.along_m
        u = np.linspace(-wide, wide, max(int(2 * wide / STEP_M), 2)) + pole.across_m
        vv, uu = (a.ravel() for a in np.meshgrid(v, u))
        points.append(np.column_stack([vv, uu, np.full(len(vv), number)]))
    return frozen(np.concatenate(points))


def _in_yard(place: Placement, grid: Float64) -> Float64:
    """Convert places given along and across the beam to x and y (N, 2)."""
    return np.array([place.x_m, place.y_m]) + grid[:, :1] * place.along + grid[:, 1:2] * place.across


def _unexplained(
    place: Placement, heights: HeightMap, magnet: Magnet, near: BundleTable, contact: Contact
) -> float:
    """Compute the fraction of the places under the poles, within reach, that lie outside all bundles'
    outlines.
    """
    across = abs(place.across) @ (magnet.tolerance.x_m, magnet.tolerance.y_m)
    grid = _face_grid(magnet, round(1e3 * float(across)))
    points = _in_yard(place, grid)
    z = lookup_heights(heights, points[:, 0], points[:, 1])
    reached = z > contact.z_m[grid[:, 2].astype(np.int64)] - magnet.reach_m
    if not reached.any():
        return 0.0
    away = points[reached, None, :] - near.centre
    beside = np.abs(away[..., 0] * near.along[:, 1] - away[..., 1] * near.along[:, 0])
    beyond = np.abs((away * near.along).sum(axis=-1))
    wide = near.half[:, 0] + MARGIN_M + 2 * np.hypot(near.sigma[:, 0], near.sigma[:, 3])
    long = near.half[:, 1] + MARGIN_M + 2 * np.hypot(near.sigma[:, 1], near.sigma[:, 4])
    long = long + near.open_ends.any(axis=1) * BEYOND_OPEN_END_M
    own = ((beside < wide) & (beyond < long)).any(axis=1)
    return float((~own).sum() / len(points))
