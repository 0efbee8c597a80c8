"""Unseen places of refused lifts, against geometry: from where a pass shows them, and where none does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from barsight.core.arrays import Float64, Int64
from barsight.core.pose import Pose
from barsight.core.records.pairs import RectifiedCamera
from barsight.pipeline.further_passes import BEYOND_M, STEP_M, find_unseen
from barsight.yard.cameras import BORDER_PX, Cameras
from barsight.yard.lifting.lift import FurtherPass, UnseenPlaces
from barsight.yard.lifting.targets import LiftPlan, plan_lifts
from barsight.yard.lifting.travel_accuracy import Travel
from barsight.yard.map_lookup import CellGrid
from barsight.yard.types import Bundle, HeightMap
from lift_yards import LENGTH_M, MAGNET, SETTINGS, bare, laid, map_of, record, sure_travel

CAMERA = RectifiedCamera(1000.0, 499.5, 349.5, 0.5, 0.0, 1000, 700)
DOWN = np.diag([1.0, -1.0, -1.0])
EYE_M = 8.0
REACH = (349.5 - BORDER_PX) / 1000
"""Tangent to the picture's border across the travel."""


def cameras() -> Cameras:
    """A pair that looks straight down, its baseline along the travel, the left one under the body."""
    return Cameras.of(
        Pose("yard", "body", np.eye(3), np.zeros(3)), Pose("body", "rect0", DOWN, np.zeros(3)), CAMERA
    )


def travel(y_m: float) -> Travel:
    """Travel along X at y_m, five frames over three metres."""
    places = np.column_stack([np.linspace(-1.2, 1.8, 5), np.full(5, y_m)])
    return replace(sure_travel(places, np.arange(1, 6) * 10**9), cameras=cameras())


def count_views(body_m: Float64, heights: HeightMap, places_m: Float64, enough: int = 9) -> Int64:
    return cameras().count_views(body_m, CellGrid.of(heights), places_m, enough)


def planned(heights: HeightMap, bundle: Bundle, way: Travel) -> LiftPlan:
    return plan_lifts(heights, (bundle,), MAGNET, SETTINGS, (), way, 5 * 10**9)


def test_a_view_shows_what_both_pictures_hold_and_nothing_hides() -> None:
    wall = map_of([])
    wall.z_m[:] = 0.0
    row = round((0.5 - wall.y0_m) / wall.cell_m)
    wall.z_m[row : row + 3, :] = 2.0
    ground = np.array([[0.0, 0.8, 0.0], [0.0, 0.2, 0.0], [0.0, 0.2, 2.5]])
    for y_m, shown in ((-1.5, [0, 1, 1]), (2.5, [1, 0, 0]), (4.0, [0, 0, 0])):
        body = np.array([[0.1, y_m, EYE_M]])
        assert count_views(body, wall, ground).tolist() == shown
    left, right = (np.array([[x, 0.0, EYE_M]]) for x in (-3.85, 3.45))
    flat = replace(wall, z_m=np.zeros_like(wall.z_m))
    place = np.zeros((1, 3))
    assert count_views(left, flat, place) == 1 and count_views(right, flat, place) == 0
    assert count_views(np.concatenate([left] * 3), flat, place) == 3
    assert count_views(np.concatenate([right, *[left] * 3]), flat, place, enough=2) == 2
    unknown = replace(wall, z_m=np.full_like(wall.z_m, np.nan))
    assert count_views(np.array([[0.1, -1.5, EYE_M]]), unknown, ground).tolist() == [1, 1, 1]


def test_an_end_beyond_the_pictures_is_shown_from_nearer_to_it() -> None:
    one, way = laid(0.3), travel(-1.0)
    heights = bare(map_of([one]))
    heights.z_m[heights.y_m > -1.0 + REACH * EYE_M] = np.nan
    bundle = record(one, ends_open=(False, True))
    plan = planned(heights, bundle, way)
    assert "end-open" in {veto.code for veto in plan.refused[0].vetoes}
    unseen = find_unseen(plan, heights, (bundle,))
    assert unseen is not None and unseen.in_sight == () and len(unseen.passes) == 1
    (further,) = unseen.passes
    nearest_m = LENGTH_M / 2 + BEYOND_M - REACH * (EYE_M - one.top_z_m)
    # A step beside, the pass must show the end too.
    assert nearest_m + STEP_M <= further.y_m < nearest_m + 2.1 * STEP_M
    assert further.shift_m == pytest.approx(further.y_m + 1.0) and further.bundles == (0,)
    assert "towards +y" in unseen.sentences[0] and f"y {further.y_m:.1f} m" in unseen.sentences[0]
    assert find_unseen(replace(plan, travel=replace(way, cameras=None)), heights, (bundle,)) is None


