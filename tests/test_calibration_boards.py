"""Boards: their texts, and their corners found in pictures where the truth is known."""

import cv2
import numpy as np
import pytest

from barsight.calibration.boards.board import parse_board
from barsight.calibration.boards.board_views import Corners
from barsight.calibration.boards.detection import detect
from barsight.core.errors import ConfigError, Failed
from barsight.simulation.boards.drawing import draw_board

SCALE, MARGIN_M = 2000.0, 0.05
TILT = np.array([[0.9, 0.12, 40.0], [-0.08, 0.85, 60.0], [1e-4, 5e-5, 1.0]])


def picture(text: str) -> tuple[np.ndarray, np.ndarray]:
    """A tilted view of the board and its points' true pixels."""
    board = parse_board(text)
    flat = draw_board(board, SCALE, MARGIN_M)
    small = cv2.warpPerspective(flat, TILT, (900, 900), flags=cv2.INTER_AREA, borderValue=(255,))
    points = board.points_m[:, :2] * SCALE
    if text.startswith("charuco"):
        points = points + board.size_m * SCALE
    else:
        points[:, 1] = flat.shape[0] - 2 * MARGIN_M * SCALE - points[:, 1]
    points = points + MARGIN_M * SCALE - 0.5
    whole = np.column_stack([points, np.ones(len(points))]) @ TILT.T
    return cv2.GaussianBlur(small, (0, 0), 0.7), whole[:, :2] / whole[:, 2:]


BOARDS = ["charuco:8x6:0.04:0.03", "aprilgrid:4x4:0.06:0.3"]


@pytest.mark.parametrize("text", BOARDS)
def test_corners_of_marker_boards_lie_where_they_are(text: str) -> None:
    image, truth = picture(text)
    found = detect(parse_board(text), image)
    assert isinstance(found, Corners)
    assert found.ids.size >= 0.95 * len(truth)
    assert np.linalg.norm(found.pixels - truth[found.ids], axis=1).mean() < 0.25


@pytest.mark.parametrize("text", BOARDS)
def test_half_seen_marker_boards_count(text: str) -> None:
    image, truth = picture(text)
    image[:, 450:] = 255
    found = detect(parse_board(text), image)
    assert isinstance(found, Corners)
    assert 8 <= found.ids.size < len(truth)
    assert np.linalg.norm(found.pixels - truth[found.ids], axis=1).mean() < 0.25


def test_aprilgrid_of_other_proportions_is_refused() -> None:
    image, _ = picture("aprilgrid:4x4:0.06:0.3")
    found = detect(parse_board("aprilgrid:5x4:0.06:0.3"), image)
    assert isinstance(found, Failed)
    assert found.code == "no-board"


@pytest.mark.parametrize(
    "text",
    ["chess:9x6:0.03", "checkerboard:9x6", "checkerboard:9:0.03", "checkerboard:9x6:30",
     "charuco:8x6:0.03:0.04", "aprilgrid:6x6:0.088", "checkerboard:2x2:0.03", "checkerboard:9x6:x"],
)  # fmt: skip
def test_texts_that_are_no_board_are_refused(text: str) -> None:
    with pytest.raises(ConfigError):
        parse_board(text)


@pytest.mark.parametrize("text", ["checkerboard:9x6:0.025", "charuco:11x8:0.03:0.022:DICT_4X4_100"])
def test_boards_print_as_they_are_read(text: str) -> None:
    assert str(parse_board(text)) == text


def test_a_checkerboards_part_is_not_taken_for_the_board() -> None:
    squares = np.kron(
        (np.indices((7, 10)).sum(axis=0) % 2).astype(np.uint8) * 255, np.ones((40, 40), np.uint8)
    )
    image = cv2.copyMakeBorder(squares, 60, 60, 60, 60, cv2.BORDER_CONSTANT, value=255)
    assert isinstance(detect(parse_board("checkerboard:9x6:0.03"), image), Corners)
    for part in ("8x6", "9x5", "7x4"):
        found = detect(parse_board(f"checkerboard:{part}:0.03"), image)
        assert isinstance(found, Failed)
        assert "9x6" in found.reason
