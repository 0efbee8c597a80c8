"""The election against lines of sight: a wall of 1 m on a floor, seen from a crane that passes over it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from barsight.core.pose import Pose
from barsight.core.records.heights import HeightSource
from barsight.core.records.pairs import RectifiedCamera
from barsight.mapping.election.surface_election import SurfaceElection
from barsight.mapping.fusion import fuse_view
from barsight.mapping.observation import CellObservations
from barsight.mapping.settings import MapSettings
from barsight.mapping.surface import height_selection
from barsight.mapping.surface.block_visibility import EVERYWHERE, SOMEWHERE, bound_blocks
from barsight.mapping.surface.height_selection import ViewFrusta, ViewSupport, elect_by_votes, elect_surface
from barsight.mapping.surface.surface import Layers
from barsight.mapping.tiles import FIELDS, SLOTS, VIEWS, TileStore, Z
from mapping_views import FAR_CAMERA, block, high_above, view

CELL_M = 0.01
CAMERA = RectifiedCamera(
    focal_px=1000.0, cx_px=640.0, cy_px=512.0, baseline_m=0.5, doffs_px=0.0, width=1280, height=1024
)
EYES_X_M = np.linspace(-2.0, 2.0, 9)
EYE_M = 8.0
WALL = (0, 50)
"""Cells along x; the wall is 1 m high and as long as the yard."""


def pose_at(x_m: float) -> Pose:
    return Pose("yard", "rect0", np.diag([1.0, -1.0, -1.0]), np.array([x_m, 0.05, EYE_M]))


def seen_by_both(x: np.ndarray, z: np.ndarray, left_eye_m: float) -> np.ndarray:
    """Check that no part of the wall lies between (x cells, z m) and either eye."""
    free = np.ones(x.shape, bool)
    at = x * CELL_M
    for eye in (left_eye_m, left_eye_m + CAMERA.baseline_m):
        for face in (WALL[0] - 0.5, WALL[1] - 0.5):
            edge = face * CELL_M
            crosses = (at < edge) != (eye < edge)
            share = (edge - at) / np.where(crosses, eye - at, 1)
            free &= ~crosses | (z + share * (EYE_M - z) >= 1) | (z >= 1)
    return free


def scene_view(left_eye_m: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """x, y, z of what both cameras see."""
    x, y = (a.ravel() for a in block(400, 12, -200))
    z = np.where((x >= WALL[0]) & (x < WALL[1]), 1.0, 0.0)
    seen = seen_by_both(x, z, left_eye_m)
    return x[seen], y[seen], z[seen]


def surface_of(views: list[CellObservations], folder: Path) -> Layers:
    store = TileStore(folder, 64)
    for one in views:
        fuse_view(store, one, MapSettings())
    frusta = ViewFrusta.of([pose_at(x) for x in EYES_X_M], CAMERA)
    return (
        SurfaceElection(store, folder, CELL_M, MapSettings(fill_m=0.0))
        .finish(2, frusta)
        .window(-200, 0, 400, 12)
    )


def test_what_is_seen_is_elected_and_what_hangs_in_the_air_is_not(tmp_path: Path) -> None:
    """Three of nine views stretch the wall by two cells; the floor there is right under the wall's foot."""
    views = []
    for number, eye in enumerate(EYES_X_M):
        x, y, z = scene_view(eye)
        if number % 3 == 0:
            stretched_x, stretched_y = (a.ravel() for a in block(2, 12, WALL[0] - 2))
            x, y = np.append(x, stretched_x), np.append(y, stretched_y)
            z = np.append(z, np.ones(stretched_x.size))
        views.append(view(x, y, z))
    layers = surface_of(views, tmp_path)
    wall = slice(200 + WALL[0], 200 + WALL[1])
    np.testing.assert_allclose(layers.z_m[:, wall], 1.0)
    assert (layers.source[:, wall] == HeightSource.VISION).all()
    beside = np.delete(layers.z_m, np.arange(wall.start, wall.stop), axis=1)
    np.testing.assert_allclose(beside[np.isfinite(beside)], 0.0)
    expected = sum(seen_by_both(np.arange(-200, 200), np.zeros(400), eye) for eye in EYES_X_M)
    np.testing.assert_array_equal(np.isfinite(layers.z_m[5]), (expected >= 2) | (layers.z_m[5] == 1))


