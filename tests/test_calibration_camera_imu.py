"""Camera-IMU calibration against simulated truth: errors, their stated sigmas, what can't be calibrated."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from barsight.calibration.boards.board import Board
from barsight.calibration.boards.board_views import BoardView, Corners
from barsight.calibration.boards.board_warp import apply_shape
from barsight.calibration.camera_imu.arrowhead_system import apply_jacobian
from barsight.calibration.camera_imu.calibration import (
    CameraImuCalibration,
    calibrate_camera_imu,
    subtract_mounts,
)
from barsight.calibration.camera_imu.problem import (
    CameraImuProblem,
    CameraImuState,
    Mount,
    linearise_camera_imu,
    retract_state,
)
from barsight.calibration.camera_imu.result_files import write_camera_imu
from barsight.calibration.camera_imu.setup import prepare
from barsight.calibration.files.rig_file import read_covariance
from barsight.calibration.geometry.projection import Lens
from barsight.calibration.geometry.rig import StereoRig
from barsight.calibration.stereo.disparity_uncertainty import disparity_sigma_px
from barsight.core.errors import CalibrationError
from barsight.core.records.sensor_samples import ImuSamples
from camera_imu_recordings import BOARD, NOISE, Truth, simulated, true_rig, without_extrinsics

SOURCE = Path("recording")
RIG = without_extrinsics(true_rig())
Recorded = tuple[list[BoardView], ImuSamples, Truth]


@pytest.fixture(scope="module")
def recorded() -> Recorded:
    return simulated(0)


def calibrated(
    views: list[BoardView], imu: ImuSamples, rig: StereoRig = RIG, board: Board = BOARD, **options: bool
) -> CameraImuCalibration:
    return calibrate_camera_imu(views, imu, rig, board, NOISE, SOURCE, **options)


def errors(calibration: CameraImuCalibration, truth: Truth) -> np.ndarray:
    """(14,) solved minus true mountings and time shifts."""
    state = calibration.solution.state
    poses = truth.rig.body_from_cam0, truth.rig.body_from_cam1
    mounts = tuple(
        Mount(pose.rotation, pose.translation, shift)
        for pose, shift in zip(poses, truth.shift_s, strict=True)
    )
    return subtract_mounts(state, replace(state, mounts=mounts))


def mean_square(seeds: range) -> float:
    """Mean square of the errors over their stated sigmas, along the covariance's own axes."""
    found = []
    for seed in seeds:
        views, imu, truth = simulated(seed)
        calibration = calibrated(views, imu)
        error, covariance = errors(calibration, truth), calibration.uncertainty.covariance[:14, :14]
        found.append(float(error @ np.linalg.solve(covariance, error)) / 14)
    return float(np.mean(found))


@pytest.mark.slow
def test_a_bent_board_of_known_shape_is_no_error() -> None:
    board = apply_shape(BOARD, {"bow_x_m": 2e-3, "bow_y_m": -1e-3, "stretch_share": 3e-3, "skew_rad": 0.0,
                         "tag_share": -9e-3})  # fmt: skip
    views, imu, truth = simulated(3, board=board)
    flat, known = calibrated(views, imu), calibrated(views, imu, board=board)
    assert known.problem.sigmas.corner_px == pytest.approx(0.25, abs=0.01)
    assert flat.problem.sigmas.corner_px > 0.32
    ratio = errors(known, truth) / known.sigma[:14]
    assert np.mean(ratio**2) < 2


def test_derivatives_match_finite_differences(recorded: Recorded) -> None:
    views, imu, _ = recorded
    setup = prepare(views[:70], imu, RIG, BOARD, NOISE, SOURCE)
    problem: CameraImuProblem = replace(setup.problem, scales=True)
    state: CameraImuState = setup.start
    here = linearise_camera_imu(problem, state, None)
    rng = np.random.default_rng(0)
    chain = 1e-6 * rng.normal(size=(len(state.spline.places_m), 12))
    common = 1e-6 * rng.normal(size=len(problem.parameter_names))
    there, back = (
        linearise_camera_imu(problem, retract_state(state, s * chain, s * common), None) for s in (1, -1)
    )
    change = apply_jacobian(here.samples, chain.ravel(), common)
    count = problem.imu.time_s.size
    numeric = (back.samples.residual - there.samples.residual) / 2
    np.testing.assert_allclose(change[-count:], numeric[-count:], atol=1e-9)
    corners = [
        sum((r**2).sum() for r in side.residuals_px) / problem.sigmas.corner_px**2 for side in (there, back)
    ]
    slope = -2 * (change * here.samples.residual)[:-count].sum()
    assert slope == pytest.approx((corners[0] - corners[1]) / 2, rel=1e-5)


