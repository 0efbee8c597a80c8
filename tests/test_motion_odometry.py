"""Stereo odometry: the covariance by Monte Carlo, the chain of steps, and real recordings."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.errors import ConfigError, Failed
from barsight.core.pose import Pose, skew
from barsight.core.records.pairs import RectifiedCamera, RefusedFrame, StereoFrame
from barsight.core.records.trajectory import Trajectory
from barsight.features.guided_matching import (
    project_stereo,
    stereo_jacobian,
    triangulate_stereo,
    triangulation_jacobian,
)
from barsight.motion.frame_to_frame.visual_odometry import StereoOdometry
from barsight.motion.frontend.relative_pose import (
    RelativePose,
    check_sides,
    refine_pose,
    rotate_covariance,
    transport_covariance,
)
from barsight.motion.frontend.relative_pose_kernel import step_equations
from barsight.motion.frontend.stereo_features import OdometrySettings
from barsight.recording.formats.ground_truth import read_ground_truth
from barsight.recording.open import open_recording
from motion_recordings import MemoryRecording, ideal_rig
from synthetic_scenes import Texture, quantised

SETTINGS = OdometrySettings()
YARD = RectifiedCamera(1250.0, 640.0, 512.0, 0.5, 0.0, 1280, 1024)
STREET = RectifiedCamera(707.0, 602.0, 183.0, 0.537, 0.0, 1226, 370)
HALL = RectifiedCamera(457.0, 363.0, 252.0, 0.11, 12.9, 752, 480)
TURN, MOVE = np.array([0.01, 0.02, -0.005]), np.array([0.1, -0.02, 0.3])


@pytest.mark.parametrize("camera", [YARD, STREET])
def test_right_pictures_that_lie_aside_are_found(camera: RectifiedCamera) -> None:
    """A shift of the right camera changes far disparities less; a fifth of the points are wild."""
    rng, rotation = np.random.default_rng(3), Rotation.from_rotvec(TURN).as_matrix()
    for _ in range(40):
        z, count = rng.uniform(6, 8, 200), 200
        pixels = rng.uniform(30, np.array([camera.width, camera.height]) - 30, (count, 2))
        points = np.column_stack([(pixels - [camera.cx_px, camera.cy_px]) / camera.focal_px, np.ones(count)])
        points *= z[:, None]
        noise = rng.normal(0, SETTINGS.pixel_sigma_px, (count, 3))
        target = project_stereo(points @ rotation.T + MOVE, camera) + noise
        target[:40] += rng.uniform(-30, 30, (40, 3))
        late = target + np.array([0, 0, 1]) * (camera.focal_px * 0.02 / z)[:, None]
        assert check_sides(points, target, rotation, MOVE, camera, SETTINGS) is None
        assert isinstance(check_sides(points, late, rotation, MOVE, camera, SETTINGS), Failed)


def refined(
    rng: np.random.Generator, camera: RectifiedCamera, depth_m: tuple[float, float], count: int, wild: int = 0
) -> tuple[RelativePose, np.ndarray]:
    """A step from points seen with noise in all four pictures, and its error (6,)."""
    z = rng.uniform(*depth_m, count)
    u, v = rng.uniform(30, camera.width - 30, count), rng.uniform(30, camera.height - 30, count)
    points = np.column_stack([(u - camera.cx_px) * z, (v - camera.cy_px) * z, camera.focal_px * z])
    points /= camera.focal_px
    rotation = Rotation.from_rotvec(TURN).as_matrix()
    noise = rng.normal(0, SETTINGS.pixel_sigma_px, (2, count, 3))
    target = project_stereo(points @ rotation.T + MOVE, camera) + noise[1]
    target[:wild] += rng.uniform(-30, 30, (wild, 3))
    old = triangulate_stereo(project_stereo(points, camera) + noise[0], camera)
    start = Rotation.from_rotvec(TURN + 2e-4).as_matrix()
    step = refine_pose(old, target, start, MOVE + 0.002, camera, SETTINGS)
    assert isinstance(step, RelativePose)
    turn = Rotation.from_matrix(step.rotation @ rotation.T)
    return step, np.r_[turn.as_rotvec(), step.translation - turn.apply(MOVE)]


@pytest.mark.parametrize(
    ("camera", "depth_m", "count"), [(YARD, (6, 9), 200), (STREET, (5, 32), 200), (HALL, (1, 6), 60)]
)
def test_the_steps_covariance_is_right(
    camera: RectifiedCamera, depth_m: tuple[float, float], count: int
) -> None:
    rng = np.random.default_rng(0)
    errors, nees = [], []
    for _ in range(150):
        step, error = refined(rng, camera, depth_m, count)
        nees.append(error @ np.linalg.solve(step.covariance, error) / 6)
        errors.append(error / np.sqrt(np.diag(step.covariance)))
    assert 0.75 < np.mean(nees) < 1.25
    np.testing.assert_allclose(np.std(errors, axis=0), 1, atol=0.25)
    np.testing.assert_allclose(np.mean(errors, axis=0), 0, atol=0.4)


def test_outliers_dont_pull() -> None:
    rng = np.random.default_rng(1)
    nees = []
    for _ in range(60):
        step, error = refined(rng, YARD, (6, 9), 200, wild=40)
        nees.append(error @ np.linalg.solve(step.covariance, error) / 6)
    assert np.mean(nees) < 1.5


def test_a_step_without_agreement_fails() -> None:
    rng = np.random.default_rng(2)
    places = rng.uniform(50, 300, (60, 3))
    places[:, 2] = places[:, 0] - rng.uniform(20, 40, 60)
    failed = refine_pose(
        triangulate_stereo(places, STREET), places[::-1], np.eye(3), np.zeros(3), STREET, SETTINGS
    )
    assert isinstance(failed, Failed)
    assert failed.code == "no-consensus"


def test_how_points_move_with_their_places() -> None:
    """The derivatives against finite differences."""
    places = np.array([[100.0, 50, 60], [700, 300, 690], [300, 90, 250]])
    expected = np.empty((3, 3, 3))
    for k in range(3):
        moved = np.eye(3)[k] * 1e-5
        expected[:, :, k] = (
            triangulate_stereo(places + moved, HALL) - triangulate_stereo(places - moved, HALL)
        ) / 2e-5
    np.testing.assert_allclose(
        triangulation_jacobian(triangulate_stereo(places, HALL), HALL), expected, rtol=1e-6, atol=1e-9
    )


def test_the_kernel_against_matrices() -> None:
    rng = np.random.default_rng(5)
    points = rng.uniform((-2, -2, 3), (2, 2, 9), (80, 3))
    points[7, 2] = -1
    turn, variance = Rotation.from_rotvec(TURN).as_matrix(), 0.09
    target = project_stereo(points @ turn.T + MOVE, HALL) + rng.normal(0, 0.5, (80, 3))
    target[:10] += rng.uniform(-20, 20, (10, 3))
    by_old = triangulation_jacobian(points, HALL)
    base = HALL.focal_px * HALL.baseline_m
    lens = np.array([HALL.focal_px, HALL.cx_px, HALL.cy_px, base, HALL.doffs_px])
    distance, normal, gradient = np.empty(80), np.empty((6, 6)), np.empty(6)
    step_equations(points, by_old, target, turn, MOVE, lens, variance, distance, normal, gradient)
    moved = points @ turn.T + MOVE
    by_point = stereo_jacobian(moved, HALL)
    jacobian = np.concatenate([-by_point @ skew(moved), by_point], axis=2)
    spread = by_point @ turn @ by_old
    information = np.linalg.inv(variance * (spread @ spread.transpose(0, 2, 1) + np.eye(3)))
    residual = np.nan_to_num(target - project_stereo(moved, HALL))
    expected = np.sqrt(np.einsum("ni,nij,nj->n", residual, information, residual))
    expected[7] = np.inf
    weight = np.where(expected < 5, np.minimum(1, 1.5 / expected), 0)
    assert 0 < np.count_nonzero(weight) < 79
    np.testing.assert_allclose(distance, expected)
    np.testing.assert_allclose(
        normal, np.einsum("n,nki,nkl,nlj->ij", weight, jacobian, information, jacobian)
    )
    np.testing.assert_allclose(
        gradient, np.einsum("n,nki,nkl,nl->i", weight, jacobian, information, residual)
    )


def test_covariances_add_up_along_a_chain() -> None:
    """Steps with known noise, chained: the estimator's sum against the scatter of 1000 noisy chains."""
    rng = np.random.default_rng(3)
    mount = Pose(
        "body", "rect0", Rotation.from_rotvec([0.5, -1, 0.3]).as_matrix(), np.array([0.4, -0.3, 0.8])
    )
    sigma = np.diag([2e-4, 3e-4, 1e-4, 1e-3, 2e-3, 3e-3]) ** 2
    step = Pose(
        "rect0", "rect0", Rotation.from_rotvec([0.02, 0.1, -0.05]).as_matrix(), np.array([0.3, 0.1, -1.2])
    )
    start = Pose("world", "body", Rotation.from_rotvec([1.0, 0.2, -0.4]).as_matrix(), np.zeros(3))
    pose, stated = start, np.zeros((6, 6))
    for _ in range(12):
        world_from_new = pose @ mount @ step.inverse()
        following = world_from_new @ mount.inverse()
        lever = following.translation - world_from_new.translation
        stated = transport_covariance(stated, following.translation - pose.translation)
        stated += transport_covariance(rotate_covariance(sigma, world_from_new.rotation), lever)
        pose = following
    errors = []
    for _ in range(1000):
        noisy = start @ mount
        for _ in range(12):
            w = rng.normal(0, np.sqrt(np.diag(sigma)))
            wobble = Pose("rect0", "rect0", Rotation.from_rotvec(w[:3]).as_matrix(), w[3:])
            noisy = noisy @ (wobble @ step).inverse()
        end = noisy @ mount.inverse()
        turn = Rotation.from_matrix(end.rotation @ pose.rotation.T).as_rotvec()
        errors.append(np.r_[turn, end.translation - pose.translation])
    scatter = np.cov(np.array(errors).T)
    whiten = np.linalg.inv(np.linalg.cholesky(stated))
    np.testing.assert_allclose(whiten @ scatter @ whiten.T, np.eye(6), atol=0.2)


