"""Things that hang from the crane are told from the yard, and leave no ghost in the map."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile

from barsight.cli.main import run
from barsight.core.pose import Pose
from barsight.core.records.pairs import RectifiedCamera
from barsight.mapping.ego_mask import mask_carried

CAMERA = RectifiedCamera(600.0, 320.0, 240.0, 0.5, 0.0, 640, 480)
DEPTH_M, WAY_M = 7.5, 0.5
WAY_PX = round(600.0 * WAY_M / DEPTH_M)
PLATE = np.s_[150:310, 240:440]


def noise(seed: int, shape: tuple[int, int] = (480, 640)) -> np.ndarray:
    rough = cv2.GaussianBlur(np.random.default_rng(seed).normal(0, 1, shape), (0, 0), 2.5)
    return np.clip(110 + 40 * rough / rough.std(), 0, 255).astype(np.uint8)


def views(ground: np.ndarray, swing: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Two pictures of a level ground WAY_PX apart, a plate before both, and the first one's disparities."""
    left, neighbour = ground[:, :640].copy(), ground[:, WAY_PX : 640 + WAY_PX].copy()
    plate = noise(9)[PLATE]
    left[PLATE] = plate
    neighbour[PLATE] = np.roll(plate, swing, (0, 1))
    disparity = np.full(left.shape, 600.0 * 0.5 / DEPTH_M, np.float32)
    disparity[PLATE] = 100.0
    return left, neighbour, disparity


@pytest.mark.parametrize("swing", [(0, 0), (3, -6)])
def test_a_plate_is_found_and_nothing_else(swing: tuple[int, int]) -> None:
    left, neighbour, disparity = views(noise(1, (480, 700)), swing)
    moved = Pose("rect0", "rect0", np.eye(3), np.array([-WAY_M, 0.0, 0.0]))
    found = mask_carried(left, disparity, CAMERA, neighbour, moved)
    assert found[PLATE].mean() > 0.9
    inside = np.zeros(left.shape, np.bool_)
    inside[130:330, 220:460] = True
    assert found[~inside].mean() < 0.002


def test_bars_alike_are_the_yards() -> None:
    """A way of whole pitches shows the same picture again: that is no proof of standing still."""
    bars = np.tile(noise(2, (480, WAY_PX)), (1, 18))
    left, neighbour = bars[:, :640], bars[:, WAY_PX : 640 + WAY_PX]
    disparity = np.full((480, 640), 600.0 * 0.5 / DEPTH_M, np.float32)
    moved = Pose("rect0", "rect0", np.eye(3), np.array([-WAY_M, 0.0, 0.0]))
    assert not mask_carried(left, disparity, CAMERA, neighbour, moved).any()


def test_a_crane_at_rest_carries_nothing() -> None:
    left, _, disparity = views(noise(1, (480, 700)), (0, 0))
    still = Pose.identity("rect0", "rect0")
    assert not mask_carried(left, disparity, CAMERA, left, still).any()


@pytest.mark.slow
def test_a_magnet_in_the_pictures_leaves_no_ghost(tmp_path: Path) -> None:
    """A plate of 1 x 0.5 m, 5 m over the floor, in four of fourteen pairs."""
    camera = ["--camera.width-px", "640", "--camera.height-px", "512", "--camera.focal-px", "625"]
    yard = ["--length", "3", "--frames", "14", "--seed", "1", "--yard.max-layers", "3"]
    recording, out = str(tmp_path / "recording"), tmp_path / "out"
    assert run(["simulate", recording, *yard, *camera, "--magnet.size-m", "1.0", "0.5"]) == 0
    assert run(["measure", recording, "-o", str(out)]) == 0
    highest = float(np.nanmax(tifffile.imread(out / "height.tif")[0]))
    truth = float(np.load(tmp_path / "recording" / "truth" / "height.npz")["z"].max())
    assert highest < truth + 0.3
    frames = json.loads((out / "result.json").read_text())["frames"]
    assert frames["used"] + frames["passed_over"]["count"] == 14
