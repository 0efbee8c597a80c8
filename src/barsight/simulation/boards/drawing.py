"""Draw calibration boards: for printing, and as a camera sees them held well and badly."""

from __future__ import annotations

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from barsight.calibration.boards.board import Board, BoardKind
from barsight.calibration.geometry.camera import Camera, Distortion
from barsight.core.arrays import UInt8

CAMERA = Camera(640, 512, 600.0, 600.0, 319.5, 255.5, Distortion.RADTAN, (-0.2, 0.06, 0.0, 0.0))
GOOD, BAD = 90, 40
VIEWS = (
    ("fills half the picture", (0, 0, 8), (0.0, 0.0), 0.75, True),
    ("tilted 35 degrees about y", (0, 35, 0), (0.1, 0.05), 0.6, True),
    ("tilted 35 degrees about x", (-35, 0, 0), (-0.1, 0.0), 0.6, True),
    ("into the corner, half seen is fine", (15, -20, 5), (0.42, -0.36), 0.5, True),
    ("at the working range too", (12, 20, 0), (-0.2, 0.1), 0.25, True),
    ("bad: always small, frontal, in the middle", (0, 0, 0), (0.0, 0.0), 0.25, False),
)
"""Example views: caption, rotations about x, y, z (degrees), position and width (shares of the image), and
whether the view is a good one.
"""


def draw_board(board: Board, px_per_m: float, margin_m: float) -> UInt8:
    """Draw the board (H, W) in frontal view with a white margin.

    A point (x, y) lies at (margin + x, margin + y), with y up for an AprilGrid. A checkerboard's points are
    its inner corners: the squares extend by one more on every side.
    """
    if board.kind is BoardKind.CHECKERBOARD:
        side = round(board.size_m * px_per_m)
        squares = np.indices((board.rows + 1, board.columns + 1)).sum(axis=0) % 2
        inner = np.kron(255 * squares.astype(np.uint8), np.ones((side, side), np.uint8))
    elif board.kind is BoardKind.CHARUCO:
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
        pattern = cv2.aruco.CharucoBoard(
            (board.columns, board.rows), board.size_m, board.marker_m, dictionary
        )
        size = round(board.columns * board.size_m * px_per_m), round(board.rows * board.size_m * px_per_m)
        inner = np.asarray(pattern.generateImage(size), np.uint8)
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
    drawn = cv2.copyMakeBorder(inner, margin, margin, margin, margin, cv2.BORDER_CONSTANT, value=255)
    return np.asarray(drawn, np.uint8)


def draw_views(board: Board) -> UInt8:
    """Draw an image (H, W) with views of a board held well, and one bad example, each with its caption."""
    px_per_m, margin_m = 60 / board.size_m, board.size_m
    flat = draw_board(board, px_per_m, margin_m)
    width_m, height_m = flat.shape[1] / px_per_m, flat.shape[0] / px_per_m
    v, u = np.indices((CAMERA.height, CAMERA.width)).reshape(2, -1)
    rays = CAMERA.rays(np.column_stack([u, v]).astype(np.float64))
    cells = []
    for text, turns, place, share, good in VIEWS:
        turned = Rotation.from_euler("xyz", turns, degrees=True).as_matrix()
        away = CAMERA.fx_px * width_m / (share * CAMERA.width)
        middle = (
            np.array([place[0] * CAMERA.width, place[1] * CAMERA.height, CAMERA.fx_px]) / CAMERA.fx_px * away
        )
        depth = turned[:, 2] @ middle / (rays @ turned[:, 2])
        on_board = (rays * depth[:, None] - middle) @ turned[:, :2] + (width_m / 2, height_m / 2)
        at = (on_board * px_per_m - 0.5).astype(np.float32).reshape(CAMERA.height, CAMERA.width, 2)
        seen = cv2.remap(flat, at[..., 0], at[..., 1], cv2.INTER_AREA, borderValue=GOOD if good else BAD)
        cv2.rectangle(seen, (0, 0), (CAMERA.width, 34), 0, -1)
        cv2.putText(seen, text, (10, 24), cv2.FONT_HERSHEY_SIMPLEX, 0.7, 255, 1, cv2.LINE_AA)
        cells.append(cv2.copyMakeBorder(seen, 4, 4, 4, 4, cv2.BORDER_CONSTANT, value=255))
    return np.asarray(np.vstack([np.hstack(cells[:3]), np.hstack(cells[3:])]), np.uint8)
