"""Unseen gullies between bundles are proven free by the pictures only where nothing stands in them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from barsight.bundle_pictures import space_carving
from barsight.bundle_pictures.space_carving import CarvingViews, carve_cells
from barsight.core.pose import Pose
from barsight.labels.placing import PlacedCamera
from barsight.yard.map_lookup import CellGrid

CELL_M, TOP_M, FOCAL_PX, EYE_M = 0.01, 0.4, 900.0, 8.0
GULLY_M = 0.02
"""Half the width of the gully, about x = 0, between two bundles."""
BOUND_M = TOP_M + 0.1
ALONG_M = np.arange(-2.4, 2.41, 0.3)


def ray_levels(x_m: np.ndarray, eye_m: float, thing: tuple[float, float, float, float] | None) -> np.ndarray:
    """Trace rays that pass over the places x_m at TOP_M: bright tops and flanks, dark from 0.1 m below the
    tops on. thing: its left and right border, its top and its level.
    """
    slope = (x_m - eye_m) / (EYE_M - TOP_M)
    depth = np.where(
        np.abs(slope) > 1e-9, (GULLY_M - np.sign(slope) * x_m) / np.maximum(np.abs(slope), 1e-9), 9
    )
    level = np.where(np.abs(x_m) > GULLY_M, 120.0 + 30 * np.sin(300 * x_m), np.where(depth < 0.1, 90.0, 10.0))
    if thing is not None:
        left, right, top, gray = thing
        at = x_m + (TOP_M - top) * slope
        level = np.where((at > left) & (at < right), gray, level)
    return level


def drawn_views(
    thing: tuple[float, float, float, float] | None = None, gains: np.ndarray | None = None
) -> CarvingViews:
    """Draw the pictures of cameras that look down from ALONG_M."""
    pictures, projections, eyes = [], [], []
    for k, x_m in enumerate(ALONG_M):
        eye = np.array([x_m, 0.0, EYE_M])
        camera = PlacedCamera(Pose("map", "rect", np.diag([1.0, -1.0, -1.0]), eye), FOCAL_PX, (320.0, 20.0))
        columns = np.arange(640)
        on_top = x_m + (columns - 320.0) / FOCAL_PX * (EYE_M - TOP_M)
        row = ray_levels(on_top, x_m, thing) * (1.0 if gains is None else gains[k])
        pictures.append(np.tile(np.clip(row, 1, 255).astype(np.uint8), (40, 1)))
        projections.append(camera.projection)
        eyes.append(eye)
    around = np.stack([np.full((5, 80), picture.mean(), np.uint8) for picture in pictures])
    return CarvingViews(np.stack(pictures), around, np.stack(projections), np.stack(eyes))


def carved(views: CarvingViews, heights: CellGrid | None = None) -> np.ndarray:
    """Carve the gully's cells; mark those that are proven free down to the tops."""
    x_m = np.arange(-0.01, 0.011, CELL_M)
    places = np.stack([x_m, np.zeros(x_m.size), np.full(x_m.size, BOUND_M)], axis=1)
    if heights is None:
        heights = CellGrid(-2.0, -0.1, CELL_M, np.full((20, 400), np.nan, np.float32), -np.inf)
    bound = carve_cells(places, np.full(x_m.size, TOP_M, np.float32), views, heights)
    assert (bound <= np.float32(BOUND_M)).all()
    return bound < TOP_M + 0.011


def test_an_empty_gully_is_proven_free() -> None:
    assert carved(drawn_views()).all()


@pytest.mark.parametrize("gray", [10.0, 40.0, 90.0, 150.0])
@pytest.mark.parametrize("over_m", [0.015, 0.06])
def test_a_thing_in_the_gully_is_not_proven_away(gray: float, over_m: float) -> None:
    free = carved(drawn_views((-0.015, 0.016, TOP_M + over_m, gray)))
    assert not free.any()


def test_lamps_that_flicker_prove_nothing() -> None:
    """A plate that is bright in some pictures and dark in others is no gully."""
    gains = np.where(np.arange(ALONG_M.size) % 2 == 0, 1.0, 0.3)
    assert not carved(drawn_views((-0.04, 0.041, TOP_M + 0.02, 120.0), gains)).any()


def test_views_that_the_map_blocks_do_not_count() -> None:
    """A plate is seen by all; where a pile beside it hides it from half the cameras, these see the pile."""
    plate = (-0.04, 0.041, TOP_M + 0.02, 30.0)
    views = drawn_views(plate)
    low = ALONG_M < -0.2
    views.pictures[low, :, 300:600] = 200
    assert carved(views).any()
    z = np.full((20, 400), np.nan, np.float32)
    z[:, 190:196] = TOP_M + 0.9
    assert not carved(views, CellGrid(-2.0, -0.1, CELL_M, z, TOP_M + 0.9)).any()


def test_few_views_prove_nothing() -> None:
    views = drawn_views()
    few = space_carving.MIN_VIEWS - 1
    assert not carved(CarvingViews(*(layer[:few] for layer in views))).any()


def test_the_projection_is_that_of_the_camera() -> None:
    rng = np.random.default_rng(3)
    turn = Rotation.from_rotvec([np.pi, 0.1, -0.2]).as_matrix()
    camera = PlacedCamera(Pose("map", "rect", turn, np.array([0.3, -0.2, 8.0])), FOCAL_PX, (310.0, 250.0))
    places = rng.uniform(-1, 1, (20, 3))
    right, down, depth = camera.projection @ np.c_[places, np.ones(20)].T
    at, far = camera.project(places)
    assert np.allclose(np.stack([right / depth, down / depth], axis=1), at)
    assert np.allclose(depth, far)
