"""Clearance of the magnet: no patch may stand above the faces' plane, and no part may be unseen.

The region is that of the faces and the beam's underside, seen from above, grown by the crane's tolerance and
by the reach of the stray field.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from barsight.core.arrays import Bool, Float64
from barsight.yard.lift_settings import UPPER
from barsight.yard.magnet.contact import Contact
from barsight.yard.magnet.description import Magnet
from barsight.yard.magnet.footprint import Placement
from barsight.yard.stability.stability import lookup_heights, nearest_cells
from barsight.yard.types import Bundle, HeightMap
from barsight.yard.vetoes import Check, check_most

STEP_M = 0.01
STRAY_FIELD_M = 0.03
"""Steel this near to a face or the beam is drawn to it."""
MAX_RISE_M = 0.012
"""A patch that the map shows this much above the faces' plane obstructs, by medians over 50 mm squares."""
MAX_NARROW_RISE_M = 0.020
"""The same for what is too narrow for those: by medians over 30 mm squares."""
MAX_THIN_RISE_M, MIN_THIN_CELLS = 0.05, 8
"""The same for a connected patch of so many cells that may be a single one wide, as plates on edge are."""
MIN_PATCH_CELLS = 4
"""Cells of STEP_M of the smallest patch that counts."""
EDGE_SIGMA_M = 0.003
"""How well a cell of STEP_M tells the edge of what it shows."""
MAX_HOLE_M = 0.08
"""An unseen place narrower than this is taken to hide nothing that stands."""


@dataclass(frozen=True)
class FacePlane:
    """The faces' plane as it rests: height at the magnet's centre, rise along and across, sigma of height."""

    centre_z_m: float
    pitch_rad: float
    roll_rad: float
    sigma_m: float

    @classmethod
    def of(cls, contact: Contact) -> FacePlane:
        """Take it from a contact."""
        return cls(contact.centre_z_m, contact.pitch_rad, contact.roll_rad, contact.gap_sigma_m)


@dataclass(frozen=True, eq=False)
class Obstacle:
    """An obstacle to the magnet. code, reason: of its check. value_mm: its height, or its width where nobody
    saw it. bound_mm: what is allowed. places_m: (N, 2) its cells, yard axes.
    """

    code: str
    reason: str
    value_mm: float
    bound_mm: float
    places_m: Float64


def clearance_checks(place: Placement, heights: HeightMap, magnet: Magnet, contact: Contact) -> list[Check]:
    """Check that nothing stands above the faces' plane under the magnet or beside it, seen or not.

    Limits are held with the plane's sigma in height and a cell's in place.
    """
    faces = FacePlane.of(contact)
    obstacle = find_obstacle(place, heights, magnet, faces)
    sigma = 1e3 * contact.gap_sigma_m
    checks = []
    for code, what, bound_mm in (
        ("obstructed", "what stands highest above the faces' plane, under the magnet or beside it",
         1e3 * MAX_RISE_M),
        ("unknown-under-footprint", "the widest place under the magnet or beside it that was neither seen "
         "nor proven free", 1e3 * MAX_HOLE_M),
    ):  # fmt: skip
        if obstacle is None or obstacle.code != code:
            unknown = obstacle is not None and code == "unknown-under-footprint"
            if not unknown:
                checks.append(Check(code, what, None, sigma, bound_mm, "mm", "passed", ""))
            continue
        reason = obstacle.reason
        if find_obstacle(place, heights, magnet, faces, careful=False) is None:
            reason += "; it lies within its sigma of the limit"
        checks.append(Check(code, what, obstacle.value_mm, sigma, obstacle.bound_mm, "mm", "failed", reason))
    return checks


