"""Compute how a load is held: what each face pulls on its bars, and what each pole must carry by its moments.

A map is a smoothed mean, and pull is a convex function of the gap that falls as the gap widens: so the sum
over the smoothed surface is no more than that over the steel, provided that the faces' plane isn't too low
[Jensen's inequality]. The lower bound therefore takes the plane as high as it may be: on the bars' crests
that smoothing has cut off, on a strap, and with the noise added.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np

from barsight.core.arrays import Bool, Float64, frozen, kernel
from barsight.yard.lift_settings import UPPER
from barsight.yard.magnet.contact import NEWTON_PER_KG, Contact, PoleContact
from barsight.yard.magnet.description import Magnet, Pole
from barsight.yard.magnet.footprint import Placement
from barsight.yard.types import UNKNOWN_SIGMA_M, Bundle
from barsight.yard.vetoes import Check, check_min
from barsight.yard.weight import bundle_mass, load_centre

SMOOTHING_M = 0.016
"""Upper bound of the standard deviation (m) of a map's smoothing across the bars."""
MAX_CUT_RATIO = 0.12
"""Maximum height of a bar's crest over the mean of it and its neighbours, as a fraction of the diameter."""

MIN_DIAMETER_RATIO = 0.1
"""Minimum lower bound of a diameter, as a fraction: some twenty thin bars have been read as one thick bar."""


def hold_load(contact: Contact, magnet: Magnet, load: tuple[Bundle, ...], strap_m: float) -> Contact:
    """Lay the faces on the load where it is likely to be, over_map_m higher than the map shows, and add the
    pull on its bars. Without a load the contact stays as it is.

    strap_m: thickness of a strap, which may hold the faces off.
    """
    if not load:
        return contact
    higher, sigma, held = *over_map_m(load, strap_m), _pulled(contact, magnet, load, strap_m)
    return replace(
        held, centre_z_m=held.centre_z_m + higher, z_m=held.z_m + higher, over_map_m=higher,
        over_map_sigma_m=sigma, sigma_m=math.hypot(held.sigma_m, sigma),
        poles=tuple(replace(own, z_m=own.z_m + higher) for own in held.poles),
    )  # fmt: skip


def over_map_m(load: tuple[Bundle, ...], strap_m: float) -> tuple[float, float]:
    """Estimate how much higher (m) than a map shows faces lie on a load, and the sigma: by half of what may
    be cut off its crests, and by a strap; either may be missing. Crests of bars of unknown diameter count as
    shown.
    """
    if not load:
        return 0.0, 0.0
    cut = float(np.nan_to_num(_max_cut_m(load)[1]))
    return cut / 2 + strap_m, math.hypot(cut, strap_m) / math.sqrt(12)


def _pulled(contact: Contact, magnet: Magnet, load: tuple[Bundle, ...], strap_m: float) -> Contact:
    """Add the pull on the bars of a load of at least one bundle."""
    diameter, cut = _max_cut_m(load)
    higher = cut + strap_m + UPPER * contact.gap_sigma_m
    return replace(
        contact,
        poles=tuple(
            _pull(own, pole, magnet, diameter, cut / 2, higher)
            for own, pole in zip(contact.poles, magnet.poles, strict=True)
        ),
    )


def _max_cut_m(load: tuple[Bundle, ...]) -> tuple[float, float]:
    """Compute the minimum diameter (m) of a load's bars, and how much (m) may be cut off their crests."""
    diameter = min(min_diameter_m(bundle) for bundle in load)
    return diameter, min(SMOOTHING_M**2 / diameter, MAX_CUT_RATIO * diameter)


