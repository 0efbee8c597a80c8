"""Clearance of the magnet: no patch may stand above the faces' plane, and no part may be unseen.

The region is that of the faces and the beam's underside, seen from above, grown by the crane's tolerance and
by the reach of the stray field.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from barsight.core.arrays import Bool, Float64, frozen
from barsight.yard.lift_settings import UPPER
from barsight.yard.lifting.contact import Contact
from barsight.yard.lifting.footprint import Placement
from barsight.yard.lifting.magnet import Magnet
from barsight.yard.stability.stability import lookup_heights, nearest_cells
from barsight.yard.types import Bundle, HeightMap
from barsight.yard.vetoes import Veto

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
MAX_HOLE_M = 0.08
"""An unseen place narrower than this is taken to hide nothing that stands."""


def clearance_vetoes(place: Placement, heights: HeightMap, magnet: Magnet, contact: Contact) -> list[Veto]:
    """Find what obstructs the magnet at its contact plane, and unseen places that could."""
    slack = np.array([magnet.tolerance.x_m, magnet.tolerance.y_m])
    along_mm, across_mm = (round(1e3 * float(np.abs(axis) @ slack)) for axis in (place.along, place.across))
    region = _region(magnet, along_mm, across_mm)
    v, u = region.grid[..., :1], region.grid[..., 1:]
    xy = np.array([place.x_m, place.y_m]) + v * place.along + u * place.across
    slope = np.array([math.tan(contact.pitch_rad), math.tan(contact.roll_rad)])
    plane = contact.centre_z_m + region.grid @ slope
    rise = lookup_heights(heights, xy[..., 0], xy[..., 1]) - plane
    unseen = np.isnan(rise)
    allowed = np.where(region.faces, MAX_RISE_M, max(magnet.beam.above_faces_m / 2, MAX_RISE_M))
    most = _free_up_to(heights, xy) - plane
    blocked = np.where(unseen, ~(most <= allowed), rise > allowed)
    return _obstructed(_filled(rise, most), region) or _unseen(blocked, region)


def _filled(rise: Float64, most: Float64) -> Float64:
    """Fill unseen cells (V, U) with the highest seen one two cells about, up to what lines of sight allow."""
    seen = np.maximum(np.nan_to_num(rise, nan=-1.0), -1.0)
    highest = cv2.dilate(seen, np.ones((5, 5), np.uint8))
    return np.where(np.isnan(rise), np.fmin(highest, most), seen)


def resting_vetoes(
    place: Placement, magnet: Magnet, contact: Contact, load: tuple[Bundle, ...]
) -> list[Veto]:
    """Find what lies between the faces and the load: faces that rest above its top."""
    if not load:
        return []
    poles = magnet.pole_table[:, :2] @ np.stack([place.along, place.across]) + (place.x_m, place.y_m)
    above = []
    for bundle in load:
        axis = np.array([-math.sin(bundle.yaw_rad), math.cos(bundle.yaw_rad)])
        top = bundle.top_z_m + (poles - bundle.centre_m[:2]) @ axis * math.tan(bundle.pitch_rad)
        above.append(contact.z_m - top - UPPER * np.nan_to_num(bundle.sigma.top_z_m))
    highest = float(np.min(above, axis=0).max())
    if not highest > MAX_RISE_M:
        return []
    reason = (
        f"a face rests at least {1e3 * highest:.0f} mm above the load's top, {1e3 * MAX_RISE_M:.0f} mm are "
        "allowed: something lies between"
    )
    return [Veto("obstructed", reason)]


def _free_up_to(heights: HeightMap, xy: Float64) -> Float64:
    """Upper bounds (m) of what may stand at places (..., 2), by lines of sight; inf where there are none."""
    if heights.free_m is None:
        return np.full(xy.shape[:-1], np.inf)
    column, row, inside = nearest_cells(heights, xy[..., 0], xy[..., 1])
    return np.where(inside, heights.free_m[row, column], np.inf).astype(np.float64)


def _obstructed(rise: Float64, region: Region) -> list[Veto]:
    """Report the highest connected patch over the plane. rise: (V, U)."""
    known = rise.astype(np.float32)
    for side, allowed_m, cells in (
        (5, MAX_RISE_M, MIN_PATCH_CELLS),
        (3, MAX_NARROW_RISE_M, MIN_PATCH_CELLS),
        (1, MAX_THIN_RISE_M, MIN_THIN_CELLS),
    ):
        smooth = cv2.medianBlur(known, side)
        over = (region.faces | region.beam) & (smooth > allowed_m)
        _, patch, boxes, _ = cv2.connectedComponentsWithStats(over.astype(np.uint8), connectivity=8)
        large = np.flatnonzero(boxes[1:, cv2.CC_STAT_AREA] >= cells) + 1
        if large.size:
            highest = np.where(np.isin(patch, large), smooth, -np.inf)
            at = np.unravel_index(int(np.argmax(highest)), highest.shape)
            along, across = region.grid[at]
            reason = (
                f"something stands {1e3 * highest[at]:.0f} mm above the faces' plane, {along:+.2f} m along "
                f"and {across:+.2f} m across the beam, {1e3 * allowed_m:.0f} mm are allowed"
            )
            return [Veto("obstructed", reason)]
    return []


def _unseen(blocked: Bool, region: Region) -> list[Veto]:
    """Report places, unproven or standing, that are wide enough to hide what stands. blocked: (V, U); a few
    cells free among them, as wrong matches are, prove nothing.
    """
    _, patch, boxes, _ = cv2.connectedComponentsWithStats((~blocked).astype(np.uint8), connectivity=4)
    unproven = blocked | (boxes[:, cv2.CC_STAT_AREA] < MIN_PATCH_CELLS)[patch]
    side = round(MAX_HOLE_M / STEP_M)
    wide = cv2.morphologyEx(unproven.astype(np.uint8), cv2.MORPH_OPEN, np.ones((side, side), np.uint8)) > 0
    hidden = wide & (region.faces | region.beam)
    if not hidden.any():
        return []
    along, across = region.grid[hidden].mean(axis=0)
    reason = (
        f"{1e4 * STEP_M**2 * hidden.sum():.0f} cm2 under the magnet or beside it were not seen, around "
        f"{along:+.2f} m along and {across:+.2f} m across the beam: what is not known counts as an obstacle"
    )
    return [Veto("unknown-under-footprint", reason)]


@dataclass(frozen=True, eq=False)
class Region:
    """grid: (V, U, 2) places along and across the beam, m. faces, beam: (V, U) cells of each, with margin."""

    grid: Float64
    faces: Bool
    beam: Bool


@lru_cache(maxsize=64)
def _region(magnet: Magnet, along_mm: int, across_mm: int) -> Region:
    """Lay the grid, a hole's width wider than the region, for a crane that may miss by so much."""
    poles = [(pole.along_m, pole.across_m, pole.length_m / 2, pole.width_m / 2) for pole in magnet.poles]
    beam = (0.0, 0.0, magnet.beam.length_m / 2, magnet.beam.width_m / 2)
    long = max(abs(part[0]) + part[2] for part in (*poles, beam))
    wide = max(abs(part[1]) + part[3] for part in (*poles, beam))
    turned = math.radians(magnet.tolerance.yaw_deg)
    more_v = along_mm / 1e3 + STRAY_FIELD_M + turned * wide
    more_u = across_mm / 1e3 + STRAY_FIELD_M + turned * long
    v = np.arange(-long - more_v - MAX_HOLE_M, long + more_v + MAX_HOLE_M, STEP_M)
    u = np.arange(-wide - more_u - MAX_HOLE_M, wide + more_u + MAX_HOLE_M, STEP_M)
    grid = np.stack(np.meshgrid(v, u, indexing="ij"), axis=-1)

    def covered(part: tuple[float, float, float, float]) -> Bool:
        away = np.abs(grid - part[:2])
        return np.asarray((away[..., 0] <= part[2] + more_v) & (away[..., 1] <= part[3] + more_u))

    faces = np.any([covered(pole) for pole in poles], axis=0)
    return Region(frozen(grid), frozen(faces), frozen(covered(beam)))
