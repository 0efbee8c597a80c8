"""Describe the load on the magnet: as a box, outline and height of one bundle or several, and by its top,
which must lie at the faces.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from barsight.core.arrays import Float64
from barsight.yard.axes import axes_of
from barsight.yard.lift_settings import UPPER, LiftSettings
from barsight.yard.magnet.contact import Contact
from barsight.yard.magnet.description import Magnet, Tolerance
from barsight.yard.magnet.footprint import Placement
from barsight.yard.magnet.holding import min_diameter_m
from barsight.yard.stability.stability import mean_yaw
from barsight.yard.types import Bundle, known_sigma
from barsight.yard.vetoes import Check, check_max
from barsight.yard.weight import load_centre

MAX_ABOVE_TOP_M = 0.012
"""Maximum height (m), as a lower bound, of a face above the load's top."""
MAX_TOP_RISE_M = 0.015
"""Maximum height (m), as a 95 % bound, of the load's own fitted top above the stated plane where that is
lowest over it.
"""
_ONE_BAR, _TWO_BARS = 1.5, 1.75
"""Maximum width of what may be a single bar, in diameters: of any bundle, and of one that shows one bar."""


@dataclass(frozen=True)
class Load:
    """Outline of the load as it lies, m and rad; its sizes are upper 95 % bounds.

    x_m, y_m: its middle. off_across_m, off_along_m: centre of mass relative to the middle. yaw_rad: as a
    bundle's. height_m: from its underside to its top, as high as it is wide where its bars aren't counted;
    min_height_m: the minimum that it may then be. rolls: it is round, and would roll on level ground.
    """

    bundles: tuple[int, ...]
    x_m: float
    y_m: float
    yaw_rad: float
    width_m: float
    length_m: float
    height_m: float
    min_height_m: float
    rolls: bool
    off_across_m: float = 0.0
    off_along_m: float = 0.0

    @classmethod
    def of(cls, bundles: tuple[Bundle, ...]) -> Load:
        """Build a load from the bundles of one lift, which lie side by side."""
        yaw = mean_yaw(bundles)
        axes = axes_of(yaw)
        low, high = np.full(2, np.inf), np.full(2, -np.inf)
        for b in bundles:
            half = [
                size / 2 + UPPER * known_sigma(sigma) / 2
                for size, sigma in ((b.width_m, b.sigma.width_m), (b.length_m, b.sigma.length_m))
            ]
            low = np.minimum(low, axes @ b.centre_m[:2] - half)
            high = np.maximum(high, axes @ b.centre_m[:2] + half)
        x, y = (low + high) / 2 @ axes
        height = max(b.top_z_m for b in bundles) - min(b.bottom_z_m for b in bundles)
        rolls = len(bundles) == 1 and is_one_bar(bundles[0])
        size = high - low
        ids = tuple(b.id for b in bundles)
        off = axes @ (load_centre(bundles) - (x, y))
        return cls(
            ids, float(x), float(y), yaw, float(size[0]), float(size[1]), height,
            max(_min_height(bundle) for bundle in bundles), rolls, float(off[0]), float(off[1]),
        )  # fmt: skip


def _min_height(bundle: Bundle) -> float:
    """Return the minimum height (m) of a bundle: a pack that is wider than high may be as thin as one bar."""
    if bundle.bars is not None:
        return bundle.top_z_m - bundle.bottom_z_m
    return float(np.nan_to_num(min_diameter_m(bundle)))


def laid_at(load: tuple[Bundle, ...], x_m: float, y_m: float, yaw_rad: float) -> Bundle:
    """Describe a load of one or several bundles as one bundle that lies at a place."""
    whole = Load.of(load)
    return replace(
        load[0], centre_m=np.array([x_m, y_m, load[0].centre_m[2]]), yaw_rad=yaw_rad,
        width_m=whole.width_m, length_m=whole.length_m,
    )  # fmt: skip


def is_one_bar(bundle: Bundle) -> bool:
    """Check whether a bundle may be a single bar: it is hardly wider than one of its bars, or one bar shows
    and it isn't as wide as two of them. A pack whose outline is one bar's may show thinner bars.
    """
    if bundle.visible_bars == 1:
        return not bundle.width_m >= _TWO_BARS * bundle.bar_diameter_m
    return bundle.width_m < _ONE_BAR * bundle.bar_diameter_m


def reaches_area(
    middle_m: Float64, yaw_rad: float, size_m: tuple[float, float], area: tuple[float, float, float, float]
) -> bool:
    """Check whether a rectangle of this width and length, rotated by yaw, meets one along X and Y (x_min,
    y_min, x_max, y_max): no axis of either separates them.
    """
    axes, half = axes_of(yaw_rad), np.array(size_m) / 2
    low, high = np.array(area[:2]), np.array(area[2:])
    off, side = (low + high) / 2 - middle_m, (high - low) / 2
    own = np.abs(axes @ off) <= half + np.abs(axes) @ side
    others = np.abs(off) <= side + np.abs(axes.T) @ half
    return bool(own.all() and others.all())


