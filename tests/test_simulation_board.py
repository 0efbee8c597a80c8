"""Board pictures by the simulated rig: corners lie where its cameras see them, and calibrate it."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from barsight.calibration.boards.board import parse_board
from barsight.calibration.boards.detection import detect
from barsight.cli.main import run
from barsight.core.errors import Failed
from barsight.recording.image_decoding import decode_gray
from barsight.simulation.boards.pictures import photograph_board
from barsight.simulation.optics import mount_rig
from barsight.simulation.settings.recording import SimulationSettings
from barsight.simulation.settings.rig import CameraSettings
from barsight.simulation.simulate import stream

BOARD = "checkerboard:9x6:0.1"
SETTINGS = SimulationSettings(
    camera=CameraSettings(width_px=640, height_px=512, focal_px=625), seed=23, depth_views=0
)


def test_both_cameras_see_one_flat_board(tmp_path: Path) -> None:
    board = parse_board(BOARD)
    photograph_board(tmp_path / "board", board, 3, SETTINGS)
    rig = mount_rig(SETTINGS, stream(SETTINGS, 2)).rig
    for view in range(3):
        corners = [
            detect(board, decode_gray((tmp_path / "board" / side / f"{view:02}.png").read_bytes()))
            for side in ("left", "right")
        ]
        assert not any(isinstance(one, Failed) for one in corners)
        rays = [camera.rays(one.pixels) for camera, one in zip((rig.cam0, rig.cam1), corners, strict=True)]
        turned = rays[1] @ rig.cam0_from_cam1.rotation.T
        normal = np.cross(rays[0], turned)
        off = np.abs(normal @ rig.cam0_from_cam1.translation) / np.linalg.norm(normal, axis=1)
        depth = np.array([
            np.linalg.lstsq(np.column_stack([a, -b]), rig.cam0_from_cam1.translation, rcond=None)[0][0]
            for a, b in zip(rays[0], turned, strict=True)
        ])  # fmt: skip
        points = rays[0] * depth[:, None]
        sides = np.linalg.norm(np.diff(points.reshape(6, 9, 3), axis=1), axis=2)
        assert np.median(sides) == pytest.approx(0.1, rel=0.02)  # squares of 7 pixels
        assert np.median(off) < 0.001


def test_small_squares_are_drawn_where_they_are(tmp_path: Path) -> None:
    """Squares of 14 pixels, a dozen of the drawn board's to each: corners are 0.09 px off where aliased."""
    board = parse_board(BOARD)
    photograph_board(tmp_path / "board", board, 3, SETTINGS)
    rig = mount_rig(SETTINGS, stream(SETTINGS, 2)).rig
    for side, camera in (("left", rig.cam0), ("right", rig.cam1)):
        found = detect(board, decode_gray((tmp_path / "board" / side / "02.png").read_bytes()))
        assert not isinstance(found, Failed)
        rays = camera.rays(found.pixels)
        flat, points = rays[:, :2] / rays[:, 2:], board.points_m[found.ids, :2]
        homography, _ = cv2.findHomography(points, flat, 0)
        fitted = cv2.perspectiveTransform(points[None], homography)[0]
        assert camera.fx_px * np.sqrt(np.mean((fitted - flat) ** 2)) < 0.06


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["--board", "chess"], "chess"),
        (["--board", BOARD, "--views", "0"], "between 1 and 200"),
        (["--board", "checkerboard:9x6:0.0001"], "doesn't fit into both pictures"),
    ],
)
def test_boards_that_cannot_be(
    tmp_path: Path, arguments: list[str], reason: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["simulate", str(tmp_path / "board"), *arguments]) in (2, 4)
    assert reason in capsys.readouterr().err and not (tmp_path / "board").exists()
