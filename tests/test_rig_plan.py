"""The plan of a rig: its sums by hand, its sigma against rendered pictures, and what doesn't fit."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

import barsight as bs
from barsight.calibration.geometry.rectification import Rectifier
from barsight.cli.main import run
from barsight.core.records.pairs import StereoFrame
from barsight.reconstruction.pair_matching import match_pictures
from barsight.sensors.rig_plan import CAMERAS, Wish, depth_sigma_m, plan_rig
from barsight.simulation.settings.rig import CameraSettings
from barsight.simulation.simulate import simulate
from barsight.stereo.settings import StereoSettings
from cli_runs import TINY

MIN_RATIO, MAX_RATIO = 0.4, 1.25
"""The sigma of matches over the planned one: plans are careful, by a factor of two on small pictures."""


def test_the_sums_are_those_by_hand() -> None:
    """8 m, 12 m wide, 1280x1024 of 4.8 um: three lanes of 4.4 m at 6 m need f = 1024 x 6 / 4.4 = 1396 px."""
    plan = plan_rig(Wish(8.0, 12.0), CAMERAS["1.3MP"])
    assert (plan.passes, plan.focal_mm, plan.focal_px) == (3, 6.0, 1250.0)
    assert plan.lane_m == pytest.approx(1024 * 6 / 1250) and plan.lane_m > 4.4
    assert plan.baseline_m == pytest.approx(0.55)  # 64 x 0.1 / (1250 x 0.01) = 0.512
    assert depth_sigma_m(8.0, 1250.0, 0.55) == pytest.approx(6.4 / 687.5)
    assert plan.exposure_us == pytest.approx(1e6 * 0.5 / (1250 * (0.5 / 6 + 0.01)))
    assert plan.common_m == pytest.approx(1280 * 6 / 1250 - 0.55)
    assert plan.data_mbps == pytest.approx(1.1 * 2 * 1280 * 1024 * 5 * 8 / 1e6)
    assert plan.f_number == 1.4  # 0.006^2 x 2 / (2 x 8 x 6 x 4.8e-6) = 0.16
    # A point at z blurs by f^2 |1/s - 1/z| / N on the sensor, s where it is sharpest.
    sharpest = 2 * 8 * 6 / (8 + 6)
    for z in (6.0, 8.0):
        assert 0.006**2 * abs(1 / sharpest - 1 / z) / plan.f_number < 4.8e-6


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize(("width_m", "bar_m"), [(6.0, 0.09), (20.0, 0.05)])
def test_every_plan_holds_what_was_wished(camera: str, width_m: float, bar_m: float) -> None:
    wish = Wish(9.0, width_m, bar_m=bar_m, speed_mps=1.0)
    plan = plan_rig(wish, CAMERAS[camera])
    assert plan.lane_m * plan.passes >= width_m
    assert plan.focal_px * bar_m / 9.0 >= 10
    assert depth_sigma_m(9.0, plan.focal_px, plan.baseline_m) <= wish.sigma_m
    assert plan.exposure_us * 1e-6 * 1.0 * plan.focal_px / wish.near_m < 0.5
    assert plan.rate_hz * plan.common_m >= 8 * 1.0


def test_the_planned_sigma_is_that_of_matches(whole: Path) -> None:
    ratios = over_planned(whole)
    assert ratios and all(MIN_RATIO < ratio < MAX_RATIO for ratio in ratios), ratios


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "focal_px", "baseline_m", "above_m"), [(13, 625.0, 0.5, 8.0), (14, 780.0, 0.3, 6.0)]
)
def test_the_planned_sigma_is_that_of_other_rigs(
    seed: int, focal_px: float, baseline_m: float, above_m: float, tmp_path: Path
) -> None:
    camera = CameraSettings(640, 512, focal_px, baseline_m, above_floor_m=above_m)
    simulate(tmp_path / "one", replace(TINY, camera=camera, seed=seed))
    ratios = over_planned(tmp_path / "one")
    assert ratios and all(MIN_RATIO < ratio < MAX_RATIO for ratio in ratios), ratios


def over_planned(path: Path) -> list[float]:
    """Robust sigma of matched depths over the planned one, of each pair with true depth, but for steps."""
    recording = bs.open_recording(path)
    rectifier = Rectifier(recording.rig)
    found = rectifier.camera
    raw_from_rect = recording.rig.body_from_cam0.inverse() @ rectifier.body_from_rect0
    ratios = []
    for frame in recording.frames():
        truth = path / "truth" / f"depth_cam0_{frame.stamp_ns}.npz"
        if not truth.is_file() or not isinstance(frame, StereoFrame):
            continue
        _, disparity = match_pictures(frame.left, frame.right, StereoSettings(), recording.rig)
        rows, columns = np.nonzero(np.isfinite(disparity.disparity_px))
        rays = np.column_stack(
            [
                (columns - found.cx_px) / found.focal_px,
                (rows - found.cy_px) / found.focal_px,
                np.ones(rows.size),
            ]
        )
        raw = rays @ raw_from_rect.rotation.T
        u, v = recording.rig.cam0.project(raw).T
        depth = np.load(truth)["z"].astype(np.float64)
        near = [
            map_coordinates(depth, [v + dy, u + dx], order=0, cval=np.inf)
            for dy in (-2, 0, 2)
            for dx in (-2, 0, 2)
        ]
        smooth = np.ptp(near, axis=0) < 0.08
        true_m = map_coordinates(depth, [v, u], order=1, cval=np.nan) / raw[:, 2]
        measured = (
            found.focal_px * found.baseline_m / (disparity.disparity_px[rows, columns] + found.doffs_px)
        )
        off = (measured - true_m)[smooth & np.isfinite(true_m)]
        robust = 1.4826 * np.median(np.abs(off - np.median(off)))
        ratios.append(
            robust / depth_sigma_m(float(np.median(true_m[smooth])), found.focal_px, found.baseline_m)
        )
    return ratios


@pytest.mark.parametrize(
    ("flags", "code", "words"),
    [
        (("--range", "8", "--width", "12", "--sigma", "0.001"), 5, "needs a baseline of 5.15 m"),
        (("--range", "20", "--width", "12", "--bar-diameter", "0.01"), 5, "take a camera with more pixels"),
        (
            ("--range", "5", "--width", "3", "--stack", "4", "--bar-diameter", "0.02", "--camera", "1.3MP"),
            5,
            "12 mm needs f/12 to be sharp from 1 to 5 m",
        ),
        (("--range", "8", "--width", "12", "--stack", "7"), 2, "mount the cameras higher"),
        (("--range", "-8", "--width", "12"), 2, "--range must lie in 0.5...60 m, not -8"),
        (("--range", "8", "--width", "12", "--bar-diameter", "9"), 2, "--bar-diameter must lie in 0.005"),
        (("--range", "8", "--width", "12", "--speed", "nan"), 2, "--speed must lie in 0.01...5 m/s, not nan"),
        (
            ("--range", "3", "--stack", "1.5", "--width", "2", "--speed", "5", "--camera", "12MP"),
            5,
            "drive slower",
        ),
    ],
)
def test_what_does_not_fit_is_one_line(
    flags: tuple[str, ...], code: int, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["plan", *flags]) == code
    told = capsys.readouterr()
    assert words in told.err and told.err.count("\n") == 1 and told.out == ""


def test_figures_and_parts_are_printed(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["plan", "--range", "8", "--width", "12"]) == 0
    told = capsys.readouterr().out
    assert "0.55 m" in told and "6 mm, C mount" in told and "5 Hz" in told
