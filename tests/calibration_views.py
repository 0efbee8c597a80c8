"""Simulated views of a board by a rig whose numbers are known, and pictures of boards drawn exactly."""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from barsight.calibration.boards import Board, BoardKind, parse_board
from barsight.calibration.camera import Camera, Distortion
from barsight.calibration.views import BoardView, Corners

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


def drawn(board: Board, px_per_m: float, margin_m: float) -> np.ndarray:
    """The board seen straight on; its point (x, y) lies at (margin + x, margin + y) (AprilGrid: y up)."""
    if board.kind is BoardKind.CHARUCO:
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
        pattern = cv2.aruco.CharucoBoard(
            (board.columns, board.rows), board.size_m, board.marker_m, dictionary
        )
        size = round(board.columns * board.size_m * px_per_m), round(board.rows * board.size_m * px_per_m)
        inner = pattern.generateImage(size)
    else:
        dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
        side, step = round(board.size_m * px_per_m), round(board.size_m * (1 + board.spacing) * px_per_m)
        inner = np.full((step * (board.rows - 1) + side, step * (board.columns - 1) + side), 255, np.uint8)
        for tag in range(board.rows * board.columns):
            row, column = divmod(tag, board.columns)
            y = (board.rows - 1 - row) * step
            marker = cv2.aruco.generateImageMarker(dictionary, tag, side, borderBits=2)
            inner[y : y + side, column * step : column * step + side] = marker
    margin = round(margin_m * px_per_m)
    return cv2.copyMakeBorder(inner, margin, margin, margin, margin, cv2.BORDER_CONSTANT, value=255)