def find_obstacle(
    place: Placement, heights: HeightMap, magnet: Magnet, faces: FacePlane, *, careful: bool = True
) -> Obstacle | None:
    """Find what obstructs the magnet at its contact plane, or an unseen place that could.

    careful: what is within its sigma of a limit obstructs too.
    """
    region = _region(place, heights, magnet, EDGE_SIGMA_M if careful else 0.0)
    slope = np.array([math.tan(faces.pitch_rad), math.tan(faces.roll_rad)])
    plane = faces.centre_z_m + region.grid @ slope
    if careful:
        plane = plane - faces.sigma_m
    rise = lookup_heights(heights, region.xy_m[..., 0], region.xy_m[..., 1]) - plane
    unseen = np.isnan(rise)
    allowed = np.where(region.faces, MAX_RISE_M, max(magnet.beam.above_faces_m / 2, MAX_RISE_M))
    most = _free_up_to(heights, region.xy_m) - plane
    blocked = np.where(unseen, ~(most <= allowed), rise > allowed)
    return _obstructed(_filled(rise, most), region) or _unseen(blocked, region)


def _filled(rise: Float64, most: Float64) -> Float64:
    """Fill unseen cells (V, U) with the highest seen one two cells about, up to what lines of sight allow."""
    seen = np.maximum(np.nan_to_num(rise, nan=-1.0), -1.0)
    highest = cv2.dilate(seen, np.ones((5, 5), np.uint8))
    return np.where(np.isnan(rise), np.fmin(highest, most), seen)


def resting_checks(
    place: Placement, magnet: Magnet, contact: Contact, load: tuple[Bundle, ...]
) -> list[Check]:
    """Check that nothing lies between the faces and the load: that no face rests above its top."""
    if not load:
        return []
    poles = magnet.pole_table[:, :2] @ np.stack([place.along, place.across]) + (place.x_m, place.y_m)
    above, sigmas = [], []
    for bundle in load:
        axis = np.array([-math.sin(bundle.yaw_rad), math.cos(bundle.yaw_rad)])
        top = bundle.top_z_m + (poles - bundle.centre_m[:2]) @ axis * math.tan(bundle.pitch_rad)
        sigmas.append(float(np.nan_to_num(bundle.sigma.top_z_m)))
        above.append(contact.z_m - top - UPPER * sigmas[-1])
    highest, sigma = 1e3 * float(np.min(above, axis=0).max()), 1e3 * max(sigmas)
    return [
        check_most(
            "obstructed", "how far a face surely rests above the load's top", highest - sigma,
            1e3 * MAX_RISE_M, "mm", f"a face rests at least {highest:.0f} mm above the load's top, "
            f"{1e3 * MAX_RISE_M:.0f} mm are allowed: something lies between", sigma=sigma,
        )
    ]  # fmt: skip


def _free_up_to(heights: HeightMap, xy: Float64) -> Float64:
    """Upper bounds (m) of what may stand at places (..., 2), by lines of sight; inf where there are none."""
    if heights.free_m is None:
        return np.full(xy.shape[:-1], np.inf)
    column, row, inside = nearest_cells(heights, xy[..., 0], xy[..., 1])
    return np.where(inside, heights.free_m[row, column], np.inf).astype(np.float64)


def _obstructed(rise: Float64, region: Region) -> Obstacle | None:
    """Find the highest connected patch over the plane. rise: (V, U)."""
    known = rise.astype(np.float32)
    for side, allowed_m, cells in (
        (5, MAX_RISE_M, MIN_PATCH_CELLS),
        (3, MAX_NARROW_RISE_M, MIN_PATCH_CELLS),
        (1, MAX_THIN_RISE_M, MIN_THIN_CELLS),
    ):
        smooth = cv2.medianBlur(known, side)
        over = (region.faces | region.beam) & (smooth > allowed_m)
        _, patch, boxes, _ = cv2.connectedComponentsWithStats(over.astype(np.uint8), connectivity=8)
        large = np.isin(patch, np.flatnonzero(boxes[1:, cv2.CC_STAT_AREA] >= cells) + 1)
        if large.any():
            highest = np.where(large, smooth, -np.inf)
            at = np.unravel_index(int(np.argmax(highest)), highest.shape)
            along, across = region.grid[at]
            reason = (
                f"something stands {1e3 * highest[at]:.0f} mm above the faces' plane, {along:+.2f} m along "
                f"and {across:+.2f} m across the beam, {1e3 * allowed_m:.0f} mm are allowed"
            )
            rise_mm = 1e3 * float(highest[at])
            return Obstacle("obstructed", reason, rise_mm, 1e3 * allowed_m, region.xy_m[large])
    return None


