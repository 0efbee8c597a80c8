"""Simulated views of a board by a rig whose numbers are known."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from barsight.calibration.boards.board import parse_board
from barsight.calibration.boards.board_views import BoardView, Corners
from barsight.calibration.geometry.camera import Camera, Distortion

SIZE = (1280, 1024)
RADTAN = Distortion.RADTAN
CAM0 = Camera(*SIZE, 1200, 1205, 645, 500, RADTAN, (-0.2, 0.08, 0.001, -0.0005))
CAM1 = Camera(*SIZE, 1210, 1208, 630, 520, RADTAN, (-0.21, 0.09, -0.001, 0.0005))
ROTATION = Rotation.from_rotvec([0.01, -0.02, 0.005]).as_matrix()
TRANSLATION_M = np.array([-0.2, 0.003, 0.002])
BOARD = parse_board("checkerboard:9x6:0.05")


@dataclass
class Placed:
    """One board pose: cam0_from_board."""

    rotation: np.ndarray
    translation_m: np.ndarray


def place(rng: np.random.Generator, points_m: np.ndarray = BOARD.points_m) -> Placed:
    rotation = Rotation.from_euler("xyz", rng.uniform(-35, 35, 3), degrees=True).as_matrix()
    z = rng.uniform(0.7, 1.2)
    centre = np.array([rng.uniform(-0.35, 0.35) * z, rng.uniform(-0.3, 0.3) * z, z])
    return Placed(rotation, centre - rotation @ points_m.mean(axis=0))


def seen(
    placed: Placed, name: str, rng: np.random.Generator, sigma: float, scale: float = 1.0,
    points_m: np.ndarray = BOARD.points_m,
) -> BoardView:  # fmt: skip
    points = scale * points_m @ placed.rotation.T + placed.translation_m
    pixels = [CAM0.project(points), CAM1.project(points @ ROTATION.T + TRANSLATION_M)]
    corners = []
    for projected in pixels:
        inside = ((projected > 0) & (projected < np.array(SIZE) - 1)).all(axis=1)
        noisy = projected[inside] + rng.normal(0, sigma, (int(inside.sum()), 2))
        corners.append(Corners(np.flatnonzero(inside), noisy))
    return BoardView(name, corners[0], corners[1])


def simulated(
    seed: int, sigma: float = 0.2, count: int = 16, points_m: np.ndarray = BOARD.points_m
) -> list[BoardView]:
    """points_m: where the board's points truly lie."""
    rng = np.random.default_rng(seed)
    views: list[BoardView] = []
    while len(views) < count:
        view = seen(place(rng, points_m), f"{len(views):02d}", rng, sigma, points_m=points_m)
        if min(corners.ids.size for corners in view.cameras if corners) >= 20:
            views.append(view)
    return views
