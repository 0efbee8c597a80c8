"""Stereo calibration against truth: simulated rigs, stated sigmas, and what must be left out."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from barsight.calibration.boards.board import parse_board
from barsight.calibration.boards.board_views import BoardView
from barsight.calibration.boards.detection_files import read_detections
from barsight.calibration.geometry.projection import Lens, project_lens
from barsight.calibration.stereo.calibration import StereoCalibration, calibrate_stereo
from barsight.calibration.stereo.cross_validation import CrossValidation, cross_validate
from barsight.calibration.stereo.projection_uncertainty import depth_sigma, sample_pairs, triangulate_depth
from barsight.calibration.stereo.verdict import Verdict, assess
from barsight.core.errors import CalibrationError
from calibration_views import BOARD, CAM0, CAM1, ROTATION, SIZE, TRANSLATION_M, place, seen, simulated

COEFFICIENTS = {
    Lens.RADTAN4: [-0.28, 0.07, 0.001, -0.002],
    Lens.RADTAN5: [-0.28, 0.07, 0.001, -0.002, 0.02],
    Lens.RADTAN8: [0.3, 0.1, 0.001, -0.002, 0.02, 0.5, 0.2, 0.03],
    Lens.EQUIDISTANT: [0.02, -0.01, 0.005, -0.001],
}


def solved(views: list[BoardView], lens: Lens = Lens.RADTAN4) -> StereoCalibration:
    return calibrate_stereo(views, BOARD, lens, (SIZE, SIZE), Path("simulated"))


def error(calibration: StereoCalibration) -> np.ndarray:
    """Estimate minus truth in the covariance's order."""
    truth = [np.array([c.fx_px, c.fy_px, c.cx_px, c.cy_px, *c.coefficients]) for c in (CAM0, CAM1)]
    turn = Rotation.from_matrix(calibration.state.rotation @ ROTATION.T).as_rotvec()
    lenses = np.concatenate(calibration.state.lenses) - np.concatenate(truth)
    return np.concatenate([lenses, turn, calibration.state.translation_m - TRANSLATION_M])


@pytest.mark.parametrize("lens", list(Lens))
def test_projection_is_the_cameras_and_its_derivatives_are_right(lens: Lens) -> None:
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform(-0.6, 0.6, (40, 2)), rng.uniform(0.8, 2, 40)])
    parameters = np.array([458.0, 457.0, 367.0, 248.0, *COEFFICIENTS[lens]])
    out = project_lens(lens, parameters, points)
    assert np.abs(out.pixels - lens.camera(parameters, 752, 480).project(points)).max() < 1e-8
    for k in range(3):
        step = 1e-6 * np.eye(3)[k]
        ends = [project_lens(lens, parameters, points + sign * step).pixels for sign in (1, -1)]
        assert np.allclose(out.by_point[:, :, k], (ends[0] - ends[1]) / 2e-6, atol=1e-4)
    for k in range(parameters.size):
        step = 1e-6 * np.eye(parameters.size)[k]
        ends = [project_lens(lens, parameters + sign * step, points).pixels for sign in (1, -1)]
        assert np.allclose(out.by_lens[:, :, k], (ends[0] - ends[1]) / 2e-6, atol=1e-4)


def test_without_noise_the_rig_is_found_exactly() -> None:
    calibration = solved(simulated(3, sigma=1e-7))
    assert np.abs(error(calibration)).max() < 1e-4
    assert abs(calibration.rig.baseline_m - np.linalg.norm(TRANSLATION_M)) < 1e-8