def _unseen(blocked: Bool, region: Region) -> Obstacle | None:
    """Find places, unproven or standing, that are wide enough to hide what stands. blocked: (V, U); a few
    cells free among them, as wrong matches are, prove nothing.
    """
    _, patch, boxes, _ = cv2.connectedComponentsWithStats((~blocked).astype(np.uint8), connectivity=4)
    unproven = blocked | (boxes[:, cv2.CC_STAT_AREA] < MIN_PATCH_CELLS)[patch]
    side = round(MAX_HOLE_M / STEP_M)
    wide = cv2.morphologyEx(unproven.astype(np.uint8), cv2.MORPH_OPEN, np.ones((side, side), np.uint8)) > 0
    hidden = wide & (region.faces | region.beam)
    if not hidden.any():
        return None
    along, across = region.grid[hidden].mean(axis=0)
    area_m2 = STEP_M**2 * float(hidden.sum())
    reason = (
        f"{1e4 * area_m2:.0f} cm2 under the magnet or beside it were not seen, around "
        f"{along:+.2f} m along and {across:+.2f} m across the beam: what is not known counts as an obstacle"
    )
    width_mm = 1e3 * max(MAX_HOLE_M, math.sqrt(area_m2))
    return Obstacle("unknown-under-footprint", reason, width_mm, 1e3 * MAX_HOLE_M, region.xy_m[hidden])


@dataclass(frozen=True, eq=False)
class Region:
    """xy_m: (V, U, 2) places on the map's own grid, yard axes; grid: the same along and across the beam, m.
    faces, beam: (V, U) cells of each, with margin.
    """

    xy_m: Float64
    grid: Float64
    faces: Bool
    beam: Bool


def _region(place: Placement, heights: HeightMap, magnet: Magnet, wider_m: float) -> Region:
    """Lay the grid, a hole's width wider than the region, for a crane that may miss by its tolerance and
    `wider_m`. It lies on the map's cells: none comes or goes as the place moves, but at the region's edge.
    """
    slack = np.array([magnet.tolerance.x_m, magnet.tolerance.y_m])
    more_v, more_u = (float(np.abs(axis) @ slack) for axis in (place.along, place.across))
    poles = [(pole.along_m, pole.across_m, pole.length_m / 2, pole.width_m / 2) for pole in magnet.poles]
    beam = (0.0, 0.0, magnet.beam.length_m / 2, magnet.beam.width_m / 2)
    long = max(abs(part[0]) + part[2] for part in (*poles, beam))
    wide = max(abs(part[1]) + part[3] for part in (*poles, beam))
    turned = math.radians(magnet.tolerance.yaw_deg)
    more_v += STRAY_FIELD_M + wider_m + turned * wide
    more_u += STRAY_FIELD_M + wider_m + turned * long
    reach = np.array([long + more_v + MAX_HOLE_M, wide + more_u + MAX_HOLE_M])
    axes = []
    for centre, first, unit in (
        (place.x_m, heights.x0_m, (place.along[0], place.across[0])),
        (place.y_m, heights.y0_m, (place.along[1], place.across[1])),
    ):
        half = float(np.abs(unit) @ reach)
        steps = np.arange(
            math.floor((centre - half - first) / STEP_M), math.ceil((centre + half - first) / STEP_M) + 1
        )
        axes.append(first + STEP_M * steps)
    xy = np.stack(np.meshgrid(*axes), axis=-1)
    grid = (xy - (place.x_m, place.y_m)) @ np.stack([place.along, place.across], axis=1)

    v, u = (np.ascontiguousarray(grid[..., k]) for k in (0, 1))

    def covered(part: tuple[float, float, float, float]) -> Bool:
        return (np.abs(v - part[0]) <= part[2] + more_v) & (np.abs(u - part[1]) <= part[3] + more_u)

    return Region(xy, grid, np.any([covered(pole) for pole in poles], axis=0), covered(beam))
