"""Check that no thin bar lies loose across a load: matching can't see bars thinner than three pixels."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from barsight.core.arrays import Float64
from barsight.yard.lift_settings import LiftSettings
from barsight.yard.magnet.description import Magnet
from barsight.yard.magnet.footprint import Placement
from barsight.yard.placement.clearance import STRAY_FIELD_M
from barsight.yard.thin_lines import MAX_SLOPE, ThinLine
from barsight.yard.types import Bundle, DoubtKind, HeightMap
from barsight.yard.vetoes import Check, check_max, check_true

CODE = "thin-bar"
FOUND_PX = 1.8
"""Minimum diameter, in the photo's pixels, of bars of which nine in ten are found."""
BEYOND_M = 0.4
"""Maximum distance (m) by which a bar that lies across a bundle projects beyond its flank."""
BELOW_M = 0.3
"""Depth (m) of a bundle below the faces from which a bar on it can't reach up to them, even if it leans with
a slope of a half where it projects.
"""
WAY_STEP_M, UNSEEN_STEP_M = 0.02, 0.1
"""Spacing (m) of a line's places that are checked, and of the lines that may cross an unseen neighbour."""


def thin_bar_checks(
    heights: HeightMap, line: ThinLine | None, load: tuple[Bundle, ...], pixel_m: float | None,
    settings: LiftSettings,
) -> list[Check]:  # fmt: skip
    """Check that no thin bar lies across the load, and that the pictures would show one.

    line: the strongest across the load, None where the photo doesn't show enough of it. pixel_m: pixel size
    of the pictures on the load, NaN where it isn't known; None for a map that wasn't made from pictures: then
    nothing is checked unless there is a photo.
    """
    if not load or not has_pictures(heights, pixel_m):
        return []
    what = "strength of the strongest line across the load that isn't a strap"
    if line is None:
        reason = "no photo shows whether a thin bar lies across the load: measure the recording again"
        return [check_true(CODE, what, None, reason)]
    reason = (
        f"a line crosses the load {line.along_m:+.2f} m along it from its middle, "
        f"{abs(line.askew_deg):.0f} deg askew, and may be a thin bar"
    )
    checks = [check_max(CODE, what, line.strength, line.limit, "sigma", reason)]
    if pixel_m is not None:
        hidden_m = FOUND_PX * max(pixel_m, heights.cell_m)
        reason = (
            f"a bar of up to {1e3 * hidden_m:.0f} mm across the load may not show in the pictures; "
            f"the limit is {1e3 * settings.max_hidden_bar_m:.0f} mm"
            if math.isfinite(hidden_m)
            else "the resolution of the pictures is unknown: measure again"
        )
        checks.append(
            check_max(
                CODE, "thickest bar across the load that may not show in the pictures", 1e3 * hidden_m,
                1e3 * settings.max_hidden_bar_m, "mm", reason,
            )
        )  # fmt: skip
    return checks


def has_pictures(heights: HeightMap, pixel_m: float | None) -> bool:
    """Check that a map was made from pictures, or has their photo: see `thin_bar_checks`."""
    return pixel_m is not None or heights.tops is not None


def edge_checks(beside: Iterable[Bundle]) -> list[Check]:
    """Check that no edge crosses the flank of a neighbour from which a bar may reach under the magnet: how
    far the object with that edge extends beyond the flank isn't known.
    """
    what = "nothing with an edge over a neighbour's flank extends under the magnet"
    return [
        check_true(CODE, what, None, f"beside the load, on bundle {bundle.id}, {doubt.sentence}")
        for bundle in beside for doubt in bundle.cover_doubts if doubt.kind is DoubtKind.CROSSING_EDGE
    ]  # fmt: skip


def beside_checks(
    place: Placement, magnet: Magnet, near: tuple[tuple[Bundle, tuple[ThinLine, ...] | None], ...]
) -> list[Check]:
    """Check that no thin bar that lies across a neighbour reaches under the magnet.

    In the air beyond its bundle's flank nothing shows such a bar, since the map has the surface below it.
    near: the bundles that `may_reach`, and the lines across each, None where the photo doesn't show enough of
    it.
    """
    if not near:
        return []
    half = _under_m(place, magnet)

    def reaches(bundle: Bundle, line: ThinLine) -> bool:
        way = _beyond_flanks(bundle, line) - (place.x_m, place.y_m)
        under = (np.abs(way @ place.along) <= half[0]) & (np.abs(way @ place.across) <= half[1])
        return bool(under.any())

    what = "strength of the strongest line across a neighbour that extends under the magnet"
    checks, strongest, where = [], ThinLine(0.0, 0.0, 0.0), ""
    for bundle, lines in near:
        if lines is None:
            ends = np.linspace(-0.5, 0.5, math.ceil(bundle.length_m / UNSEEN_STEP_M) + 1) * bundle.length_m
            if any(reaches(bundle, ThinLine(0.0, float(along), 0.0)) for along in ends):
                reason = f"no photo shows whether a thin bar lies across bundle {bundle.id} beside the load"
                checks.append(check_true(CODE, what, None, reason))
            continue
        for line in lines:
            if line.excess_ratio > strongest.excess_ratio and reaches(bundle, line):
                strongest = line
                where = f"a line crosses bundle {bundle.id} {line.along_m:+.2f} m along it from its middle"
    reason = f"{where}: a thin bar there may extend under the magnet"
    return [*checks, check_max(CODE, what, strongest.strength, strongest.limit, "sigma", reason)]


def may_reach(bundle: Bundle, place: Placement, magnet: Magnet, faces_z_m: float) -> bool:
    """Check whether a line of any slope across a bundle could come under the magnet, by its height and by the
    bounding rectangle of all such lines along the magnet's axes. If not, the bundle's photo needn't be
    searched. faces_z_m: height of the lowest face.
    """
    highest_m = bundle.top_z_m + bundle.length_m / 2 * abs(math.tan(bundle.pitch_rad))
    if highest_m < faces_z_m - BELOW_M:
        return False
    across, along = bundle.axes
    wide = bundle.width_m / 2 + BEYOND_M
    long = bundle.length_m / 2 + MAX_SLOPE * wide
    away = bundle.centre_m[:2] - (place.x_m, place.y_m)
    beam = place.beam_axes
    spread = np.abs(beam @ along) * long + np.abs(beam @ across) * wide
    return bool((np.abs(beam @ away) <= _under_m(place, magnet) + spread).all())


def _under_m(place: Placement, magnet: Magnet) -> Float64:
    """Compute half the length and half the width (2,) of the area under the magnet, including the crane's
    tolerance and the stray field.
    """
    slack = magnet.tolerance.along(place.beam_axes)
    half = np.array([magnet.size_m[1], magnet.size_m[0]]) / 2 + slack + STRAY_FIELD_M
    return np.asarray(half + math.radians(magnet.tolerance.yaw_deg) * half[::-1])


def _beyond_flanks(bundle: Bundle, line: ThinLine) -> Float64:
    """Return places (N, 2) on a line across a bundle, up to BEYOND_M beyond either flank, in yard axes."""
    across, along = bundle.axes
    askew = math.radians(line.askew_deg)
    way = math.cos(askew) * across + math.sin(askew) * along
    reach = (bundle.width_m / 2 + BEYOND_M) / math.cos(askew)
    steps = np.linspace(-reach, reach, math.ceil(2 * reach / WAY_STEP_M) + 1)
    return np.asarray(bundle.centre_m[:2] + line.along_m * along + steps[:, None] * way)