def _pull(
    own: PoleContact, pole: Pole, magnet: Magnet, diameter_m: float, likely_m: float, higher_m: float
) -> PoleContact:
    """Sum the pull over a face whose plane is likely_m, and at most higher_m, higher than over the map."""
    likely, low = magnet.pull.on_bars(diameter_m, min(pole.length_m, pole.width_m))
    sums = _sum_pull(own.gap_map_m, np.array(magnet.pull.gap_m), likely, low, likely_m, higher_m)
    newton = 1e3 * pole.length_m * pole.width_m / own.gap_map_m.size
    across, along = (moment / sums[1] if sums[1] > 0 else 0.0 for moment in sums[2:])
    return replace(
        own, pull_n=newton * sums[0], pull_low_n=newton * sums[1],
        pull_across_m=pole.width_m * across, pull_along_m=pole.length_m * along,
    )  # fmt: skip


@kernel()
def _sum_pull(
    gaps: Float64, gap_m: Float64, likely: Float64, low: Float64, likely_m: float, higher_m: float
) -> tuple[float, float, float, float]:
    """Sum a face's pull (kPa) over its cells: the likely value, its lower bound, and the moments of that
    bound about the face's middle, across divided by the width and along by the length.

    gaps: (across, along) air gaps, m, NaN where unknown: nothing pulls there. likely, low: kPa at gap_m.
    likely_m, higher_m: likely and maximum amounts by which the gaps are wider. gap_m, likely, low: (N,).
    """
    total, least, across, along = 0.0, 0.0, 0.0, 0.0
    for i in range(gaps.shape[0]):
        place = (i + 0.5) / gaps.shape[0] - 0.5
        for k in range(gaps.shape[1]):
            if np.isnan(gaps[i, k]):
                continue
            total += _between(gaps[i, k] + likely_m, gap_m, likely)
            held = _between(gaps[i, k] + higher_m, gap_m, low)
            least += held
            across += place * held
            along += ((k + 0.5) / gaps.shape[1] - 0.5) * held
    return total, least, across, along


@kernel()
def _between(gap: float, gap_m: Float64, curve: Float64) -> float:
    """Interpolate a curve over gap_m at a gap; 0 beyond its end.

    gap: m. gap_m: (N,) m, ascending; curve: (N,).
    """
    for k in range(gap_m.size - 1):
        if gap <= gap_m[k + 1]:
            part = (gap - gap_m[k]) / (gap_m[k + 1] - gap_m[k])
            return float(curve[k] + part * (curve[k + 1] - curve[k]))
    return 0.0


def min_diameter_m(bundle: Bundle) -> float:
    """Compute the lower bound (m) of the diameter of a bundle's bars."""
    diameter = bundle.bar_diameter_m
    return float(np.fmax(diameter - UPPER * bundle.sigma.bar_diameter_m, MIN_DIAMETER_RATIO * diameter))


def pole_shares(magnet: Magnet, place: Placement, load: tuple[Bundle, ...]) -> Float64:
    """Compute upper bounds of the poles' shares (P,) of the needed pull; 1 is all of it.

    Magnet and load are rigid, so a pole's share grows linearly with the load's offset from the middle of all
    poles towards it. The offset is an upper bound by the sigmas of the load's centre.
    """
    away, slack = _off_centre(place, load)
    middle, slope = _levers(magnet.poles)
    return np.asarray(1 / len(slope) + slope @ (away - middle) + np.abs(slope) @ slack)


def _off_centre(place: Placement, load: tuple[Bundle, ...]) -> tuple[Float64, Float64]:
    """Compute the load's centre of mass (2,) from the magnet's, along and across, and the error's bound."""
    sigmas = [(bundle.sigma.along_m, bundle.sigma.lateral_m) for bundle in load]
    away = place.beam_axes @ (load_centre(load) - (place.x_m, place.y_m))
    return away, UPPER * np.nan_to_num(sigmas, nan=UNKNOWN_SIGMA_M).max(axis=0)


@lru_cache(maxsize=64)
def _levers(poles: tuple[Pole, ...]) -> tuple[Float64, Float64]:
    """Compute the poles' middle (2,), along and across, and how each one's share (P, 2) grows with the load's
    offset from it.

    Where the poles stand closer to one line than 0.3 of their faces' width, the faces themselves are the
    longer lever: they carry most of the moment by pressing on one side, which `pried_ratio` judges.
    """
    places = np.array([(pole.along_m, pole.across_m) for pole in poles])
    faces = np.array([(pole.length_m, pole.width_m) for pole in poles])
    middle = places.mean(axis=0)
    arms = places - middle
    spread, axes = np.linalg.eigh(arms.T @ arms)
    spread = np.maximum(spread, (faces**2).sum(axis=0) / 12 @ axes**2)
    return frozen(middle), frozen(arms @ axes / spread @ axes.T)