def test_a_height_behind_the_wall_that_none_can_see_is_unknown(tmp_path: Path) -> None:
    """All views match the bottom of a slit, 30 mm wide and 0.9 m deep, that no two eyes can look into."""
    slit = WALL[0] + 20
    inside_x, inside_y = (a.ravel() for a in block(3, 12, slit))
    views = []
    for eye in EYES_X_M:
        x, y, z = scene_view(eye)
        keep = (x < slit) | (x >= slit + 3)
        x, y, z = np.append(x[keep], inside_x), np.append(y[keep], inside_y), z[keep]
        views.append(view(x, y, np.append(z, np.full(inside_x.size, 0.1))))
    layers = surface_of(views, tmp_path)
    assert np.isnan(layers.z_m[:, 200 + slit : 203 + slit]).all()
    np.testing.assert_allclose(layers.z_m[:, 200 : 200 + slit], 1.0)


def test_a_hook_that_travels_along_leaves_no_ghost(tmp_path: Path) -> None:
    """It hangs 4 m over the floor, hides what is below it and is somewhere else in each view."""
    views = []
    for eye in EYES_X_M:
        x, y, z = scene_view(eye)
        hook = round((eye + 0.3) / CELL_M)
        kept = np.abs(x - hook) > 4
        hook_x, hook_y = (a.ravel() for a in block(9, 12, hook - 4))
        x, y = np.append(x[kept], hook_x), np.append(y[kept], hook_y)
        views.append(view(x, y, np.append(z[kept], np.full(hook_x.size, 4.0))))
    layers = surface_of(views, tmp_path)
    assert (layers.source == HeightSource.VISION).mean() > 0.85
    assert np.nanmax(layers.z_m) <= 1.0 + 1e-6


@pytest.mark.parametrize(("low", "high", "held"), [(-0.5, 0.5, True), (30.0, 31.0, False), (7.0, 8.0, False)])
def test_views_far_from_a_box_are_left_out(low: float, high: float, held: bool) -> None:
    frusta = ViewFrusta.of([pose_at(0.0)], CAMERA)
    near = frusta.only(frusta.touching(np.array([low, -0.5, 0.0]), np.array([high, 0.5, 1.0])))
    assert len(near.eyes) == held


def test_views_with_few_points_a_cell_owe_few_votes(tmp_path: Path) -> None:
    """Forty views whose points lie five cells apart: a cell has a point in one view of ten or so."""
    far = replace(FAR_CAMERA, focal_px=1e5, cx_px=1e3, cy_px=1e3, width=2000, height=2000)
    x, y = (a.ravel() for a in block(60, 60))
    store, poses = TileStore(tmp_path, 64), []
    votes = np.zeros(x.size)
    rng = np.random.default_rng(1)
    for _ in range(40):
        hit = rng.random(x.size) < 0.1
        votes += hit
        one = view(x[hit], y[hit], np.zeros(int(hit.sum())))
        fuse_view(store, one, MapSettings())
        poses.append(high_above(one, 0.01))
    surface = SurfaceElection(store, tmp_path, 0.01, MapSettings(fill_m=0.0)).finish(
        2, ViewFrusta.of(poses, far)
    )
    known = surface.window(0, 0, 60, 60).source == HeightSource.VISION
    np.testing.assert_array_equal(known.ravel(), votes >= 2)


@pytest.mark.parametrize(("wall_ends", "known_beneath"), [(60, False), (30, True)])
def test_beneath_a_surface_that_the_border_cuts_off_nothing_is_known(
    tmp_path: Path, wall_ends: int, known_beneath: bool
) -> None:
    """Pictures so low that the floor is seen up to y = 0.43 m and the wall's top to 0.38 m: what is seen of
    the floor between, in the wall's columns, may lie beneath the wall, unless the wall was seen to end."""
    camera = replace(CAMERA, height=100, cy_px=50.0)
    x, y = (a.ravel() for a in block(60, 43, -30))
    top_m = np.where((x >= 0) & (y < wall_ends) & (y < 38), 1.0, 0.0)
    store = TileStore(tmp_path, 64)
    for _ in EYES_X_M:
        fuse_view(store, view(x, y, top_m), MapSettings())
    frusta = ViewFrusta.of([pose_at(eye) for eye in EYES_X_M], camera)
    known = np.isfinite(
        SurfaceElection(store, tmp_path, CELL_M, MapSettings(fill_m=0.0))
        .finish(2, frusta)
        .window(-30, 0, 60, 43)
        .z_m
    )
    assert known[38:42, 30:].any() == known_beneath
    assert known[10:25, 30:].all()
    assert known[38:42, :15].all()