def test_errors_lie_within_the_stated_sigmas() -> None:
    assert 0.6 < mean_square(range(100, 104)) < 1.5  # 56 errors: one standard deviation is 0.19


@pytest.mark.slow
def test_errors_have_the_stated_size_over_many_recordings() -> None:
    assert 0.8 < mean_square(range(24)) < 1.25


def test_a_minute_of_swinging_is_not_needed_for_a_good_mounting(recorded: Recorded) -> None:
    views, imu, truth = recorded
    calibration = calibrated(views, imu)
    error = errors(calibration, truth)
    assert np.degrees(np.abs(error[[0, 1, 2, 7, 8, 9]]).max()) < 0.05
    assert np.abs(error[[3, 4, 5, 10, 11, 12]]).max() < 3e-3
    assert np.abs(error[[6, 13]]).max() < 2e-4
    assert abs(calibration.rig.baseline_m - truth.rig.baseline_m) < 2e-4
    assert calibration.rig.timeshift_cam_imu_ns == pytest.approx(3_100_000, abs=200_000)
    assert np.abs(calibration.solution.state.gravity_mps2 - truth.gravity).max() < 0.05
    assert not calibration.uncertainty.undetermined
    for spread in calibration.spreads[1:]:
        assert spread.factor == pytest.approx(1, abs=0.06)
        assert np.abs(spread.after - spread.after_expected).max() < 0.08
    assert calibration.corner_px == pytest.approx(0.25, rel=0.05)


def test_the_cameras_lie_as_their_lenses_have_it_and_the_file_says_so(
    recorded: Recorded, tmp_path: Path
) -> None:
    """A middle that is 0.4 px off turns the camera by as much, so that hardly any depth changes."""
    views, imu, _ = recorded
    found, off_px = calibrated(views, imu), 0.4
    wrong = replace(RIG, cam1=replace(RIG.cam1, cx_px=RIG.cam1.cx_px + off_px))
    other = calibrated(views, imu, wrong)
    names = tuple(f"cam{camera}.{name}" for camera in (0, 1) for name in Lens.RADTAN4.parameter_names)
    at, covariance = names.index("cam1.cx_px"), 1e-12 * np.eye(len(names))
    covariance[at, at] = off_px**2
    told = found.with_lenses(names, covariance)
    turned, plain = (one.sigma[7:10].max() for one in (told, found))  # of cam1, as the report tells it
    assert turned > 0.5 * off_px / RIG.cam1.fx_px > 1.5 * plain
    write_camera_imu(told, tmp_path / "rig.yaml", tmp_path / "chain.yaml")
    read = read_covariance(tmp_path / "rig.yaml")
    assert read is not None
    known, whole = read
    first, second = (one.rig.cam0_from_cam1.inverse() for one in (found, other))
    turn = Rotation.from_matrix(second.rotation @ first.rotation.T).as_rotvec()
    change = np.concatenate([turn, second.translation - first.translation])
    pair = [n for n, name in enumerate(known) if name.startswith("cam1_from_cam0.")]
    assert abs(turn[1]) > 0.5 * off_px / RIG.cam1.fx_px
    np.testing.assert_allclose(whole[known.index("cam1.cx_px"), pair] / off_px, change, atol=3e-5)
    assert np.linalg.eigvalsh(whole).min() > -1e-12
    ahead = second.translation / np.linalg.norm(second.translation)
    assert np.sqrt(ahead @ whole[-3:, -3:] @ ahead) == pytest.approx(told.baseline_sigma_m, rel=1e-3)
    sigma_px = disparity_sigma_px(tmp_path / "rig.yaml", 2.0)
    assert sigma_px is not None and sigma_px < 0.3 * off_px


def test_a_large_time_shift_is_found() -> None:
    views, imu, truth = simulated(5, shift_s=(-0.1231, -0.1231))
    error = errors(calibrated(views, imu), truth)
    assert np.abs(error[[6, 13]]).max() < 2e-4


