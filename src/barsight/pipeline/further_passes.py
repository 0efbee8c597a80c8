"""Tell where a further pass would show what was not seen of refused lifts.

A place that no two views have in sight lay beyond their pictures or behind something; from elsewhere it may
be seen. A place that they have in sight but that has no height, such as the dark ground of a narrow gully,
has none from elsewhere either, so no pass is proposed for it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from barsight.core.arrays import Bool, Float64
from barsight.yard.cameras import Cameras
from barsight.yard.lifting.lift import FurtherPass, Lift, UnseenPlaces
from barsight.yard.lifting.targets import LiftPlan
from barsight.yard.lifting.travel_accuracy import Travel
from barsight.yard.magnet.description import Magnet
from barsight.yard.map_lookup import CellGrid, lookup_heights, nearest_cells
from barsight.yard.placement.clearance import FacePlane, find_obstacle
from barsight.yard.sections import part_about
from barsight.yard.types import Bundle, DoubtKind, HeightMap, YardMap

UNSEEN, OPEN = "unknown-under-footprint", "end-open"
ACROSS = np.array([0.0, 1.0, 0.0])
"""Direction across the travel."""
STEP_M, REACH_M = 0.1, 6.0
"""Distance between the positions that are tried; maximum distance of one from a lift's unseen places."""
MARGIN_M = 1.5
"""Margin around unseen places within which lines of sight are followed."""
GROUND_M = 0.15
"""Distance within which the lowest height seen is the ground of an unseen place. A line of sight to the
ground shows whatever may stand there.
"""
BEYOND_M = 0.3
"""Length beyond an open end of a bundle that is unseen."""
SEEN_VIEWS, SHOWN_VIEWS = 2, 3
"""Number of views with a place in sight from which on it isn't hidden, and that a proposed pass needs."""
HIDDEN_RATIO, SHOWN_RATIO = 0.75, 0.95
"""Minimum shares of the places of each unseen part that are hidden, and that a pass must show."""
MAX_PLACES, MAX_PASSES = 200, 2
"""Approximate maximum number of a part's places that are looked at; maximum number of proposed passes."""
_NOTHING = np.float32(1e6)


@dataclass(frozen=True, eq=False)
class _Unseen:
    """A refused lift. is_shown: (positions,) where a pass would show what was not seen of it."""

    lift: Lift
    is_shown: Bool


def find_unseen(plan: LiftPlan, yard: YardMap, bundles: tuple[Bundle, ...]) -> UnseenPlaces | None:
    """Find the positions across the travel from which a pass would show what was not seen of most refused
    lifts; None where the cameras aren't known.
    """
    travel, by_id = plan.travel, {bundle.id: bundle for bundle in bundles}
    if travel is None or travel.cameras is None or not travel.measured.any():
        return None
    body_m, numbers = _measured_places(travel), travel.passes[travel.measured]
    longest_m = body_m[numbers == np.argmax(np.bincount(numbers))]
    base_y_m = float(np.median(longest_m[:, 1]))
    far_y_m = yard.y0_m + yard.cell_m * yard.shape[0]
    ends = (yard.y0_m - REACH_M - base_y_m, far_y_m + REACH_M - base_y_m)
    shifts_m: Float64 = STEP_M * np.arange(round(ends[0] / STEP_M), round(ends[1] / STEP_M) + 1.0)
    hidden, in_sight = list[_Unseen](), list[int]()
    for lift in plan.refused:
        load = tuple(by_id[number] for number in lift.bundles)
        parts = unseen_places(lift, load, yard, plan.magnet)
        if not parts:
            continue
        about = CellGrid.of(_about(yard, np.concatenate([part[0] for part in parts]), MARGIN_M))
        near_m, longest_near_m = (_near(one, parts, travel.reach_m + MARGIN_M) for one in (body_m, longest_m))
        in_view = [_are_in_view(travel.cameras, near_m, about, part, SEEN_VIEWS) for part in parts]
        if 1 - max(seen.mean() for seen in in_view) < HIDDEN_RATIO:
            in_sight += lift.bundles
            continue
        middle_y_m = float(np.concatenate(parts, axis=1)[0, :, 1].mean())
        shown = np.zeros(shifts_m.size, np.bool_)
        for k in np.flatnonzero(np.abs(base_y_m + shifts_m - middle_y_m) < REACH_M):
            there = longest_near_m + shifts_m[k] * ACROSS
            shown[k] = all(
                _are_in_view(travel.cameras, there, about, part, SHOWN_VIEWS).mean() >= SHOWN_RATIO
                for part in parts
            )
        hidden.append(_Unseen(lift, shown))
    own_y_m = [float(np.median(body_m[numbers == one, 1])) for one in np.unique(numbers)]
    return UnseenPlaces(_choose(hidden, shifts_m, base_y_m, own_y_m), tuple(dict.fromkeys(in_sight)))