def test_first_heights_are_the_highest_with_enough_votes() -> None:
    rng = np.random.default_rng(2)
    tile = np.zeros((6, 7, SLOTS, FIELDS), np.float32)
    tile[..., VIEWS], tile[..., Z] = rng.integers(0, 9, tile.shape[:3]), rng.normal(size=tile.shape[:3])
    tile[0] = 0
    found = elect_by_votes(tile, 3, 0.35)
    for i, j in np.ndindex(found.shape):
        needed = max(3, 0.35 * tile[i, j, :, VIEWS].max())
        enough = [z for z, views in tile[i, j][:, [Z, VIEWS]] if views >= needed]
        np.testing.assert_equal(found[i, j], max(enough, default=np.float32(np.nan)))


def drawn_yard(folder: Path) -> tuple[TileStore, list[Pose]]:
    """Nine views of 90 x 70 cells: steps of up to 0.9 m, and in every view heights that are wrong."""
    x, y = (a.ravel() for a in block(90, 70, -10, -20))
    z = 0.3 * np.random.default_rng(4).integers(0, 4, (8, 10))[(y + 20) // 10, (x + 10) // 10]
    store, rng, poses = TileStore(folder, 64), np.random.default_rng(5), []
    for eye in EYES_X_M:
        wrong = rng.random(x.size) < 0.1
        fuse_view(store, view(x, y, np.where(wrong, 0.3 * rng.integers(0, 5, x.size), z)), MapSettings())
        poses.append(pose_at(eye / 2))
    return store, poses


def elected(store: TileStore, poses: list[Pose], asked: ViewSupport) -> tuple[np.ndarray, np.ndarray]:
    """The winners of the tile at (0, 0) and how its views see its heights."""
    first = {key: elect_by_votes(store.read(key), 2, 0.35) for key in sorted(store.keys())}
    nothing = np.full((256, 256), np.nan, np.float32)
    around = np.block([[first.get((i, j), nothing) for i in (-1, 0, 1)] for j in (-1, 0, 1)])
    frusta = ViewFrusta.of(poses, replace(CAMERA, height=60, cy_px=30.0))
    winner = elect_surface(store.read((0, 0)), (0, 0), around, frusta, CELL_M, 2, MapSettings(), asked)
    return winner, asked.heights


def test_what_is_said_of_blocks_is_what_their_cells_would_say(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store, poses = drawn_yard(tmp_path)
    quick = elected(store, poses, ViewSupport.none())
    told = []

    def nothing_told(*values: object) -> tuple[np.ndarray, ...]:
        told.extend(bound_blocks(*values))
        within, dense, clear, is_open = told
        return 0 * within + SOMEWHERE, dense & False, np.full_like(clear, np.inf), is_open & False

    monkeypatch.setattr(height_selection, "bound_blocks", nothing_told)
    slow = elected(store, poses, ViewSupport.none())
    for one, other in zip(quick, slow, strict=True):
        np.testing.assert_array_equal(one, other)
    within, dense, clear, is_open = told
    shares = [(within[:12, :20] == where).mean() for where in (SOMEWHERE, EVERYWHERE)]
    assert 0.05 < shares[0] < 0.5
    assert 0.3 < shares[1] < 0.9
    assert 0.3 < np.isfinite(clear[:12, :20]).mean() < 1
    assert dense.any()
    assert is_open.any()
    votes = quick[1][..., 1][np.isfinite(quick[1][..., 1])]
    assert len(np.unique(votes)) == len(EYES_X_M) + 1


def test_views_asked_before_arent_asked_again(tmp_path: Path) -> None:
    """Views asked in two turns say what they say in one; those of a height that moved are asked anew."""
    store, poses = drawn_yard(tmp_path)
    winner, heights = elected(store, poses, ViewSupport.none())
    asked = ViewSupport.none()
    elected(store, poses[:5], asked)
    assert asked.views == 5
    forged = np.isfinite(asked.heights[..., 0])
    forged[20:] = False
    asked.heights[forged, 0] += 1.0
    asked.heights[forged, 1:] = 50.0
    np.testing.assert_array_equal(elected(store, poses, asked)[0], winner)
    np.testing.assert_array_equal(asked.heights, heights)
    asked.heights[forged, 1] = 50.0
    elected(store, poses, asked)
    assert asked.views == 9
    assert forged.sum() > 100
    assert (asked.heights[forged, 1] == 50).all()
