"""Assess one place for a load: what supports it there, how level it lies, what stands around it."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import cv2
import numpy as np

from barsight.core.arrays import Bool, Float32, Float64
from barsight.yard.axes import axes_of
from barsight.yard.lift_settings import LiftSettings
from barsight.yard.magnet.description import Magnet
from barsight.yard.magnet.resting_plane import rest_plane
from barsight.yard.map_lookup import nearest_cells
from barsight.yard.placement.load import Load
from barsight.yard.sections import part_about
from barsight.yard.types import YardMap
from barsight.yard.unseen import wide_parts

STEP_M = 0.02
SMOOTH_M, NARROW_M = 0.05, 0.03
"""Sides (m) of the squares over which heights are medians, against wrong matches; narrow for thin objects."""
STATION_STEPS = 5
"""Steps along the load per station. A station is as high as its highest step, which carries the load."""
NEAR_M = 0.02
"""Maximum distance (m) of a station below the underside at which it still carries the load."""
LEVEL_M = 0.01
"""Maximum height difference (m) across the load within the part of a station that holds it upright."""
MIN_ACROSS_RATIO = 1 / 6
"""Minimum distance, in widths, from the centre of mass to either side over which a station must carry."""
MIN_ALONG_RATIO = 0.2
"""Minimum distance, in lengths, from the centre of mass to either end that the supports must reach."""
MAX_SPAN_RATIO = 0.65
"""Maximum distance, in lengths, between successive supports."""
MAX_ALONG_DEG, MAX_ACROSS_DEG = 2.0, 3.0
MAX_HOLE_M, HOLE_DEPTH_M = 0.14, 0.15
"""Maximum width (m) of a gully between bars, which dunnage bridges, and maximum depth (m) of a hollow that
doesn't matter: what is wider and deeper is a hole.
"""
_HOLE_STEPS = round(MAX_HOLE_M / STEP_M) | 1
MAX_UNSEEN_CELLS = 3
"""Width, in steps, of an unseen place from which on it may hide an obstacle."""
UNSEEN_REACH_CELLS = 9
"""Side, in cells, of the square about an unseen cell whose highest one is taken for it."""
MAX_RISE_M = 0.03
"""Maximum rise (m) over the underside of something beside the load that doesn't touch it."""
MAX_THIN_RISE_M, MIN_THIN_CELLS = 0.1, 6
"""The same for thin objects, such as plates on edge, and their minimum number of connected steps."""


@dataclass(frozen=True)
class Bearing:
    """Support of a load at a place. z_m: its underside at the middle, over its dunnage. slope_deg: of the
    underside. support_m: from the first support to the last. margin_along_m, margin_across_m: from the load's
    centre of mass to the nearer end and side of what carries it, minimum within the crane's tolerance.
    """

    z_m: float
    slope_deg: float
    support_m: float
    margin_along_m: float
    margin_across_m: float


@dataclass(frozen=True, eq=False)
class Surroundings:
    """Heights (V, U) about a place, on a grid along (v_m) and across (u_m) the load.

    z_m: medians over squares of SMOOTH_M, which wrong matches don't affect. thin_m: over NARROW_M, for thin
    objects. Where a few cells weren't seen, both have the highest value nearby; hidden: unseen places wide
    enough to hide an obstacle. free_m: upper bound, by lines of sight, of what may stand there, inf where
    none passed.
    """

    v_m: Float64
    u_m: Float64
    z_m: Float32
    thin_m: Float32
    hidden: Bool
    free_m: Float32


def find_bearing(
    yard: YardMap, load: Load, x_m: float, y_m: float, yaw_rad: float, magnet: Magnet, settings: LiftSettings
) -> Bearing | None:
    """Find how the load rests at a place and everywhere within the crane's tolerance; None where it doesn't
    rest stably, or where something may obstruct it.
    """
    axes, slack = axes_of(yaw_rad), placing_slack(load, yaw_rad, magnet)
    around = _surroundings(yard, load, (x_m, y_m), yaw_rad, slack + settings.set_down_clear_m, magnet)
    clear = _within(around, load, slack + settings.set_down_clear_m)
    if (around.hidden & clear).any():
        return None
    carrying = around.z_m
    if settings.dunnage_m > 0:
        carrying = cv2.morphologyEx(carrying, cv2.MORPH_CLOSE, np.ones((1, _HOLE_STEPS), np.uint8))
    middle = _rest(around, carrying, load, 0.0, 0.0)
    if middle is None or _stands_in_the_way(around, clear, middle.z_m, load, slack, magnet):
        return None
    rests = [middle]
    for du, dv in itertools.product((-slack[0], slack[0]), (-slack[1], slack[1])):
        shifted = _rest(around, carrying, load, float(du), float(dv))
        if shifted is None:
            return None
        rests.append(shifted)
    low, high = min(one.z_m for one in rests), max(one.z_m for one in rests)
    outline = _within(around, load, slack)
    if _stands_in_the_way(around, clear, low, load, slack, magnet) or _has_hole(around.z_m, outline, high):
        return None
    high += settings.dunnage_m
    if _stanchion_in_the_way(load, (x_m, y_m), axes, slack, high + load.height_m, settings):
        return None
    return Bearing(
        high,
        max(one.slope_deg for one in rests),
        min(one.support_m for one in rests),
        min(one.margin_along_m for one in rests),
        min(one.margin_across_m for one in rests),
    )


