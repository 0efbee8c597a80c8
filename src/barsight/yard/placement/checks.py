"""Check a placement: the bundles counted under it, how the faces lie and pull, the load."""

from __future__ import annotations

import math
from functools import lru_cache
from statistics import NormalDist

import numpy as np

from barsight.core.arrays import Float32, Float64, UInt8, frozen, kernel
from barsight.yard.lift_settings import UPPER, LiftSettings
from barsight.yard.magnet.contact import Contact
from barsight.yard.magnet.description import Magnet
from barsight.yard.magnet.footprint import BEYOND_OPEN_END_M, BundleTable, Grip, Placement
from barsight.yard.magnet.holding import min_diameter_m
from barsight.yard.map_lookup import interpolate_height
from barsight.yard.placement.load import Load, reached_areas
from barsight.yard.types import ENDS, Bundle, HeightMap, known_sigma
from barsight.yard.vetoes import Check, check_max, check_min, check_true
from barsight.yard.weight import Mass

MARGIN_M = 0.015
"""Distance (m) by which a bundle's surface may show beyond its outline."""
STEP_M = 0.02
EDGE_M = 0.01
"""Width (m) over which outlines and reach are blurred, so that no row of samples switches all at once."""
UNKNOWN_SIGMA = 0.01
"""Standard deviation of the unseen share of a face, due to the size of the cells."""
MAX_HEIGHT_ERROR_M = 0.03
"""Maximum 95 % error (m) of the faces' height: with a larger one, a map says nothing about gaps. Simulated
yards have at most 15 mm.
"""
MAX_ASIDE_RATIO = 1 / 3
"""Maximum offset, in face widths, at which faces may rest beside their middle at the suspension's stop."""
SHOWN_BAR_M, MIN_SHOWN_RATIO = 0.08, 0.3
"""Minimum diameter (m) of bars whose crests a map shows. With thinner bars whose packing isn't settled, the
contact share is reduced in proportion to their diameter, down to the ratio. That is no bound: as little as a
tenth was seen in simulated yards.
"""
SURE_OF_SIGMA = 0.1
"""Relative standard deviation of the sigmas themselves."""


def count_checks(
    place: Placement, heights: HeightMap, magnet: Magnet, near: BundleTable, contact: Contact, held: Grip,
    settings: LiftSettings,
) -> list[Check]:  # fmt: skip
    """Check the bundles that the footprint takes: too many, too few, uncertain, unseen, unknown."""
    count, wanted = len(held.gripped), settings.bundles
    ids = ", ".join(str(near.bundles[k].id) for k in held.gripped)
    checks = [
        unknown_check(contact, settings),
        check_min(
            "no-bundle", "bundles under the poles within reach", count, 1, "",
            "no known bundle is within reach of the poles",
        ),
        check_max(
            "straddles-neighbour", "bundles that the magnet would take", count, wanted, "",
            f"the magnet would take {count} bundles ({ids}) instead of {wanted}",
        ),
    ]  # fmt: skip
    if 0 < count < wanted:
        reason = f"the magnet would take {count} of the {wanted} requested bundles"
        checks.append(
            check_min("count-uncertain", "bundles that the magnet would take", count, wanted, "", reason)
        )
    elif near.bundles:
        why = f"; it is uncertain whether bundle {near.bundles[int(np.argmax(held.flips))].id} is taken"
        checks.append(probability_check(held.probability, count, settings, why))
    shares = _unexplained(place, heights, magnet, near, contact, held)
    checks.append(
        check_max(
            "unexplained-surface", "share of the surface within reach outside known bundles", shares[0],
            settings.max_unexplained_ratio, "", f"{100 * shares[1]:.0f} % of the surface within reach of "
            "the poles belongs to no known bundle", sigma=shares[1] - shares[0],
        )
    )  # fmt: skip
    return checks


def unknown_check(contact: Contact, settings: LiftSettings) -> Check:
    """Check that the unseen share under each pole isn't too large."""
    share, most = contact.unknown_share, settings.max_unknown_ratio
    reason = f"{100 * share:.0f} % of the cells under a pole were not seen; the limit is {100 * most:.0f} %"
    what = "share of unseen cells under the worst pole"
    return check_max("unknown-under-footprint", what, share, most, "", reason, sigma=UNKNOWN_SIGMA)


