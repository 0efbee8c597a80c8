"""Check the magnet's clearance: no patch may rise above the faces' plane, and nothing may be unseen.

The region is the plan view of the faces and of the beam's underside, grown by the crane's tolerance and by
the range of the stray field.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from barsight.core.arrays import Bool, Float32, Float64, UInt8, kernel
from barsight.yard.magnet.contact import Contact
from barsight.yard.magnet.description import Magnet
from barsight.yard.magnet.footprint import Placement
from barsight.yard.magnet.stanchions import stanchion_checks
from barsight.yard.map_lookup import cell_spans, highest_seen
from barsight.yard.types import Bundle, HeightMap
from barsight.yard.unseen import wide_parts
from barsight.yard.vetoes import Check

STEP_M = 0.01
STRAY_FIELD_M = 0.03
"""Distance (m) from a face or the beam within which the stray field attracts steel."""
MAX_RISE_M = 0.012
"""Maximum rise (m) over the faces' plane of a patch that is no obstacle, by medians over squares of 50 mm."""
MAX_NARROW_RISE_M = 0.020
"""The same of a patch that is too narrow for those, by medians over squares of 30 mm."""
MAX_THIN_RISE_M, MIN_THIN_CELLS = 0.05, 8
"""The same for thin objects such as plates on edge, and the minimum number of connected cells."""
BEAM_CLEAR_M = 0.1
"""Clearance (m) of the beam over objects beside the load; at most half its height over the faces."""
MIN_PATCH_CELLS = 4
"""Minimum size of a patch that counts, in cells of STEP_M, or of the map where its cells are larger."""
EDGE_SIGMA_M = 0.003
"""Standard deviation (m) of an object's edge as it shows in cells of STEP_M."""
MAX_HOLE_M = 0.06
"""Width (m) of an unseen place over the load from which on it may hide an obstacle."""
MAX_HOLE_BESIDE_M = 0.04
"""The same beside the load: around a post, wrong matches make its edge look free."""
FLANK_M = 0.03
"""Distance (m) from the load within which an unseen place is the load's own flank."""
HIGHEST_OBJECT = "highest object above the plane of the faces, under or beside the magnet"
_HOLE_CELLS, _HOLE_BESIDE_CELLS = round(MAX_HOLE_M / STEP_M), round(MAX_HOLE_BESIDE_M / STEP_M)
_BEAM_ONLY = 2
_NO_BOUNDS = np.empty((0, 0), np.float32)


@dataclass(frozen=True)
class FacePlane:
    """Plane of the faces at rest on the map: height at the magnet's centre, slopes along and across, height
    sigma. It is compared with heights of that map, which cuts off what stands on a load as it cuts crests.
    others: planes in which they may rest instead; at each place the lowest counts.
    """

    centre_z_m: float
    pitch_rad: float
    roll_rad: float
    sigma_m: float
    others: tuple[FacePlane, ...] = ()

    @classmethod
    def of(cls, contact: Contact, others: Iterable[Contact] = ()) -> FacePlane:
        """Take the plane from a contact, and those of the other ones."""
        height = contact.centre_z_m - contact.over_map_m
        planes = tuple(cls.of(other) for other in others)
        return cls(height, contact.pitch_rad, contact.roll_rad, contact.gap_sigma_m, planes)

    @property
    def table(self) -> Float64:
        """Return (1 + others, 3) heights (m) at the magnet's centre, and the slopes along and across."""
        return np.array([
            (one.centre_z_m, math.tan(one.pitch_rad), math.tan(one.roll_rad)) for one in (self, *self.others)
        ])  # fmt: skip


@dataclass(frozen=True, eq=False)
class Obstacle:
    """An obstacle to the magnet. code, reason: of its check. value_mm: its height, or its width if it is an
    unseen place. bound_mm: limit of that value. places_m: (N, 2) its cells, yard axes.
    """

    code: str
    reason: str
    value_mm: float
    bound_mm: float
    places_m: Float64


