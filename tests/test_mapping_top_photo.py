"""The top photo against geometry: a line at the tops' level is in its place over a gap, though the floor was
measured there."""

from __future__ import annotations

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