def probability_check(probability: float, count: int, settings: LiftSettings, why: str = "") -> Check:
    """Check that a count is certain enough, in sigmas of the normal distribution."""
    sure, asked = (
        NormalDist().inv_cdf(min(max(p, 1e-12), 1 - 1e-12))
        for p in (probability, settings.min_count_probability)
    )
    taken = "1 bundle is" if count == 1 else f"{count} bundles are"
    reason = f"the probability that exactly {taken} taken is only {probability:.4f}{why}"
    bound = asked / (1 + SURE_OF_SIGMA)
    return check_min(
        "count-uncertain",
        "probability of the count, as a normal quantile",
        sure,
        bound,
        "sigma",
        reason,
        sigma=SURE_OF_SIGMA * bound,
    )


def area_checks(
    place: Placement, magnet: Magnet, load: tuple[Bundle, ...], settings: LiftSettings
) -> list[Check]:
    """Check that magnet and load avoid no-lift areas, including the crane's tolerance and bundles' sigmas."""
    outlines = [(np.array([place.x_m, place.y_m]), place.yaw_rad, magnet.size_m)]
    for bundle in load:
        one, own = Load.of((bundle,)), bundle.sigma
        wide, long = (2 * UPPER * known_sigma(part) for part in (own.lateral_m, own.along_m))
        size = one.width_m + wide, one.length_m + long
        outlines.append((np.array([one.x_m, one.y_m]), one.yaw_rad, size))
    reached = [area for one in outlines for area in reached_areas(*one, magnet.tolerance, settings)]
    what = "magnet and load stay outside the no-lift areas"
    return [
        check_true(
            "no-lift-area", what, area not in reached, "the magnet or the load enters the no-lift area from "
            f"{area[0]:g}, {area[1]:g} to {area[2]:g}, {area[3]:g} m",
        )
        for area in settings.no_lift_areas
    ]  # fmt: skip


def face_checks(
    contact: Contact, needed_n: float, magnet: Magnet, load: tuple[Bundle, ...], settings: LiftSettings
) -> list[Check]:
    """Check how the faces lie on the load, and how strongly they pull."""
    limits, sigma = magnet.limits, contact.gap_sigma_m
    pitch, roll = (abs(math.degrees(angle)) for angle in (contact.pitch_rad, contact.roll_rad))
    narrowest = min(pole.width_m for pole in magnet.poles)
    gap, near_m, shown = contact.widest_gap_m, settings.contact_gap_m, _shown_ratio(load)
    if contact.plate_m.size:
        # On a plate no thin bar carries the faces alone, but the margin to the limit is small.
        near_m, shown = near_m - settings.strap_m - UPPER * sigma, 1.0
    low, high = _contact_shares(contact, (near_m, near_m + sigma)) * shown
    held = roll >= (1 - 1e-3) * limits.roll_deg
    aside = (
        f"the faces would touch {1e3 * contact.rests_off_m:.0f} mm beside their middle, tilted by "
        f"{'more than' if held else 'nearly'} the {limits.roll_deg:g} deg that the suspension allows"
    )
    if not held:
        aside += "; the tilt is within its sigma of the limit"
    needed = (
        f"{needed_n / 1e3:.1f} kN are needed"
        if math.isfinite(needed_n)
        else "the weight of the load is unknown"
    )
    return [
        check_max(
            "tilt", "slope of the faces along the beam", pitch, limits.pitch_deg, "deg",
            f"the faces slope by {pitch:.1f} deg along the beam; the limit is {limits.pitch_deg:g} deg",
            sigma=math.degrees(sigma / magnet.half_span_m),
        ),
        check_max(
            "tilt", "distance from the faces' middle to where they touch, at the suspension's limit of tilt",
            1e3 * contact.rests_off_m, 1e3 * MAX_ASIDE_RATIO * narrowest, "mm", aside,
            sigma=0.0 if contact.rests_off_m == 0 else 1e3 * EDGE_M / 2,
        ),
        check_max(
            "gap", "smallest gap under the pole that is furthest from the steel",
            1e3 * gap if math.isfinite(gap) else math.nan, 1e3 * limits.gap_m, "mm",
            f"a pole is {1e3 * gap:.0f} mm above the steel; the limit is {1e3 * limits.gap_m:.0f} mm"
            if math.isfinite(gap) else "no steel is known under one of the poles", sigma=1e3 * sigma,
        ),
        check_max(
            "gap", "uncertainty of the height under the faces (95 %)", 1e3 * UPPER * contact.sigma_m,
            1e3 * MAX_HEIGHT_ERROR_M, "mm", "the height under the faces is uncertain by "
            f"{1e3 * UPPER * contact.sigma_m:.0f} mm (95 %); the limit is {1e3 * MAX_HEIGHT_ERROR_M:.0f} mm",
        ),
        check_min(
            "gap", "share of the faces in contact with steel", high, limits.contact_share, "",
            f"only {100 * high:.0f} % of the faces count as in contact with steel; "
            f"{100 * limits.contact_share:.0f} % are needed", sigma=high - low,
        ),
        check_min(
            "weak-pull", "pull on the load", contact.pull_n, needed_n, "N",
            f"the lower bound of the pull is {contact.pull_low_n / 1e3:.1f} kN; {needed}",
            sigma=(contact.pull_n - contact.pull_low_n) / UPPER, sigmas=UPPER,
        ),
    ]  # fmt: skip


