"""The top photo against geometry: a line at the tops' level is in its place over a gap, though the floor was
measured there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from barsight.core.pose import Pose
from barsight.core.records.pairs import RectifiedCamera, RectifiedPair
from barsight.mapping.observation import CellObservations
from barsight.mapping.top_photo import OVER_TOPS_M, TopPhoto

CELL_M, TOP_M, EYE_M = 0.01, 0.5, 7.5
CAMERA = RectifiedCamera(600.0, 159.5, 119.5, 0.5, 0.0, 320, 240)
DOWN = np.diag([1.0, -1.0, -1.0])


def seen() -> CellObservations:
    """Two bundles and a gap of 0.2 m between them, down to the floor, of which half of the cells are seen."""
    x, y = (a.ravel().astype(np.int32) for a in np.meshgrid(np.arange(-60, 60), np.arange(-50, 50)))
    gap = np.abs(x) < 10
    keep = ~gap | (y % 2 == 0)
    z = np.where(gap, 0.0, TOP_M).astype(np.float32)
    nothing = np.zeros(int(keep.sum()), np.float32)
    return CellObservations(x[keep], y[keep], np.ones(nothing.size, bool), z[keep], *[nothing] * 3)


def view(x_m: float) -> tuple[RectifiedPair, Pose]:
    """View of a pair over x_m, of a line 0.02 m wide along X on the tops: gray 200 on 50, without the left
    picture's first columns."""
    pose = Pose("yard", "rect0", DOWN, np.array([x_m, 0.1, EYE_M]))
    v = np.arange(CAMERA.height)[:, None] + np.zeros(CAMERA.width)
    y = 0.1 - (v - CAMERA.cy_px) * (EYE_M - TOP_M - OVER_TOPS_M) / CAMERA.focal_px
    gray = (50 + 150 * np.clip(1.5 - np.abs(y) / 0.01, 0, 1)).astype(np.uint8)
    valid = np.ones(gray.shape, bool)
    valid[:, :20] = False
    return RectifiedPair(0, gray, gray, valid, np.ones_like(valid), CAMERA), pose


def test_what_lies_on_the_tops_is_sharp_over_a_gap_where_only_the_floor_was_measured() -> None:
    photo = TopPhoto(CELL_M)
    for x_m in (-0.6, -0.2, 0.2):
        photo.add(seen(), *view(x_m))
    tops = photo.window(-40, -45, 80, 90).astype(float)
    assert tops.min() > 0
    line, beside = tops[45], tops[[38, 52]]
    assert line.min() > 180 and beside.max() < 70


def test_what_no_picture_shows_stays_unknown() -> None:
    photo = TopPhoto(CELL_M)
    assert not photo.window(0, 0, 5, 5).any()
    photo.add(seen(), *view(-5.0))
    assert not photo.window(-40, -45, 80, 90).any()


def test_what_lies_beside_the_border_of_a_picture_is_in_its_place() -> None:
    """Seen obliquely, tops that the unseen ground beyond lowered would show a line 0.1 m off."""
    whole = seen()
    keep = (whole.y <= 13) | (whole.x < -50)
    names = ("x", "y", "central", "z_m", "variance_m2", "shared_m", "intensity")
    cells = CellObservations(*(getattr(whole, name)[keep] for name in names))
    camera, eye = replace(CAMERA, height=480, cy_px=239.5), np.array([0.0, -2.3, EYE_M])
    v = np.arange(camera.height)[:, None] + np.zeros(camera.width)
    y = eye[1] - (v - camera.cy_px) * (EYE_M - TOP_M - OVER_TOPS_M) / camera.focal_px
    gray = (50 + 150 * np.clip(1.5 - np.abs(y - 0.1) / 0.01, 0, 1)).astype(np.uint8)
    valid = np.ones(gray.shape, bool)
    photo = TopPhoto(CELL_M)
    photo.add(cells, RectifiedPair(0, gray, gray, valid, valid, camera), Pose("yard", "rect0", DOWN, eye))
    rows = photo.window(-30, -20, 15, 34).argmax(axis=0) - 20
    assert np.abs(rows - 10).max() <= 1


def test_what_is_seen_beneath_a_top_that_the_border_cuts_off_is_no_photo_of_it() -> None:
    """The picture ends at y = 0.1 on a bundle's top, and at 0.26 on the floor, which shows beside it."""
    x, y = (a.ravel().astype(np.int32) for a in np.meshgrid(np.arange(-30, 120), np.arange(-50, 90)))
    z = np.where((x < 30) & (y < 10), TOP_M, 0.0).astype(np.float32)
    nothing = np.zeros(x.size, np.float32)
    cells = CellObservations(x, y, np.ones(x.size, bool), z, *[nothing] * 3)
    eye = np.array([0.0, -2.3, EYE_M])
    ratio = (0.1 - eye[1]) / (EYE_M - TOP_M)
    camera = replace(CAMERA, width=640, height=480, cy_px=ratio * CAMERA.focal_px)
    gray = np.full((camera.height, camera.width), 50, np.uint8)
    photo = TopPhoto(CELL_M)
    photo.add(
        cells, RectifiedPair(0, gray, gray, gray > 0, gray > 0, camera), Pose("yard", "rect0", DOWN, eye)
    )
    assert photo.window(-30, -20, 60, 25).all() and not photo.window(-30, 15, 60, 60).any()
    assert photo.window(95, -20, 20, 44).all(), "far from the bundle the floor is seen to the border"