def reached_areas(
    middle_m: Float64,
    yaw_rad: float,
    size_m: tuple[float, float],
    tolerance: Tolerance,
    settings: LiftSettings,
) -> list[tuple[float, float, float, float]]:
    """List the no-lift areas that an outline (width, length) may reach within the crane's tolerance."""
    turned_m = math.sin(math.radians(tolerance.yaw_deg)) * max(size_m) / 2
    slack_m = 2 * (max(tolerance.x_m, tolerance.y_m) + turned_m)
    grown = size_m[0] + slack_m, size_m[1] + slack_m
    return [area for area in settings.no_lift_areas if reaches_area(middle_m, yaw_rad, grown, area)]


def tops_at(bundles: tuple[Bundle, ...], places_m: Float64) -> Float64:
    """Compute the heights (bundles, N) of bundles' tops at places (N, 2) in plan view along them."""
    along = [(places_m - bundle.centre_m[:2]) @ bundle.axes[1] for bundle in bundles]
    return np.array([
        bundle.top_z_m + away * math.tan(bundle.pitch_rad)
        for bundle, away in zip(bundles, along, strict=True)
    ])  # fmt: skip


def resting_checks(
    place: Placement, magnet: Magnet, contact: Contact, load: tuple[Bundle, ...], strap_m: float
) -> list[Check]:
    """Check that nothing lies between the faces and the load: no face may rest above the load's top."""
    if not load:
        return []
    above = contact.z_m - _tops(place, magnet, load, strap_m)
    sigmas = np.array([float(np.nan_to_num(bundle.sigma.top_z_m)) for bundle in load])
    highest = 1e3 * float((above - UPPER * sigmas[:, None]).min(axis=0).max())
    sigma = 1e3 * float(sigmas.max())
    return [
        check_max(
            "obstructed", "lower bound of the height of a face above the load's top", highest - sigma,
            1e3 * MAX_ABOVE_TOP_M, "mm", f"a face would rest at least {highest:.0f} mm above the load's "
            f"top, so something lies between them; the limit is {1e3 * MAX_ABOVE_TOP_M:.0f} mm", sigma=sigma,
        )
    ]  # fmt: skip


def leaning_checks(
    place: Placement, magnet: Magnet, contact: Contact, load: tuple[Bundle, ...], strap_m: float
) -> list[Check]:
    """Check that the load's top stays below the faces where they lean lowest within the crane's tolerance.

    The faces are sent to a stated height, so its error counts as well as that of the gap.
    """
    if not load:
        return []
    down = _lowest_m(place, magnet, load, contact.roll_rad) * math.tan(abs(contact.roll_rad))
    tops = _tops(place, magnet, load, strap_m)
    rise, sigma = 1e3 * float((tops - contact.z_m + down).max()), 1e3 * contact.sigma_m
    return [
        check_max(
            "obstructed", "height of the load's top above the lowest place of the tilted faces over it", rise,
            1e3 * MAX_TOP_RISE_M, "mm", f"the load's top is {rise:.0f} mm (with its error "
            f"{rise + UPPER * sigma:.0f} mm) above the tilted faces where they are lowest over it, within "
            f"the crane's tolerance; the limit is {1e3 * MAX_TOP_RISE_M:.0f} mm",
            sigma=sigma, sigmas=UPPER,
        )
    ]  # fmt: skip


def _lowest_m(place: Placement, magnet: Magnet, load: tuple[Bundle, ...], roll_rad: float) -> Float64:
    """Compute the distances (bundles, poles) from the poles' middles to the lowest place of the faces that
    may lie over a crest: within the crane's tolerance, and no further out than the axis of the outermost bar.
    """
    poles, (far, edge) = magnet.pole_table, magnet.tolerance.along(place.beam_axes)
    at = poles[:, :2] @ place.beam_axes + (place.x_m, place.y_m)
    out = []
    for bundle in load:
        across, sigma = bundle.axes[0], bundle.sigma
        turned, level = float(across @ place.along), float(across @ place.across)
        middle = -(at - bundle.centre_m[:2]) @ across * np.sign(level)
        reach = (bundle.width_m - float(np.nan_to_num(min_diameter_m(bundle)))) / 2
        reach += UPPER * math.hypot(known_sigma(sigma.lateral_m), known_sigma(sigma.width_m) / 2)
        # Bars askew under the beam cross a face: the outermost one is furthest out at the end of the face.
        crest = reach - math.copysign(1.0, roll_rad) * middle + abs(turned) * (poles[:, 2] / 2 + far)
        out.append(np.clip(crest / max(abs(level), 1e-6), 0.0, poles[:, 3] / 2 + edge))
    return np.array(out)


def _tops(place: Placement, magnet: Magnet, load: tuple[Bundle, ...], strap_m: float) -> Float64:
    """Compute the heights (bundles, poles) of the load's tops at the poles, with a strap on them."""
    return tops_at(load, magnet.pole_table[:, :2] @ place.beam_axes + (place.x_m, place.y_m)) + strap_m
