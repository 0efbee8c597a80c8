"""Find where a load can be set down: by its exact outline, on sufficient support, with nothing in its way."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np

from barsight.core.arrays import Float64
from barsight.yard.axes import axes_of
from barsight.yard.events import YardEvent
from barsight.yard.lift_settings import LiftSettings
from barsight.yard.lifting.bearing import (
    HOLE_DEPTH_M,
    MAX_RISE_M,
    Bearing,
    find_bearing,
    magnet_reach,
    magnet_rectangles,
    placing_slack,
)
from barsight.yard.lifting.ground import Ground
from barsight.yard.lifting.travel_accuracy import Travel
from barsight.yard.lifting.validity import old_cells
from barsight.yard.magnet.description import MAX_TURN_DEG, Magnet
from barsight.yard.placement.load import Load, reached_areas
from barsight.yard.stability.stability import Footing
from barsight.yard.types import Bundle

REACH_M = 30.0
"""Maximum distance (m) along X and Y from the load at which places are searched for."""
MAX_TRIED, APART_M = 16, 0.15
"""Maximum number of places per heading that are assessed exactly, and their minimum spacing (m)."""
SMALL_TURNS_DEG = (0.0, 2.5, -2.5, 5.0, -5.0)
"""Turns of the load that are tried, the smallest first."""


@dataclass(frozen=True)
class SetDown:
    """A place for a load in yard axes: the middle of its underside; yaw as a bundle's.

    turn_deg: from its present yaw. slope_deg: of the ground it lies on. support_m: from the first support to
    the last. margin_along_m, margin_across_m: from the load's centre of mass to the end and the side of what
    carries it.
    """

    x_m: float
    y_m: float
    z_m: float
    yaw_deg: float
    turn_deg: float
    slope_deg: float
    support_m: float
    margin_along_m: float
    margin_across_m: float

    @property
    def yaw_rad(self) -> float:
        """Return the yaw in rad, as in the rest of the yard."""
        return math.radians(self.yaw_deg)


def find_set_down(ground: Ground, load: Load, magnet: Magnet, settings: LiftSettings) -> SetDown | None:
    """Find the place with the smallest turn, among these the lowest, then the nearest. None where there is
    none, or where the load would roll. The magnet's offset must be known at its yaw there.
    """
    if load.rolls:
        return None
    ground = ground.about(load.x_m, load.y_m, REACH_M)
    free, offset = ground.apart_from(load), magnet.offset
    for turn in _turns(settings.max_turn_deg):
        yaw = load.yaw_rad + math.radians(turn)
        if offset is not None and offset.turn_deg(offset.beam_yaw(yaw)) > MAX_TURN_DEG:
            continue
        yaw -= math.pi * math.ceil(yaw / math.pi - 0.5)
        for x, y in _candidates(free, load, yaw, settings):
            bearing = find_bearing(ground.yard, load, x, y, yaw, magnet, settings)
            if (
                bearing is not None
                and not _reaches_area(load, x, y, yaw, magnet, settings)
                and not _magnet_meets(ground, load, x, y, yaw, bearing, magnet)
            ):
                return _place(bearing, x, y, yaw, turn)
    return None


def _magnet_meets(
    ground: Ground, load: Load, x_m: float, y_m: float, yaw_rad: float, bearing: Bearing, magnet: Magnet
) -> bool:
    """Check whether the magnet may meet what the map's heights don't show: a load that was put down before,
    or something in a place about which nothing is known any more.
    """
    over = np.array([x_m, y_m]) + (load.off_across_m, load.off_along_m) @ axes_of(yaw_rad)
    for wide, long, over_m in magnet_rectangles(load, magnet, placing_slack(load, yaw_rad, magnet)):
        size = replace(load, width_m=2 * wide, length_m=2 * long)
        high = ground.top_m > bearing.z_m + load.min_height_m + over_m
        if (high & ground.inside(size, float(over[0]), float(over[1]), yaw_rad, 0.0)).any():
            return True
    return False


def _reaches_area(
    load: Load, x_m: float, y_m: float, yaw_rad: float, magnet: Magnet, settings: LiftSettings
) -> bool:
    """Check whether the load set down, or the magnet wherever it may hold it, may reach a no-lift area."""
    middle, (wide, long) = np.array([x_m, y_m]), 2 * magnet_reach(load, magnet)
    sizes = (load.width_m, load.length_m), (float(wide), float(long))
    return any(reached_areas(middle, yaw_rad, size, magnet.tolerance, settings) for size in sizes)


def sound_ground(
    ground: Ground, bundles: tuple[Bundle, ...], standing: tuple[Footing, ...], settings: LiftSettings,
    events: tuple[YardEvent, ...] = (), travel: Travel | None = None, now_ns: int = 0,
) -> Ground:  # fmt: skip
    """Bar the ground that shouldn't be loaded: leaning bundles, bundles over an edge, doubtful ones, and
    no-lift areas. Stanchions stand as high as the settings say, even where the map doesn't show them. Nothing
    is known any more within reach of an event in the yard, or where the last sight is too old at now_ns.
    """
    footings = {footing.bundle: footing for footing in standing}
    for bundle in bundles:
        footing = footings[bundle.id]
        leans = footing.overhang_side and footing.overhang_m > 0
        if leans or bundle.confidence < settings.min_confidence:
            ground = ground.apart_from(Load.of((bundle,)))
    for x_min, y_min, x_max, y_max in settings.no_lift_areas:
        ground = ground.barring(ground.within(x_min, y_min, x_max, y_max))
    for x, y, z in settings.stanchions:
        ground = ground.with_load(ground.within(x, y, x, y), z)
    for event in events:
        yaw_rad, reach_m = math.radians(event.yaw_deg), settings.disturbed_reach_m
        ground = ground.forgetting(ground.inside(event, event.x_m, event.y_m, yaw_rad, reach_m))
    if travel is not None:
        ground = ground.forgetting(old_cells(ground, travel, now_ns, settings))
    return ground


def _turns(max_deg: float) -> Iterator[float]:
    yield from (turn for turn in SMALL_TURNS_DEG if abs(turn) <= max_deg)
    if max_deg >= 90:
        yield 90.0


def _candidates(
    ground: Ground, load: Load, yaw_rad: float, settings: LiftSettings
) -> Iterator[tuple[float, float]]:
    """Propose places (x, y) that no coarse cell rules out: the lowest first, and among these the nearest."""
    top, shut, low = ground.turned(yaw_rad)
    cell, margin = ground.cell_m, settings.set_down_clear_m
    # Odd, and no more than a cell wider than the clear outline.
    size = tuple(int((side + 2 * margin) / cell) | 1 for side in (load.width_m, load.length_m))
    if size[0] > top.shape[1] or size[1] > top.shape[0]:
        return
    # A gully between two cells that carry may be up to three cells wide.
    closed = cv2.morphologyEx(top, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    window = np.ones((max(size[1] - 2, 1), max(size[0] - 2, 1)), np.uint8)
    highest = cv2.dilate(top, window)
    lowest = cv2.erode(closed, window)
    fits = highest - lowest < HOLE_DEPTH_M + 2 * MAX_RISE_M
    fits &= cv2.dilate(shut.astype(np.uint8), window, borderType=cv2.BORDER_CONSTANT, borderValue=1) == 0
    row, column = np.nonzero(fits)
    if not row.size:
        return
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    u, v = low[0] + cell * column, low[1] + cell * row
    places = np.stack([u * cos - v * sin, u * sin + v * cos], axis=1)
    away = np.linalg.norm(places - (load.x_m, load.y_m), axis=1)
    left: Float64 = places[np.lexsort((away, np.round(highest[row, column], 1)))]
    for _ in range(MAX_TRIED):
        if not len(left):
            return
        yield float(left[0, 0]), float(left[0, 1])
        left = left[np.abs(left - left[0]).max(axis=1) >= APART_M]


def _place(bearing: Bearing, x_m: float, y_m: float, yaw_rad: float, turn_deg: float) -> SetDown:
    return SetDown(
        x_m, y_m, bearing.z_m, math.degrees(yaw_rad), turn_deg, bearing.slope_deg, bearing.support_m,
        bearing.margin_along_m, bearing.margin_across_m,
    )  # fmt: skip