@pytest.mark.slow
def test_errors_over_sigma_over_24_seeds() -> None:
    ratios, mahalanobis, depth = [], [], []
    for seed in range(24):
        calibration = solved(simulated(seed))
        off = error(calibration)
        ratios.append(off**2 / np.diag(calibration.covariance))
        mahalanobis.append(off @ np.linalg.solve(calibration.covariance, off) / off.size)
        number, left, right = sample_pairs(calibration.rig, [3.0])
        found = triangulate_depth(calibration.rig, left, right)
        place = calibration.rig.cam0_from_cam1
        rays = CAM0.rays(left), CAM1.rays(right) @ ROTATION
        assert number.size
        centre = -ROTATION.T @ TRANSLATION_M
        true_depth = [
            np.linalg.lstsq(np.column_stack([a, -b]), centre, rcond=None)[0][0]
            for a, b in zip(*rays, strict=True)
        ]
        middle = int(np.argmin(np.linalg.norm(left - np.array(SIZE) / 2, axis=1)))
        depth.append((found[middle] - true_depth[middle]) / depth_sigma(calibration, [3.0])[0, 0])
        assert place.target == "cam0"
    assert 0.8 <= np.mean(ratios) <= 1.25
    assert 0.8 <= np.mean(mahalanobis) <= 1.25
    assert 0.4 <= np.mean(np.square(depth)) <= 1.8


def test_a_bowed_stretched_board_with_small_tags_is_recovered_with_honest_sigmas() -> None:
    board, truth = parse_board("aprilgrid:4x4:0.06:0.3"), np.array([1.5e-3, -0.8e-3, 3e-3, -4e-3, -0.01])
    points = board.points_m
    across = (points[:, :2] - points[:, :2].mean(axis=0)) / np.ptp(points[:, :2], axis=0) * 2
    points[:, 2] = (1 - across**2) @ truth[:2]
    tags = points.reshape(-1, 4, 3)
    middle = tags.mean(axis=1, keepdims=True)[:, :, :2]
    tags[:, :, :2] = middle + (1 + truth[4]) * (tags[:, :, :2] - middle)
    points[:, :2] = points[:, :2] @ np.array(
        [[1 + truth[2] / 2, truth[3] / 2], [truth[3] / 2, 1 - truth[2] / 2]]
    )
    shapes, rigs, flat = [], [], []
    for seed in range(12):
        views = simulated(seed, points_m=points)
        calibration = calibrate_stereo(views, board, Lens.RADTAN4, (SIZE, SIZE), Path("simulated"))
        off = error(calibration)
        rigs.append(off @ np.linalg.solve(calibration.covariance, off) / off.size)
        shape = calibration.shape
        shapes.append((shape.values - truth) / shape.sigma)
        flat.append(truth / shape.sigma)
    assert np.abs(shapes).max() < 3.5
    assert np.abs(np.mean(shapes, axis=0)).max() < 1
    assert np.abs(flat).min() > 8
    assert 0.8 <= np.mean(rigs) <= 1.25
    assert 0.5 <= np.mean(np.square(shapes)) <= 1.7


@pytest.mark.slow
def test_halves_agree_within_their_sigmas() -> None:
    ratios = []
    for seed in range(6):
        cross = cross_validate(solved(simulated(seed)), [2.0, 5.0])
        assert isinstance(cross, CrossValidation)
        ratios += [d / p for d, p in zip(cross.difference_px, cross.predicted_px, strict=True)]
        ratios += [d / p for d, p in zip(cross.depth_mm, cross.depth_predicted_mm, strict=True)]
    assert 0.6 <= np.sqrt(np.mean(np.square(ratios))) <= 1.5


def test_swapped_cameras_are_said() -> None:
    views = [replace(view, cam0=view.cam1, cam1=view.cam0) for view in simulated(1)]
    with pytest.raises(CalibrationError, match=r"left and right are swapped: cam1 lies 20.* mm to the left"):
        solved(views)