DEPTH_PX = 24
TEXTURE = Texture(7)


def picture_pair(stamp_ns: int, shift_px: float) -> StereoFrame:
    """A wall 5 m away (f 300 px, baseline 0.4 m) seen by a rig that moved shift_px / 60 m to the right."""
    u, v = np.meshgrid(np.arange(320.0), np.arange(240.0))
    left, right = (quantised(TEXTURE(u + shift_px + d, v)) for d in (0, DEPTH_PX))
    return StereoFrame(stamp_ns, left, right)


def estimated(pictures: list[StereoFrame | RefusedFrame]) -> tuple[Trajectory, int]:
    source = MemoryRecording(ideal_rig(), tuple(pictures))
    told: list[int] = []
    settings = OdometrySettings(features=600)
    trajectory = StereoOdometry(settings)(source, Rectifier(source.rig), lambda: told.append(1))
    return trajectory, len(told)


def test_a_wall_that_passes_by() -> None:
    """Torn, black and foreign pictures are refused with a reason; the next is tied to the last good one."""
    black = np.zeros((240, 320), np.uint8)
    foreign = StereoFrame(5, *np.random.default_rng(0).integers(0, 256, (2, 240, 320), dtype=np.uint8))
    pictures = [
        picture_pair(1, 0.0),
        picture_pair(2, 3.3),
        RefusedFrame(3, "torn"),
        StereoFrame(4, black, black),
        foreign,
        picture_pair(6, 7.8),
    ]
    trajectory, told = estimated(pictures)
    assert told == 6
    assert trajectory.reference == "world"
    assert trajectory.sensors == ("stereo",)
    assert [f.stamp_ns for f in trajectory.frames] == [1, 2, 6]
    assert [f.stamp_ns for f in trajectory.refused] == [3, 4, 5]
    assert trajectory.refused[0].reason == "torn"
    assert "have a depth" in trajectory.refused[1].reason
    # World's X is where cam0 looks, its Z up; the rig moves along cam0's x, to the right: along -Y.
    np.testing.assert_allclose(trajectory.positions_m, np.outer([0, -3.3, -7.8], [0, 1 / 60, 0]), atol=1e-3)
    sigma = [np.sqrt(np.diag(f.covariance)) for f in trajectory.frames]
    assert (sigma[0] <= 1e-6).all()
    assert (sigma[0] < sigma[1]).all()
    assert (sigma[1] < sigma[2]).all()