def test_no_pass_is_proposed_for_what_the_pictures_show_without_a_height() -> None:
    one = laid(0.3)
    heights = bare(map_of([one]))
    x, y = np.meshgrid(heights.x_m, heights.y_m)
    heights.z_m[(np.abs(x - 0.3 - one.width_m / 2 - 0.05) < 0.045) & (np.abs(y) < 0.4)] = np.nan
    heights.source[np.isnan(heights.z_m)] = 0
    bundle = record(one)
    plan = planned(heights, bundle, travel(0.0))
    assert {veto.code for veto in plan.refused[0].vetoes} == {"unknown-under-footprint"}
    assert find_unseen(plan, heights, (bundle,)) == UnseenPlaces((), (0,))
    far = find_unseen(planned(heights, bundle, travel(-3.5)), heights, (bundle,))
    assert far is not None and far.passes[0].bundles == (0,) and far.in_sight == ()


def test_only_views_near_a_lift_are_followed(monkeypatch: pytest.MonkeyPatch) -> None:
    """All of a yard's were, for each lift: 5.7 s for 8 lifts and 4400 frames, now 0.1 s."""
    one, way, followed = laid(0.3), travel(-1.0), []
    heights = bare(map_of([one]))
    heights.z_m[heights.y_m > -1.0 + REACH * EYE_M] = np.nan
    bundle, count = record(one, ends_open=(False, True)), Cameras.count_views

    def counted(self: Cameras, body_m: Float64, grid: CellGrid, places_m: Float64, enough: int) -> Int64:
        followed.append(len(body_m))
        return count(self, body_m, grid, places_m, enough)

    monkeypatch.setattr(Cameras, "count_views", counted)
    plan = planned(heights, bundle, way)
    further = np.column_stack([np.linspace(20.0, 900.0, 2000), np.full(2000, -1.0)])
    more = sure_travel(np.concatenate([way.place_m, further]), np.arange(1, 2006) * 10**9)
    far = replace(plan, travel=replace(more, cameras=cameras()))
    assert (
        find_unseen(far, heights, (bundle,)) == find_unseen(plan, heights, (bundle,)) != UnseenPlaces((), ())
    )
    assert set(followed) == {5}


def test_the_cameras_are_read_as_they_were_written() -> None:
    way = travel(0.0)
    again = Travel.read({"travel": way.content()})
    assert again is not None and cameras().is_like(again.cameras)
    aside = replace(cameras(), eyes_m=cameras().eyes_m + 0.6)
    joined = (Travel.joined([way, replace(way, cameras=one)]) for one in (cameras(), aside, None))
    assert [one.cameras is not None for one in joined] == [True, False, False]
    old = way.content()
    del old["cameras"]
    without = Travel.read({"travel": old})
    assert without is not None and without.cameras is None
    assert Travel.read({"travel": way.content() | {"cameras": {"eyes_m": [[1.0]]}}}) is None


def test_each_lift_is_told_what_would_show_it() -> None:
    unseen = UnseenPlaces((FurtherPass(-1.6, -1.75, (3, 4), (4,)),), (5,))
    assert unseen.sentences[0] == (
        "A pass with the cameras at y -1.6 m (the trolley 1.8 m towards -y) would show what was not seen of "
        "2 refused bundles (3, 4); nothing else is known to forbid 1 of them."
    )
    assert "1 refused bundle (5) lies in the pictures" in unseen.sentences[1]
    assert unseen.sentence_for([4]).endswith("would show what was not seen.")
    assert unseen.sentence_for([5]).startswith("What was not seen lies in") and not unseen.sentence_for([6])