def pried_ratio(
    contact: Contact, needed_n: float, magnet: Magnet, place: Placement, load: tuple[Bundle, ...]
) -> float:
    """Compute the moment of the pull over that of the load, each about the edge of what the faces touch, for
    the worst edge; infinite where the load pries the faces off no edge.

    Magnet and load are rigid: a load that hangs beside the pull turns about the outermost steel on the other
    side that the faces touch. The safety factor may be used up for this, but no more.
    """
    weight_n = needed_n / magnet.needed_factor
    touched = _touched(contact, magnet)
    if not touched.size or not weight_n > 0:
        return 0.0
    away, slack = _off_centre(place, load)
    pulls = np.array([own.pull_low_n for own in contact.poles])
    at = np.array([
        (pole.along_m + own.pull_along_m, pole.across_m + own.pull_across_m)
        for own, pole in zip(contact.poles, magnet.poles, strict=True)
    ])  # fmt: skip
    edges = np.roll(touched, -1, axis=0) - touched
    inwards = np.column_stack([-edges[:, 1], edges[:, 0]])
    inwards *= np.sign((inwards * (touched.mean(axis=0) - touched)).sum(axis=1))[:, None]
    held = ((inwards[:, None] * (at - touched[:, None])).sum(axis=2) * pulls).sum(axis=1)
    turning = (inwards * (away - touched)).sum(axis=1) + np.abs(inwards) @ slack
    prying = turning > 0
    return float(np.min(held[prying] / (weight_n * turning[prying]), initial=math.inf))


def _touched(contact: Contact, magnet: Magnet) -> Float64:
    """Return the corners (N, 2), along and across, in order, of the area between all places where the faces
    touch; none where they touch nothing.
    """
    corners = [(float(v), float(u)) for v, u in contact.plate_m]
    for own, pole in zip(contact.poles, magnet.poles, strict=True):
        touches = own.gap_map_m <= contact.touch_gap_m
        if touches.any():
            columns, parts = (np.flatnonzero(touches.any(axis=axis)) for axis in (1, 0))
            v, u = (
                middle + size * (np.array([cells[0], cells[-1] + 1]) / count - 0.5)
                for middle, size, cells, count in (
                    (pole.along_m, pole.length_m, parts, touches.shape[1]),
                    (pole.across_m, pole.width_m, columns, touches.shape[0]),
                )
            )
            corners += itertools.product(v, u)
    hull = cv2.convexHull(np.array(corners, np.float32)) if corners else np.empty(0)
    return np.asarray(hull.reshape(-1, 2), np.float64)


@dataclass(frozen=True)
class WeakestPole:
    """The pole whose pull, as a lower bound, is smallest relative to its needed share. number: from 1."""

    number: int
    pull_low_n: float
    share_n: float

    @property
    def ratio(self) -> float:
        """Return the ratio of its pull to its share."""
        return self.pull_low_n / self.share_n


def weakest_pole(
    contact: Contact, needed_n: float, magnet: Magnet, place: Placement, load: tuple[Bundle, ...]
) -> WeakestPole | None:
    """Find the pole with the smallest ratio of pull to share; None where no load, or no weight, is known."""
    if not load or not needed_n > 0:
        return None
    shares = np.maximum(pole_shares(magnet, place, load), 1e-3) * needed_n
    pulls = np.array([own.pull_low_n for own in contact.poles])
    worst = int(np.argmin(pulls / shares))
    return WeakestPole(worst + 1, float(pulls[worst]), float(shares[worst]))