def test_nothing_that_can_be_followed() -> None:
    black = np.zeros((240, 320), np.uint8)
    trajectory, _ = estimated([StereoFrame(1, black, black)])
    assert trajectory.frames == ()
    assert trajectory.length_m == 0
    assert trajectory.stamp_ns.shape == (0,)


def test_settings() -> None:
    for setting in ({"features": 10}, {"min_inliers": 3}, {"pixel_sigma_px": 0.0}, {"ransac_px": -1.0}):
        with pytest.raises(ConfigError):
            OdometrySettings(**setting)


def measured(path: Path) -> Trajectory:
    recording = open_recording(path)
    return StereoOdometry(SETTINGS)(recording, Rectifier(recording.rig), lambda: None)


def test_a_car_drives(data: Path) -> None:
    """KITTI: the translation's error over all stretches of 10 m and more, as that benchmark averages it."""
    path = data / "kitti_odometry_a"
    trajectory = measured(path)
    assert len(trajectory.frames) == 41
    truth = read_ground_truth(path, trajectory.stamp_ns).poses
    found = [frame.reference_from_body for frame in trajectory.frames]
    way = np.r_[0, np.cumsum([a.distance_to(b) for a, b in pairwise(truth)])]
    errors = []
    for i in range(len(truth)):
        for j in np.flatnonzero(way - way[i] >= 10):
            true_step = truth[i].inverse() @ truth[j]
            step = found[i].inverse() @ found[j]
            errors.append(step.distance_to(true_step) / (way[j] - way[i]))
    assert len(errors) > 400
    assert np.mean(errors) < 0.012
    assert np.max(errors) < 0.018
    whole = (found[0].inverse() @ found[-1]).distance_to(truth[0].inverse() @ truth[-1])
    assert whole < 0.015 * way[-1]


def test_a_rig_that_stands_still(data: Path) -> None:
    trajectory = measured(data / "euroc_v101_still")
    assert len(trajectory.frames) == 10
    assert trajectory.sensors == ("stereo", "imu")
    assert np.abs(trajectory.positions_m).max() < 0.01
    up = trajectory.frames[0].reference_from_body.rotation[2]
    assert up[0] > 0.9  # EuRoC's IMU has its x axis up