def clearance_checks(
    place: Placement, heights: HeightMap, magnet: Magnet, faces: FacePlane, load: tuple[Bundle, ...],
    stanchions: tuple[tuple[float, float, float], ...],
) -> list[Check]:  # fmt: skip
    """Check that nothing, seen, unseen or stated, rises above the faces' plane under the magnet or beside it.

    The limits include the sigma of the plane in height and that of a cell in place.
    """
    sigma = 1e3 * faces.sigma_m
    obstacle = find_obstacle(place, heights, magnet, faces, load)
    checks = []
    for code, what, bound_mm in (
        ("obstructed", HIGHEST_OBJECT, 1e3 * MAX_RISE_M),
        ("unknown-under-footprint", "widest place under or beside the magnet that was neither seen nor "
         f"proven free; beside the load the limit is {1e3 * MAX_HOLE_BESIDE_M:.0f} mm", 1e3 * MAX_HOLE_M),
    ):  # fmt: skip
        if obstacle is None or obstacle.code != code:
            checks.append(Check(code, what, None, sigma, bound_mm, "mm", "passed", ""))
            continue
        reason = obstacle.reason
        if find_obstacle(place, heights, magnet, faces, load, careful=False) is None:
            reason += "; the value is within its sigma of the limit"
        checks.append(Check(code, what, obstacle.value_mm, sigma, obstacle.bound_mm, "mm", "failed", reason))
        # Behind an object no unseen place is searched for.
        break
    if stanchions:
        checks += stanchion_checks(place, _region(place, heights, magnet, 0.0).parts, faces.table, stanchions)
    return checks


def find_obstacle(
    place: Placement, heights: HeightMap, magnet: Magnet, faces: FacePlane, load: tuple[Bundle, ...], *,
    careful: bool = True,
) -> Obstacle | None:  # fmt: skip
    """Find an object that obstructs the magnet at its contact plane, or an unseen place that could hide one.

    Under the faces, and under the beam over the load, nothing may rise above the plane; beside the load the
    beam passes over objects. careful: an object also obstructs if a limit lies within its sigma.
    """
    region = _region(place, heights, magnet, EDGE_SIGMA_M if careful else 0.0)
    planes = faces.table - (faces.sigma_m if careful else 0.0, 0.0, 0.0)
    rise, most, blocked = _look(
        heights.z_m, heights.source, _NO_BOUNDS if heights.free_m is None else heights.free_m,
        np.array([heights.x0_m, heights.y0_m, heights.cell_m]), region.x_m, region.y_m, region.frame, planes,
        region.parts, region.under,
    )  # fmt: skip
    spare = region.parts[-1, 4] - MAX_RISE_M
    passed_over = (region.under == _BEAM_ONLY) & ~_over(load, region)
    spares = np.where(passed_over, np.float32(spare), np.float32(0))
    np.minimum(region.under, 1, out=region.under)
    beside = ~_over(load, region, FLANK_M)
    obstacle = _obstructed(_filled(rise, most) - spares, spares, region)
    return obstacle or _unseen(blocked, beside, region, max(heights.cell_m / STEP_M, 1.0))


@kernel()
def _look(
    z: Float32, source: UInt8, free: Float32, at: Float64, x: Float64, y: Float64, frame: Float64,
    planes: Float64, parts: Float64, under: UInt8,
) -> tuple[Float32, Float32, UInt8]:  # fmt: skip
    """Compute heights above the faces' plane (V, U), NaN where unknown: those that were seen (at least -1)
    and the upper bounds by lines of sight; and mark by 1 the cells that aren't proven free.

    z, source, free: maps (rows, columns); free is empty where there is none. at: x and y of the first cell,
    and its size. x, y: (U,), (V,) of the cells. frame: (3, 2) the magnet's place, unit vectors along and
    across. planes: (K, 3) heights at the place, slopes along and across; the lowest counts. parts: (P + 1, 5)
    poles and beam: middle along and across, reach to either side, allowed rise. Fills under
    (V, U): 1 under a pole, _BEAM_ONLY under the beam alone, else 0.
    """
    rise, most = np.empty((y.size, x.size), np.float32), np.empty((y.size, x.size), np.float32)
    blocked = np.empty((y.size, x.size), np.uint8)
    columns, rows = cell_spans(x, at[0], at[2], STEP_M), cell_spans(y, at[1], at[2], STEP_M)
    for i in range(y.size):
        row, dy = rows[i, 1], y[i] - frame[0, 1]
        for k in range(x.size):
            column, dx = columns[k, 1], x[k] - frame[0, 0]
            v = dx * frame[1, 0] + dy * frame[1, 1]
            u = dx * frame[2, 0] + dy * frame[2, 1]
            level = np.inf
            for n in range(len(planes)):
                level = min(level, planes[n, 0] + (v * planes[n, 1] + u * planes[n, 2]))
            allowed = parts[-1, 4]
            under[i, k] = 0
            for p in range(len(parts)):
                if abs(u - parts[p, 1]) <= parts[p, 3] and abs(v - parts[p, 0]) <= parts[p, 2]:
                    under[i, k] = 1 if p + 1 < len(parts) else _BEAM_ONLY
                    allowed = parts[p, 4]
                    break
            height, bound = np.nan, np.inf
            if 0 <= row < z.shape[0] and 0 <= column < z.shape[1]:
                left, right = columns[k, 0], columns[k, 2]
                height = highest_seen(z, source, rows[i, 0], rows[i, 2], left, right) - level
                if free.size:
                    bound = free[row, column] - level
            rise[i, k], most[i, k] = max(height, -1.0) if height == height else np.nan, bound
            blocked[i, k] = height > allowed if height == height else not bound <= allowed
    return rise, most, blocked