def unseen_places(lift: Lift, load: tuple[Bundle, ...], yard: YardMap, magnet: Magnet) -> list[Float64]:
    """List the parts that were not seen for which a lift is refused, each as places (2, N, 3) on the ground
    and at the height of the faces or of the load's top: under or beside the magnet, and beyond each open end
    of the load. None are listed where something lies on an open end.
    """
    codes, found = {veto.code for veto in lift.vetoes}, list[tuple[Float64, float]]()
    reach = np.array([-1.0, 1.0]) * (magnet.half_span_m + MARGIN_M)
    here = part_about(yard, lift.place.x_m + reach, lift.place.y_m + reach)
    if UNSEEN in codes and lift.contact is not None:
        obstacle = find_obstacle(lift.place, here, magnet, FacePlane.of(lift.contact), load)
        if obstacle is not None and obstacle.code == UNSEEN:
            found.append((obstacle.places_m, lift.contact.centre_z_m))
        else:
            faces = _face_places(lift, magnet)
            unseen = faces[np.isnan(lookup_heights(here, faces[:, 0], faces[:, 1]))]
            found.append((unseen, lift.contact.centre_z_m))
    if OPEN in codes:
        for bundle in load:
            if any(doubt.kind is DoubtKind.COVERED_END for doubt in bundle.reasons):
                return []
            found += [(_beyond(bundle, end), bundle.top_z_m) for end in (0, 1) if bundle.ends_open[end]]
    return [_from_ground(yard, places, top_z_m) for places, top_z_m in found if len(places)]