def load_checks(
    load: tuple[Bundle, ...], mass: Mass, offset_m: tuple[float, float], overhang_m: tuple[float, float],
    magnet: Magnet, settings: LiftSettings,
) -> list[Check]:  # fmt: skip
    """Check whether the load is covered, doubtful, open at an end, too heavy or off balance.

    offset_m: along and across. overhang_m: value and sigma.
    """
    if not load:
        return []
    checks = [check for bundle in load for check in _bundle_checks(bundle, settings)]
    known = not math.isnan(mass.kg)
    reason = "the number or the diameter of the bars is unknown"
    checks.append(check_true("mass-unknown", "mass of the load", known or None, reason))
    for carrier, most in (
        ("magnet", magnet.capacity_kg),
        ("crane beside the magnet", magnet.crane_capacity_kg - magnet.own_mass_kg),
    ):
        if known:
            reason = f"the load may weigh {mass.upper_kg:.0f} kg; the {carrier} carries {most:.0f} kg"
            checks.append(
                check_max("overweight", f"mass of the load against the capacity of the {carrier}", mass.kg,
                           most,
                           "kg", reason, sigma=mass.sigma_kg, sigmas=UPPER)
            )  # fmt: skip
    limits = magnet.limits
    for name, offset, most, sigma in (
        ("along", offset_m[0], limits.offset_along_m, max(known_sigma(b.sigma.along_m) for b in load)),
        ("across", offset_m[1], limits.offset_across_m, max(known_sigma(b.sigma.lateral_m) for b in load)),
    ):
        reason = (
            f"the magnet's centre is {1e3 * abs(offset):.0f} mm {name} the bars from the load's centre; "
            f"the limit is {1e3 * most:.0f} mm"
        )
        what = f"distance {name} the bars between the centres of magnet and load"
        checks.append(
            check_max("off-centre", what, 1e3 * abs(offset), 1e3 * most, "mm", reason, sigma=1e3 * sigma)
        )
    upper = overhang_m[0] + UPPER * overhang_m[1]
    reason = f"the bars extend {upper:.2f} m beyond the outermost pole; the limit is {limits.overhang_m:g} m"
    checks.append(
        check_max("overhang", "length of the bars beyond the outermost pole", overhang_m[0],
                   limits.overhang_m, "m", reason, sigma=overhang_m[1], sigmas=UPPER)
    )  # fmt: skip
    return checks


def _bundle_checks(bundle: Bundle, settings: LiftSettings) -> list[Check]:
    covered = bundle.on_top is False
    what = f"{'something lies' if covered else 'something may lie'} on bundle {bundle.id}"
    if bundle.on_top and bundle.cover_doubts:
        what += f": {bundle.cover_doubts[0].sentence}"
    ends = " and ".join(e for e, o in zip(ENDS, bundle.ends_open, strict=True) if o)
    return [
        check_true(
            "covered", f"nothing lies on bundle {bundle.id}",
            True if bundle.is_free else False if covered else None, what,
        ),
        check_min(
            "bundle-doubtful", f"confidence of bundle {bundle.id}", bundle.confidence,
            settings.min_confidence, "",
            f"the confidence of bundle {bundle.id} is {100 * bundle.confidence:.0f} %: "
            + ("; ".join(doubt.sentence for doubt in bundle.reasons) or "no reason is given"),
        ),
        check_true(
            "end-open", f"both ends of bundle {bundle.id} were seen", None if ends else True,
            f"the {ends} end of bundle {bundle.id} was not seen, so its length, mass and balance are unknown",
        ),
    ]  # fmt: skip


def _shown_ratio(load: tuple[Bundle, ...]) -> float:
    """Return the factor on the contact share: crests of thin bars don't show in a map, and a bar that lies
    higher than the others carries the faces alone.
    """
    bars_m = [min_diameter_m(bundle) for bundle in load if bundle.bars is None]
    return float(np.clip(np.min([SHOWN_BAR_M, *bars_m]) / SHOWN_BAR_M, MIN_SHOWN_RATIO, 1.0))