def test_each_bad_view_is_left_out_with_its_reason() -> None:
    rng = np.random.default_rng(5)
    views = simulated(5, count=18)
    views[2] = replace(views[2], cam0=views[2].cam1, cam1=views[2].cam0)
    views[6] = replace(views[6], cam1=views[9].cam1)
    larger = place(rng)
    views[11] = seen(replace(larger, translation_m=np.array([-0.2, -0.12, 1.3])), "11", rng, 0.2, scale=1.2)
    calibration = solved(views)
    reasons = {entry.view: entry.reason for entry in calibration.removed if entry.camera == "both"}
    assert set(reasons) == {"02", "06", "11"}
    assert "exchanged" in reasons["02"]
    assert "same moment" in reasons["06"]
    assert "another board, about 1.2 times as large" in reasons["11"]
    off = error(calibration)
    assert off @ np.linalg.solve(calibration.covariance, off) / off.size < 2.5


def test_odd_corners_are_taken_out() -> None:
    views = simulated(7)
    views[4].cam0.pixels[10] += (6.0, -3.0)
    calibration = solved(views)
    assert [(e.view, e.camera) for e in calibration.removed] == [("04", "cam0")]
    assert "1 of" in calibration.removed[0].reason


def test_a_view_with_a_few_wrong_corners_stays() -> None:
    views = simulated(7)
    views[4].cam0.pixels[[3, 10, 17]] += [(9.0, -3.0), (-7.0, 8.0), (4.0, 12.0)]
    calibration = solved(views)
    assert "04" in {view.name for view in calibration.views}
    assert [(e.view, e.camera) for e in calibration.removed] == [("04", "cam0")]
    assert "3 of" in calibration.removed[0].reason


def test_blurred_picture_is_left_out() -> None:
    views = [
        replace(view, cam0=replace(view.cam0, edge_px=2.5), cam1=replace(view.cam1, edge_px=2.4))
        for view in simulated(8)
    ]
    views[3] = replace(views[3], cam1=replace(views[3].cam1, edge_px=6.0))
    removed = solved(views).removed
    assert [(e.view, e.camera) for e in removed] == [("03", "cam1")]
    assert "blurred: its edges are 6.0 px wide" in removed[0].reason


def test_repeated_pictures_add_no_certainty() -> None:
    """Four copies of each halved all sigmas."""
    views = simulated(8, count=6)
    copies = [replace(view, name=f"{view.name} again") for view in views for _ in range(3)]
    once, often = solved(views), solved([*views, *copies])
    np.testing.assert_array_equal(often.covariance, once.covariance)
    assert len(often.removed) == 18
    assert often.removed[0].reason == "is the same picture as 00"
    with pytest.raises(CalibrationError, match=r"only 1 views .* \(is the same picture as 00\)"):
        solved([replace(views[0], name=f"{k:02d}") for k in range(9)])


def test_too_few_views_are_refused_in_one_line() -> None:
    with pytest.raises(CalibrationError, match="only 2 views"):
        solved(simulated(1)[:2])


def test_verdict_follows_the_working_range() -> None:
    calibration = solved(simulated(2, sigma=0.05, count=30))
    near, far = assess(calibration, 1.5), assess(calibration, 40.0)
    by_name = {line.name: line.verdict for line in near.lines}
    assert by_name["depth at 1.5 m"] is Verdict.GOOD
    assert far.verdict is Verdict.REDO
    assert all(line.reason for line in far.lines)


def test_euroc_detections_give_the_published_baseline(data: Path) -> None:
    folder, board = data / "euroc_april_imu", parse_board("aprilgrid:6x6:0.088:0.3")
    views = read_detections(folder, board)[::12]
    calibration = calibrate_stereo(views, board, Lens.RADTAN4, ((752, 480), (752, 480)), folder)
    assert abs(calibration.rig.baseline_m * 1e3 - 110.07) < 0.3
    assert abs(calibration.rig.cam0.fx_px - 458.654) < 3
    assert abs(calibration.rig.cam1.fx_px - 457.587) < 3
    with pytest.raises(CalibrationError, match="corners lie where"):
        read_detections(folder, parse_board("aprilgrid:6x6:0.08:0.3"))