def _filled(rise: Float32, max_rise: Float32) -> Float32:
    """Fill unseen cells (V, U) with the highest one seen within two cells, limited by lines of sight."""
    unseen = np.isnan(rise)
    if not unseen.any():
        return rise
    highest = cv2.dilate(np.where(unseen, np.float32(-1), rise), np.ones((5, 5), np.uint8))
    return np.where(unseen, np.fmin(highest, max_rise), rise)


def _over(load: tuple[Bundle, ...], region: Region, margin_m: float = 0.0) -> Bool:
    """Mark the cells (V, U) over the load's outline and a margin; all cells where no load is known."""
    over = np.full(region.under.shape, not load)
    for bundle in load:
        dx, dy = region.x_m - bundle.centre_m[0], region.y_m[:, None] - bundle.centre_m[1]
        beside, beyond = (np.abs(axis[0] * dx + axis[1] * dy) for axis in bundle.axes)
        over |= (beside <= bundle.width_m / 2 + margin_m) & (beyond <= bundle.length_m / 2 + margin_m)
    return over


def _obstructed(rise: Float32, spare: Float32, region: Region) -> Obstacle | None:
    """Find the highest connected patch above the plane. rise: (V, U), minus the extra allowance `spare`."""
    for side, allowed_m, cells in (
        (5, MAX_RISE_M, MIN_PATCH_CELLS),
        (3, MAX_NARROW_RISE_M, MIN_PATCH_CELLS),
        (1, MAX_THIN_RISE_M, MIN_THIN_CELLS),
    ):
        # The median exceeds a limit where most of the cells do.
        high = (rise > allowed_m).astype(np.uint8)
        count = cv2.boxFilter(high, -1, (side, side), normalize=False, borderType=cv2.BORDER_REPLICATE)
        over = (count > side * side // 2) & region.under
        if not over.any():
            continue
        _, patch, boxes, _ = cv2.connectedComponentsWithStats(over, connectivity=8)
        large = (over > 0) & (boxes[:, cv2.CC_STAT_AREA] >= cells)[patch]
        if large.any():
            smooth = cv2.medianBlur(rise, side)
            at = np.unravel_index(int(np.argmax(np.where(large, smooth, -np.inf))), smooth.shape)
            _, ((along, across),) = region.places(at)
            rise_mm, bound_mm = (1e3 * float(least + spare[at]) for least in (smooth[at], allowed_m))
            reason = (
                f"something stands {rise_mm:.0f} mm above the plane of the faces, {along:+.2f} m along and "
                f"{across:+.2f} m across the beam; the limit is {bound_mm:.0f} mm"
            )
            return Obstacle("obstructed", reason, rise_mm, bound_mm, region.places(np.nonzero(large))[0])
    return None


def _unseen(blocked: UInt8, beside: Bool, region: Region, cell_steps: float) -> Obstacle | None:
    """Find unproven or obstructed places that are wide enough to hide an obstacle. blocked: (V, U); a few
    free cells among blocked ones, as wrong matches are, prove nothing. beside: (V, U), cells without a load.
    cell_steps: side of a map's cell in steps, at least 1.
    """
    # Fewer than four cells of the map hold no square of two: closing what holds none hides the most.
    side = max(math.ceil(cell_steps) + 1, 3)
    closed = cv2.morphologyEx(blocked, cv2.MORPH_CLOSE, np.ones((side, side), np.uint8))
    if not (wide_parts(closed, _HOLE_BESIDE_CELLS) & region.under).any():
        return None
    _, patch, boxes, _ = cv2.connectedComponentsWithStats(1 - blocked, connectivity=4)
    too_small = boxes[:, cv2.CC_STAT_AREA] < MIN_PATCH_CELLS * cell_steps**2
    unproven = blocked.astype(np.bool_) | too_small[patch]
    hidden = wide_parts(unproven, _HOLE_CELLS) | (wide_parts(unproven, _HOLE_BESIDE_CELLS) & beside)
    hidden &= region.under
    if not hidden.any():
        return None
    _, patch, boxes, _ = cv2.connectedComponentsWithStats(hidden, connectivity=8)
    largest = patch == 1 + int(np.argmax(boxes[1:, cv2.CC_STAT_AREA]))
    _, grid = region.places(np.nonzero(largest))
    along, across = grid.mean(axis=0)
    area_m2 = STEP_M**2 * len(grid)
    bound_m = MAX_HOLE_BESIDE_M if beside[largest].all() else MAX_HOLE_M
    reason = (
        f"{1e4 * area_m2:.0f} cm² under or beside the magnet were not seen, around "
        f"{along:+.2f} m along and {across:+.2f} m across the beam; unknown places count as obstacles"
    )
    width_mm = 1e3 * max(bound_m, math.sqrt(area_m2))
    places = region.places(np.nonzero(hidden))[0]
    return Obstacle("unknown-under-footprint", reason, width_mm, 1e3 * bound_m, places)


@dataclass(frozen=True, eq=False)
class Region:
    """Cells (V, U) on the map's own grid about the magnet. x_m: (U,), y_m: (V,) of their centres, yard axes.
    frame, parts: of `_look`, with margin. under: (V, U) 1 under a part, once filled by `_look`.
    """

    x_m: Float64
    y_m: Float64
    frame: Float64
    parts: Float64
    under: UInt8

    def places(self, cells: tuple[Any, ...]) -> tuple[Float64, Float64]:
        """Return the places (N, 2) of cells (rows, columns): in yard axes, and along and across."""
        xy = np.stack([np.atleast_1d(self.x_m[cells[1]]), np.atleast_1d(self.y_m[cells[0]])], axis=1)
        return xy, (xy - self.frame[0]) @ self.frame[1:].T


def _region(place: Placement, heights: HeightMap, magnet: Magnet, wider_m: float) -> Region:
    """Lay out the grid for the crane's tolerance plus `wider_m`, with a margin as wide as a hole. It is
    aligned with the map's cells, so a shift of the place adds or removes cells only at the edge.
    """
    beam = magnet.beam
    frame = place.frame
    more = magnet.tolerance.along(frame[1:])
    parts = np.empty((len(magnet.poles) + 1, 5))
    parts[:-1, :4] = magnet.pole_table * (1, 1, 0.5, 0.5)
    parts[:-1, 4] = MAX_RISE_M
    above_m = max(beam.above_faces_m - BEAM_CLEAR_M, beam.above_faces_m / 2, MAX_RISE_M)
    parts[-1] = 0, 0, beam.length_m / 2, beam.width_m / 2, above_m
    long, wide = (np.abs(parts[:, :2]) + parts[:, 2:4]).max(axis=0)
    more += STRAY_FIELD_M + wider_m + math.radians(magnet.tolerance.yaw_deg) * np.array([wide, long])
    parts[:, 2:4] += more
    reach = np.array([long, wide]) + more + MAX_HOLE_M
    axes = []
    for k, first in ((0, heights.x0_m), (1, heights.y0_m)):
        half = float(np.abs(frame[1:, k]) @ reach)
        low, high = ((frame[0, k] + side * half - first) / STEP_M for side in (-1, 1))
        axes.append(first + STEP_M * np.arange(math.floor(low), math.ceil(high) + 1))
    return Region(axes[0], axes[1], frame, parts, np.empty((axes[1].size, axes[0].size), np.uint8))
