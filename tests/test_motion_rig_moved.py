"""Cameras that move against each other during the travel are reported, and steady ones never."""

import json
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from barsight.cli.main import run
from barsight.core.records.pairs import RectifiedCamera
from barsight.features.guided_matching import PredictedMotion, project_stereo, triangulate_stereo
from barsight.motion.frontend.sightings import DisparityStep, disparity_step, rig_moved
from cli_runs import FAST, pictures

CAMERA = RectifiedCamera(850.0, 480.0, 384.0, 0.5, 0.0, 960, 768)
MOTION = PredictedMotion(
    Rotation.from_rotvec([0.002, -0.001, 0.003]).as_matrix(), np.array([0.4, 0.02, 0.01]), np.eye(6)
)


def seen(rng: np.random.Generator, roll_rad: float = 0.0, more_px: float = 0.0) -> DisparityStep:
    """The step of 400 points that are seen to 0.1 px before and after the right camera has turned."""
    pixels = rng.uniform([80, 20], [940, 748], (400, 2))
    disparity = 850.0 * 0.5 / rng.uniform(7.0, 8.5, 400)
    old = np.column_stack([pixels, pixels[:, 0] - disparity])
    new = project_stereo(triangulate_stereo(old, CAMERA) @ MOTION.rotation.T + MOTION.translation, CAMERA)
    new[:, 2] -= more_px + roll_rad * (new[:, 1] - 384.0)
    noisy = [points + rng.normal(0, 0.1, points.shape) * [0, 0, 1] for points in (old, new)]
    step = disparity_step(2_500_000_000, *noisy, MOTION, CAMERA)
    assert step is not None
    return step


def test_a_step_is_found_where_it_is_largest() -> None:
    rng = np.random.default_rng(0)
    steady = [seen(rng) for _ in range(200)]
    assert rig_moved(steady, 0, (0,)) == ()
    turned = seen(rng, more_px=0.74)  # 0.05 degrees
    assert abs(turned.px - 0.74) < 4 * turned.sigma_px < 0.15
    (told,) = rig_moved([*steady[:9], turned], 0, (0,))
    assert told.startswith("the cameras have moved against each other 2.5 s after the first frame")
    assert abs(turned.depth_m + 0.74 * turned.range_m**2 / 425) < 0.02
    rolled = seen(rng, roll_rad=np.radians(0.1))
    assert rig_moved([rolled], 0, (0,)), "halves of the picture cancel each other"


def test_few_points_and_usual_steps_show_nothing() -> None:
    none = np.zeros((20, 3))
    assert disparity_step(0, none, none, MOTION, CAMERA) is None
    rng = np.random.default_rng(1)
    assert rig_moved([seen(rng, more_px=px) for px in (0.1, -0.1, 0.12, -0.08, 0.24)], 0, (0,)) == ()


def test_many_steps_are_judged_at_once() -> None:
    """Half an hour of pictures took 12 s at the end of a survey: each step's usual ones were sorted anew."""
    px = np.random.default_rng(2).normal(0, 0.01, 20_000)
    steps = [DisparityStep(k, one, 0.005, 0.0, 7.0) for k, one in enumerate(px.tolist())]
    begun = time.process_time()
    assert rig_moved(steps, 0, (0,)) == ()
    assert time.process_time() - begun < 2


@pytest.mark.parametrize(
    ("estimator", "turn_deg", "why"),
    [
        ("fused", 0.06, "moved against each other"),
        ("fused", 0.1, "if a camera has moved"),
        ("live", 0.1, "if a camera has moved"),
    ],
)
def test_a_camera_that_is_bent_on_the_way_forbids_lifts(
    estimator: str, turn_deg: float, why: str, recording: Path
) -> None:
    """Half of the map was 130 mm too deep, with a sigma of 6 mm, and nothing was said."""
    said = yaml.safe_load((recording / "mav0/cam1/sensor.yaml").read_text())
    (fx, fy, cx, cy), (width, height) = said["intrinsics"], said["resolution"]
    matrix, bent = (
        np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]),
        np.array(said["distortion_coefficients"]),
    )
    pixels = np.stack(np.meshgrid(np.arange(width, dtype=float), np.arange(height)), -1).reshape(-1, 1, 2)
    rays = np.column_stack([cv2.undistortPoints(pixels, matrix, bent)[:, 0], np.ones(width * height)])
    turned = Rotation.from_euler("y", turn_deg, degrees=True).apply(rays)
    at = cv2.projectPoints(turned, np.zeros(3), np.zeros(3), matrix, bent)[0].reshape(height, width, 2)
    for path in pictures(recording, "cam1")[2:]:
        picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(path), cv2.remap(picture, at.astype(np.float32), None, cv2.INTER_LANCZOS4))
    out = recording.parent / "out"
    assert run(["measure", str(recording), "-o", str(out), *FAST, "--motion.estimator", estimator]) == 0
    vetoes = json.loads((out / "lifts.json").read_text())["vetoes"]
    assert any(why in one["reason"] for one in vetoes if one["code"] == "calibration-drift")