def weakest_bundle(
    contact: Contact, magnet: Magnet, place: Placement, load: tuple[Bundle, ...], strap_m: float
) -> float:
    """Compute for each of several bundles the ratio of the pull's lower bound to what its weight needs, and
    how it pries itself off (`pried_ratio`); return the minimum. Infinite where one or none is taken, NaN
    where a weight isn't known.

    Only the cells of a face that certainly lie over a bundle's outline pull and touch it, and so does a
    plate.
    """
    if len(load) < 2:
        return math.inf
    ratios = []
    for bundle in load:
        poles = tuple(
            replace(own, gap_map_m=np.where(_over(bundle, pole, place, own), own.gap_map_m, np.nan))
            for own, pole in zip(contact.poles, magnet.poles, strict=True)
        )
        plate_m = contact.plate_m[_contains(bundle, contact.plate_m, place)]
        held = _pulled(replace(contact, poles=poles, plate_m=plate_m), magnet, (bundle,), strap_m)
        needed_n = bundle_mass(bundle).upper_kg * NEWTON_PER_KG * magnet.needed_factor
        if not needed_n > 0:
            return math.nan
        ratios += [held.pull_low_n / needed_n, pried_ratio(held, needed_n, magnet, place, (bundle,))]
    return float(np.min(ratios))


def _over(bundle: Bundle, pole: Pole, place: Placement, own: PoleContact) -> Bool:
    """Mark the cells (across, along) of a face that certainly lie over a bundle's outline."""
    shape = own.gap_map_m.shape
    u = pole.across_m + pole.width_m * ((np.arange(shape[0]) + 0.5) / shape[0] - 0.5)
    v = pole.along_m + pole.length_m * ((np.arange(shape[1]) + 0.5) / shape[1] - 0.5)
    return _contains(bundle, np.stack(np.broadcast_arrays(v, u[:, None]), axis=-1), place)


def _contains(bundle: Bundle, grid_m: Float64, place: Placement) -> Bool:
    """Mark the places (..., 2), along and across the beam, that certainly lie over a bundle's outline."""
    at = grid_m @ place.beam_axes + (place.x_m, place.y_m) - bundle.centre_m[:2]
    sigma, (across, along) = bundle.sigma, bundle.axes
    sigmas = np.array([(sigma.lateral_m, sigma.width_m / 2), (sigma.along_m, sigma.length_m / 2)])
    half = np.array([bundle.width_m, bundle.length_m]) / 2
    half = half - UPPER * np.hypot(*np.nan_to_num(sigmas, nan=UNKNOWN_SIGMA_M).T)
    return np.asarray((np.abs(at @ across) <= half[0]) & (np.abs(at @ along) <= half[1]))


def share_checks(weakest: WeakestPole | None, pried: float, worst_bundle: float = math.inf) -> list[Check]:
    """Check that the weakest pole carries its share, that the load pries off no face (`pried_ratio`), and
    that each of several bundles is held (`weakest_bundle`).
    """
    if weakest is None:
        return []
    pull, share = weakest.pull_low_n / 1e3, weakest.share_n / 1e3
    checks = [
        check_min(
            "weak-pull", "lower bound of the worst pole's pull, relative to its share", weakest.ratio, 1.0,
            "", f"the lower bound of pole {weakest.number}'s pull is {pull:.1f} kN; its share of the "
            f"load needs {share:.1f} kN",
        ),
        check_min(
            "weak-pull", "moment of the pull about the edge of what the faces touch, relative to the load's",
            pried, 1.0, "", "the load may pry the faces off: the moment of the pull about the edge of what "
            f"they touch is {pried:.2f} of the load's",
        ),
    ]  # fmt: skip
    if worst_bundle < math.inf or math.isnan(worst_bundle):
        what = "lower bound of the pull on the worst bundle, in all or about an edge, relative to its need"
        reason = (
            "the lower bound of the pull on one of the bundles, in all or about the edge of what the faces "
            f"touch of it, is {worst_bundle:.2f} of what it needs"
        )
        checks.append(check_min("weak-pull", what, worst_bundle, 1.0, "", reason))
    return checks