def test_bad_corners_and_stated_noise_that_is_too_small_do_no_harm(recorded: Recorded) -> None:
    views, imu, truth = recorded
    rng = np.random.default_rng(1)
    worse = []
    for view in views:
        corners = []
        for own in view.cameras:
            assert own is not None
            off = rng.random(own.ids.size) < 0.02
            corners.append(Corners(own.ids, own.pixels + off[:, None] * rng.normal(0, 15, own.pixels.shape)))
        worse.append(BoardView(view.name, corners[0], corners[1]))
    noise = replace(NOISE, gyro_density=NOISE.gyro_density / 3, accel_density=NOISE.accel_density / 3)
    calibration = calibrate_camera_imu(worse, imu, RIG, BOARD, noise, SOURCE)
    assert calibration.removed_corners > 500
    assert calibration.problem.sigmas.gyro_radps == pytest.approx(NOISE.gyro_density * 200**0.5, rel=0.08)
    error = errors(calibration, truth)
    assert (np.abs(error) < 4 * calibration.sigma[:14]).all()


@pytest.mark.slow
def test_scales_of_the_gyro_are_found_or_counted() -> None:
    views, imu, truth = simulated(7, seconds=10.0, gyro_scale=1.01)
    fixed = calibrated(views, imu)
    doubted = {group.name: group.matters for group in fixed.uncertainty.fixed}
    assert doubted["IMU scales and misalignments"]
    freed = calibrated(views, imu, scales=True)
    assert np.abs(np.diag(freed.solution.state.gyro_matrix) - 1.01).max() < 3e-3
    error = errors(freed, truth)
    assert float(error @ np.linalg.solve(freed.uncertainty.covariance[:14, :14], error)) / 14 < 2.5


def test_directions_that_the_motion_does_not_show_are_named() -> None:
    views, imu, _ = simulated(4, one_axis=True)
    known = calibrated(views, imu).uncertainty
    assert any("body_from_cam" in name for name in known.undetermined)
    assert known.singular_values[-1] < 0.01


def refusal(views: list[BoardView], imu: ImuSamples, rig: StereoRig = RIG) -> str:
    with pytest.raises(CalibrationError) as caught:
        calibrated(views, imu, rig)
    return str(caught.value)


def test_what_cannot_be_calibrated_is_said(recorded: Recorded) -> None:
    views, imu, _ = recorded
    assert "never sees the board" in refusal([], imu)
    assert "are needed" in refusal(views[:40], imu)
    late = replace(imu, stamp_ns=imu.stamp_ns + 60_000_000_000)
    assert "don't overlap" in refusal(views, late)
    assert "probably in g" in refusal(views, replace(imu, accel_mps2=imu.accel_mps2 / 9.80665))
    assert "degrees/s" in refusal(views, replace(imu, gyro_radps=np.degrees(imu.gyro_radps)))
    exchanged = [BoardView(view.name, view.cam1, view.cam0) for view in views]
    assert "left and right are swapped" in refusal(exchanged, imu)
    assert "don't match" in refusal(views, simulated(17)[1])
    back = replace(imu, stamp_ns=imu.stamp_ns[::-1].copy())
    assert "go back" in refusal(views, back)
    broken = imu.gyro_radps.copy()
    broken[5] = np.nan
    assert "NaN" in refusal(views, replace(imu, gyro_radps=broken))
    narrow = replace(RIG, cam0=replace(RIG.cam0, fx_px=300.0, fy_px=300.0, cx_px=250.0))
    assert "lens doesn't fit" in refusal(views, imu, narrow)
    still = [BoardView(view.name, views[0].cam0, views[0].cam1) for view in views]
    assert "hardly turns" in refusal(still, imu)


def test_a_knock_is_said_and_counts_less(recorded: Recorded) -> None:
    views, imu, truth = recorded
    accel = imu.accel_mps2.copy()
    ring = 4.0 * np.sin(2 * np.pi * 66.0 * np.arange(60) / 200.0) * np.exp(-np.arange(60) / 20.0)
    accel[600:660] += ring[:, None]
    calibration = calibrated(views, replace(imu, accel_mps2=accel))
    assert any("knocks or vibration near 2 s" in note for note in calibration.notes)
    assert calibration.spreads[2].factor < 1.2
    assert (np.abs(errors(calibration, truth)) < 4 * calibration.sigma[:14]).all()


def test_only_the_stretch_without_gaps_is_used(recorded: Recorded) -> None:
    views, imu, truth = recorded
    kept = np.ones(imu.stamp_ns.size, np.bool_)
    kept[150:190] = False
    gappy = ImuSamples(imu.stamp_ns[kept], imu.gyro_radps[kept], imu.accel_mps2[kept])
    calibration = calibrated(views, gappy)
    assert any("gaps" in note for note in calibration.notes)
    error = errors(calibration, truth)
    assert (np.abs(error) < 4 * calibration.sigma[:14]).all()