def _surroundings(
    yard: YardMap, load: Load, place: tuple[float, float], yaw_rad: float, margin: Float64, magnet: Magnet
) -> Surroundings:
    """Sample the heights under the load, under the magnet over it, and in a margin (across, along)."""
    wide, long = np.maximum((load.width_m / 2, load.length_m / 2), magnet_reach(load, magnet)) + margin
    v, u = (STEP_M * np.arange(-math.ceil(a / STEP_M), math.ceil(a / STEP_M) + 1) for a in (long, wide))
    across, along = axes_of(yaw_rad)
    x, y = (place[k] + v[:, None] * along[k] + u[None] * across[k] for k in (0, 1))
    part = part_about(yard, x, y)
    column, row, inside = nearest_cells(part, x, y)
    seen = part.is_seen
    lowest = np.where(seen, part.z_m, np.float32(-1e3))
    nearby = cv2.dilate(lowest, np.ones((UNSEEN_REACH_CELLS,) * 2, np.uint8))
    filled = np.where(seen, part.z_m, nearby).astype(np.float32)
    # Steps skip no thin object that is at least two cells wide, as medians leave them.
    skipped = 2 * math.ceil(max(STEP_M / 2 / part.cell_m - 1, 0) - 1e-6) + 1
    smooth, narrow = (_medians(filled, side_m, part.cell_m) for side_m in (SMOOTH_M, NARROW_M))
    narrow = cv2.dilate(narrow, np.ones((skipped, skipped), np.uint8))
    z, thin = (np.where(inside, one[row, column], nearby[row, column]) for one in (smooth, narrow))
    free = np.full(part.shape, np.inf, np.float32) if part.free_m is None else part.free_m
    free = np.where(inside, free[row, column], np.float32(np.inf)).astype(np.float32)
    hidden = wide_parts(~(inside & seen[row, column]), MAX_UNSEEN_CELLS) > 0
    return Surroundings(v, u, z, thin, hidden, free)