def _contact_shares(contact: Contact, near_m: tuple[float, float]) -> Float64:
    """Compute the share of all faces that is nearer to steel than each of `near_m`, with gaps blurred by half
    a millimetre and all poles weighted equally.
    """
    blur = 0.0005
    gaps = np.concatenate([pole.gap_map_m.ravel() for pole in contact.poles])
    weights = np.concatenate([np.full(p.gap_map_m.size, 1 / p.gap_map_m.size) for p in contact.poles])
    near = np.clip((np.array(near_m)[:, None] - gaps) / blur + 0.5, 0, 1)
    return np.asarray(np.where(np.isnan(gaps), 0, near) @ weights / len(contact.poles))


@lru_cache(maxsize=64)
def _face_grid(magnet: Magnet, wider_mm: int) -> Float64:
    """Sample places (N, 3), along, across and pole, over the faces, each one widened to either side."""
    points = []
    for number, pole in enumerate(magnet.poles):
        long, wide = pole.length_m / 2, pole.width_m / 2 + wider_mm / 1e3
        v = np.linspace(-long, long, max(int(long / STEP_M), 2)) + pole.along_m
        u = np.linspace(-wide, wide, max(int(2 * wide / STEP_M), 2)) + pole.across_m
        vv, uu = (a.ravel() for a in np.meshgrid(v, u))
        points.append(np.column_stack([vv, uu, np.full(len(vv), number)]))
    return frozen(np.concatenate(points))


def _unexplained(
    place: Placement, heights: HeightMap, magnet: Magnet, near: BundleTable, contact: Contact, held: Grip
) -> tuple[float, float]:
    """Compute the share of the places under the poles, within reach, that lie outside all bundles' outlines,
    widened by two sigmas and by one.

    Surface in the load's wider margin may belong to another object, so places that far beyond the face are
    sampled too.
    """
    across = magnet.tolerance.along(place.across)
    outlines = np.empty((len(near.bundles), 8))
    rectangles = near.rectangles
    outlines[:, :2], outlines[:, 2:4] = rectangles.centre, rectangles.along
    open_m = rectangles.open_ends.any(axis=1) * BEYOND_OPEN_END_M
    spread = np.hypot(rectangles.sigma[:, :2], rectangles.sigma[:, 3:])
    margin = MARGIN_M + 2.0 * float(spread[list(held.gripped), 0].max(initial=0.0))
    for first, sigmas in ((4, 2.0), (6, 1.0)):
        wider = MARGIN_M + sigmas * spread
        outlines[:, first : first + 2] = rectangles.half + wider
        outlines[:, first + 1] += open_m
    return _stray_shares(
        heights.z_m, heights.source, np.array([heights.x0_m, heights.y0_m, heights.cell_m]),
        place.frame,
        _face_grid(magnet, math.ceil(1e3 * (float(across) + margin))), contact.map_z_m - magnet.reach_m,
        outlines,
    )  # fmt: skip


@kernel()
def _stray_shares(
    z: Float32, source: UInt8, at: Float64, frame: Float64, grid: Float64, reach_z: Float64, outlines: Float64
) -> tuple[float, float]:
    """Compute the shares of places within reach that lie outside the wider and the narrower outlines.

    z, source: maps (rows, columns). at: x and y of the first cell, and its size. frame: (3, 2) the magnet's
    place, unit vectors along and across. grid: (N, 3) along, across and pole. reach_z: (P,) minimum height
    that each pole reaches. outlines: (B, 8) centre, unit vector along, half width and length of both forms.
    """
    wider, narrower = 0.0, 0.0
    for n in range(len(grid)):
        x = frame[0, 0] + grid[n, 0] * frame[1, 0] + grid[n, 1] * frame[2, 0]
        y = frame[0, 1] + grid[n, 0] * frame[1, 1] + grid[n, 1] * frame[2, 1]
        height = interpolate_height(z, source, (x - at[0]) / at[2], (y - at[1]) / at[2])
        if np.isnan(height):
            continue
        reached = min(max((height - reach_z[int(grid[n, 2])]) / EDGE_M + 0.5, 0.0), 1.0)
        if reached == 0:
            continue
        out_of_wider, out_of_narrower = np.inf, np.inf
        for own in outlines:
            dx, dy = x - own[0], y - own[1]
            beside, beyond = abs(dx * own[3] - dy * own[2]), abs(dx * own[2] + dy * own[3])
            out_of_wider = min(out_of_wider, max(beside - own[4], beyond - own[5]))
            out_of_narrower = min(out_of_narrower, max(beside - own[6], beyond - own[7]))
        wider += reached * min(max(out_of_wider / EDGE_M + 0.5, 0.0), 1.0)
        narrower += reached * min(max(out_of_narrower / EDGE_M + 0.5, 0.0), 1.0)
    return wider / len(grid), narrower / len(grid)