def _from_ground(yard: YardMap, places: Float64, top_z_m: float) -> Float64:
    """Return some of the places (N, 2) on the ground, and over it (2, M, 3)."""
    some = places[:: max(len(places) // MAX_PLACES, 1)]
    ground = _ground(_about(yard, some, GROUND_M), some)
    return np.array([
        np.column_stack([some, z_m]) for z_m in (ground, np.maximum(ground, top_z_m))
    ])  # fmt: skip


def _are_in_view(cameras: Cameras, body_m: Float64, about: CellGrid, part: Float64, min_views: int) -> Bool:
    """Check for places (2, N, 3) whether min_views views show the ground and also what may stand there; (N,).
    The ground beneath a high thing may be seen from the side, where the picture cuts that off.
    """
    found: Bool = np.ones(part.shape[1], np.bool_)
    for level in part:
        found[found] = cameras.count_views(body_m, about, level[found], min_views) == min_views
    return found


def _measured_places(travel: Travel) -> Float64:
    """Return the body's places (F, 3) at the measured frames."""
    places = travel.place_m[travel.measured]
    return np.column_stack([places, np.full(len(places), travel.eye_z_m)])


def _near(body_m: Float64, parts: Sequence[Float64], reach_m: float) -> Float64:
    """Select the body's places (F, 3) from which the parts (2, N, 3) may be in the pictures, by x."""
    x = np.concatenate(parts, axis=1)[0, :, 0]
    near: Float64 = body_m[(body_m[:, 0] > x.min() - reach_m) & (body_m[:, 0] < x.max() + reach_m)]
    return near


def _about(yard: YardMap, places: Float64, margin_m: float) -> HeightMap:
    """Read the map around places (N, 2 or more)."""
    low, high = places.min(axis=0) - margin_m, places.max(axis=0) + margin_m
    return part_about(yard, *(np.array([low[k], high[k]]) for k in (0, 1)))


def _face_places(lift: Lift, magnet: Magnet) -> Float64:
    """List places (N, 2) all over the faces."""
    parts, found = np.linspace(-0.5, 0.5, 15), []
    for along, across, length, width in magnet.pole_table:
        v, u = (a.ravel() for a in np.meshgrid(along + parts * length, across + parts * width))
        found.append(v[:, None] * lift.place.along + u[:, None] * lift.place.across)
    at: Float64 = np.concatenate(found) + np.array([lift.place.x_m, lift.place.y_m])
    return at


def _beyond(bundle: Bundle, end: int) -> Float64:
    """List places (N, 2) just beyond an end of a bundle, as wide as it is."""
    across, along = bundle.axes
    outwards = along * np.sign((bundle.ends_m[end] - bundle.ends_m[1 - end])[:2] @ along)
    v, u = np.meshgrid(np.linspace(0.0, BEYOND_M, 7), np.linspace(-0.5, 0.5, 5) * bundle.width_m)
    at: Float64 = bundle.ends_m[end, :2] + v.reshape(-1, 1) * outwards + u.reshape(-1, 1) * across
    return at


def _ground(heights: HeightMap, places: Float64) -> Float64:
    """Find the lowest height (N,) that was seen within GROUND_M of places (N, 2), else in the whole part; 0
    where nothing was.
    """
    seen = np.where(heights.is_seen, heights.z_m, _NOTHING)
    lowest = cv2.erode(seen, np.ones((2 * round(GROUND_M / heights.cell_m) + 1,) * 2, np.uint8))
    column, row, _ = nearest_cells(heights, places[:, 0], places[:, 1])
    found, whole = lowest[row, column].astype(np.float64), float(seen.min())
    return np.where(found < _NOTHING, found, whole if whole < _NOTHING else 0.0)


def _choose(
    hidden: Sequence[_Unseen], shifts_m: Float64, base_y_m: float, own_y_m: Sequence[float]
) -> tuple[FurtherPass, ...]:
    """Choose the positions, one after the other, from which a pass shows the most lifts that none before it
    does; of several, the one nearest to a pass that was made. A pass a step beside must show them too.
    """
    chosen, left = list[FurtherPass](), list(hidden)
    far_m = np.abs(base_y_m + shifts_m[:, None] - np.array(own_y_m)).min(axis=1)
    while left and len(chosen) < MAX_PASSES:
        sure = np.array([one.is_shown for one in left])
        sure[:, 1:-1] &= sure[:, :-2] & sure[:, 2:]
        counts = sure.sum(axis=0)
        best = int(np.lexsort((far_m, -counts))[0])
        if counts[best] == 0:
            break
        lifts = [one.lift for one, shown in zip(left, sure[:, best], strict=True) if shown]
        alone = [one for one in lifts if {veto.code for veto in one.vetoes} <= {UNSEEN, OPEN}]
        ids = (
            tuple(dict.fromkeys(number for one in some for number in one.bundles)) for some in (lifts, alone)
        )
        y_m, shift_m = (round(float(at), 3) for at in (base_y_m + shifts_m[best], shifts_m[best]))
        chosen.append(FurtherPass(y_m, shift_m, *ids))
        left = [one for one, shown in zip(left, sure[:, best], strict=True) if not shown]
    return tuple(chosen)