def _medians(z: Float32, side_m: float, cell_m: float) -> Float32:
    """Compute medians of a map (rows, columns) over squares of at most side_m, and at most 5 cells."""
    side = min((int(side_m / cell_m + 1e-6) - 1) // 2 * 2 + 1, 5)
    return np.asarray(cv2.medianBlur(z, side) if side > 1 else z, np.float32)


def placing_slack(load: Load, yaw_rad: float, magnet: Magnet) -> Float64:
    """Return the maximum error (2,), across and along (m), with which the crane puts down a load."""
    slack = magnet.tolerance.along(axes_of(yaw_rad))
    slack[0] += load.length_m / 2 * math.radians(magnet.tolerance.yaw_deg)
    return slack


def magnet_rectangles(load: Load, magnet: Magnet, slack: Float64) -> list[tuple[float, float, float]]:
    """List where poles and beam may be over a load: half width and half length about its centre of mass, and
    how far something may rise there over the load's top (m).
    """
    aside, beam = slack + _held_off(load, magnet), magnet.beam
    return [
        *(
            (abs(pole.across_m) + pole.width_m / 2 + aside[0], magnet.half_span_m + aside[1], 0.0)
            for pole in magnet.poles
        ),
        (beam.width_m / 2 + aside[0], beam.length_m / 2 + aside[1], beam.above_faces_m / 2),
    ]


def magnet_reach(load: Load, magnet: Magnet) -> Float64:
    """Return how far (2,) the magnet may reach from the load's middle, across and along (m)."""
    off = np.abs((load.off_across_m, load.off_along_m))
    return np.asarray(np.array(magnet.size_m) / 2 + _held_off(load, magnet) + off)


def _held_off(load: Load, magnet: Magnet) -> Float64:
    """Return how far (2,) from the load's centre of mass, across and along (m), the magnet may hold it."""
    limits = magnet.limits
    most = limits.offset_across_m, limits.offset_along_m
    return np.minimum(most, (load.width_m / 2, load.length_m / 2))


def _within(around: Surroundings, load: Load, margin: Float64) -> Bool:
    """Mark the cells (V, U) under the load and in a margin (across, along) around it."""
    long = np.abs(around.v_m) <= load.length_m / 2 + margin[1]
    return np.asarray(long[:, None] & (np.abs(around.u_m) <= load.width_m / 2 + margin[0]))


def _rest(around: Surroundings, carrying: Float32, load: Load, du: float, dv: float) -> Bearing | None:
    """Rest the load's underside, taken as a flat strip of half its width, at an offset (m) from the place."""
    rows = np.abs(around.v_m - dv) <= load.length_m / 2
    columns = np.abs(around.u_m - du) <= max(load.width_m / 4, STEP_M)
    count = rows.sum() // STATION_STEPS
    first = int(np.argmax(rows))
    strip = carrying[first : first + count * STATION_STEPS][:, columns]
    stations = strip.reshape(count, STATION_STEPS, -1).max(axis=1).astype(np.float64)
    # The load comes to rest about its centre of mass.
    v = around.v_m[first : first + count * STATION_STEPS].reshape(count, -1).mean(axis=1)
    v, u = v - dv - load.off_along_m, around.u_m[columns] - du - load.off_across_m
    vv, uu = np.meshgrid(v, u, indexing="ij")
    height, roll, pitch = rest_plane(uu.ravel(), vv.ravel(), stations.ravel(), math.tan(math.radians(10)))
    if (
        abs(math.degrees(math.atan(pitch))) > MAX_ALONG_DEG
        or abs(math.degrees(math.atan(roll))) > MAX_ACROSS_DEG
    ):
        return None
    gap = height + roll * uu + pitch * vv - stations
    level = gap <= gap.min(axis=1, keepdims=True) + LEVEL_M
    to_low, to_high = (np.where(level, side * uu, -np.inf).max(axis=1) for side in (-1, 1))
    across = np.minimum(to_low, to_high)
    carries = (gap.min(axis=1) <= NEAR_M) & (across >= MIN_ACROSS_RATIO * load.width_m)
    if carries.sum() < 2:
        return None
    at = v[carries]
    margin = min(-float(at[0]), float(at[-1]))
    span = float(np.diff(at).max())
    if margin < MIN_ALONG_RATIO * load.length_m or span > MAX_SPAN_RATIO * load.length_m:
        return None
    slope = math.degrees(math.atan(math.hypot(roll, pitch)))
    height -= roll * load.off_across_m + pitch * load.off_along_m
    return Bearing(height, slope, float(at[-1] - at[0]), margin, float(across[carries].min()))


def _stands_in_the_way(
    around: Surroundings, clear: Bool, low_m: float, load: Load, slack: Float64, magnet: Magnet
) -> bool:
    """Check for obstacles above the underside beside the load, or under the magnet above the load's top."""
    z = around.z_m
    if (clear & (z > low_m + MAX_RISE_M)).any():
        return True
    over = (clear & (around.thin_m > low_m + MAX_THIN_RISE_M)).astype(np.uint8)
    if (
        cv2.connectedComponentsWithStats(over, connectivity=8)[2][1:, cv2.CC_STAT_AREA] >= MIN_THIN_CELLS
    ).any():
        return True
    beside = np.abs(around.u_m - load.off_across_m)[None]
    beyond = np.abs(around.v_m - load.off_along_m)[:, None]
    for half_width, half_length, over_m in magnet_rectangles(load, magnet, slack):
        under = (beside <= half_width) & (beyond <= half_length)
        height = low_m + load.min_height_m + over_m
        if (under & np.where(around.hidden, ~(around.free_m <= height), z > height)).any():
            return True
    return False


def _has_hole(z: Float32, outline: Bool, high_m: float) -> bool:
    """Check for a hole under the load that is deep, and wider than a gully between bars."""
    closed = cv2.morphologyEx(z, cv2.MORPH_CLOSE, np.ones((_HOLE_STEPS, _HOLE_STEPS), np.uint8))
    return bool((outline & (closed < high_m - HOLE_DEPTH_M)).any())


def _stanchion_in_the_way(
    load: Load,
    place: tuple[float, float],
    axes: Float64,
    slack: Float64,
    top_m: float,
    settings: LiftSettings,
) -> bool:
    """Check for a stanchion that the load would touch, or that isn't high enough to hold it."""
    for x, y, z in settings.stanchions:
        away = np.abs(axes @ (np.array([x, y]) - place)) - slack
        beyond = away - (load.width_m / 2, load.length_m / 2)
        apart = float(np.linalg.norm(np.maximum(beyond, 0)))
        if apart < settings.set_down_clear_m:
            return True
        if apart < settings.beside_stanchion_m and z - top_m < settings.min_freeboard_m:
            return True
    return False
