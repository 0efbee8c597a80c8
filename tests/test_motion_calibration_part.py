"""Lenses calibrated a little wrong, as rows of matches show them: as much as the file's covariance says."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from barsight.calibration.files.rig_file import write_rig_file
from barsight.calibration.geometry.rectification import right_from_rectified
from barsight.calibration.geometry.rig import StereoRig
from barsight.calibration.stereo.disparity_uncertainty import rig_covariance
from barsight.calibration.stereo.projection_uncertainty import sample_pairs, triangulate_depth
from barsight.core.pose import Pose
from barsight.core.records.trajectory import RigDrift
from barsight.motion.rig_check.calibration_part import calibration_covariance
from barsight.motion.rig_check.epipolar_error import row_design
from barsight.motion.rig_check.self_calibration import residual_covariance
from barsight.simulation.optics import mount_rig
from barsight.simulation.settings.recording import SimulationSettings
from barsight.simulation.simulate import stream

NAMES = ("cam0.fx_px", "cam0.fy_px", "cam0.cx_px", "cam0.cy_px", "cam0.k1", "cam0.k2", "cam0.p1", "cam0.p2")
SIGMAS = (0.4, 0.4, 0.6, 0.3, 1e-3, 4e-3, 1e-4, 3e-4)


def rows_seen(truth: StereoRig, known: StereoRig) -> np.ndarray:
    """Fit what `known` makes of points that `truth` sees 5 m away."""
    _, left, right = sample_pairs(truth, [5.0])
    turned = right_from_rectified(known)
    a = known.cam0.rays(left) @ known.cam0_from_cam1.rotation @ turned
    b = known.cam1.rays(right) @ turned
    x, y = (b[:, :2] / b[:, 2:]).T
    return np.linalg.lstsq(row_design(x, y), y - a[:, 1] / a[:, 2], rcond=None)[0]


def test_wrong_lenses_shift_rows_as_much_as_stated(tmp_path: Path) -> None:
    settings = SimulationSettings(seed=3)
    rig = mount_rig(settings, stream(settings, 2)).rig
    covariance = np.diag(np.square(SIGMAS))
    section = {"parameters": list(NAMES), "covariance": covariance.tolist()}
    write_rig_file(tmp_path / "rig.yaml", rig, section)
    stated = np.sqrt(np.diag(calibration_covariance(tmp_path / "rig.yaml", 5.0)))
    rng, found = np.random.default_rng(1), []
    for _ in range(400):
        off = rng.normal(0, SIGMAS)
        camera = rig.cam0
        fx, fy, cx, cy = np.array([camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px]) + off[:4]
        lens = tuple((np.array(camera.coefficients) + off[4:]).tolist())
        drawn = type(camera)(
            camera.width, camera.height, float(fx), float(fy), float(cx), float(cy), camera.distortion, lens
        )
        known = StereoRig(drawn, rig.cam1, rig.body_from_cam0, rig.body_from_cam1)
        found.append(rows_seen(rig, known))
    assert np.std(found, axis=0) == pytest.approx(stated, rel=0.12)
    assert np.degrees(stated[3]) > 0.003


def test_a_rig_without_a_covariance_adds_nothing(tmp_path: Path) -> None:
    settings = SimulationSettings(seed=3)
    write_rig_file(tmp_path / "rig.yaml", mount_rig(settings, stream(settings, 2)).rig)
    for path in (None, tmp_path / "rig.yaml"):
        assert not calibration_covariance(path, float("nan")).any()


def test_a_wrong_rig_shifts_depths_as_its_three_figures_say(tmp_path: Path) -> None:
    """Rigs drawn by the file's covariance: depths of what they see, near and far."""
    settings = SimulationSettings(seed=3)
    rig = mount_rig(settings, stream(settings, 2)).rig
    sigmas = (0.4, 0.4, 4e-5, 1.2e-4)
    names = ("cam0.fx_px", "cam0.fy_px", "cam1_from_cam0.ry_rad", "cam1_from_cam0.tx_m")
    section = {"parameters": list(names), "covariance": np.diag(np.square(sigmas)).tolist()}
    write_rig_file(tmp_path / "rig.yaml", rig, section)
    covariance = rig_covariance(tmp_path / "rig.yaml", 7.0)
    assert covariance is not None
    assert covariance[1, 1] ** 0.5 == pytest.approx(1.2e-4 / rig.baseline_m, rel=0.01)
    at, left, right = sample_pairs(rig, [4.5, 7.0])
    rng, depths = np.random.default_rng(2), []
    for _ in range(400):
        off = rng.normal(0, sigmas)
        camera = replace(rig.cam0, fx_px=rig.cam0.fx_px + off[0], fy_px=rig.cam0.fy_px + off[1])
        cam1 = rig.cam0_from_cam1.inverse()
        turned = Rotation.from_rotvec([0, off[2], 0]).as_matrix() @ cam1.rotation
        moved = Pose("cam1", "cam0", turned, cam1.translation + np.array([off[3], 0, 0]))
        drawn = StereoRig(camera, rig.cam1, rig.body_from_cam0, rig.body_from_cam0 @ moved.inverse())
        depths.append(triangulate_depth(drawn, left, right))
    scatter = np.std(depths, axis=0)
    for place, range_m in enumerate((4.5, 7.0)):
        arm = np.array([-(range_m**2) / rig.baseline_m, range_m, range_m])
        stated = float(np.sqrt(arm @ covariance @ arm))
        assert np.median(scatter[at == place]) == pytest.approx(stated, rel=0.15)


def test_what_travel_leaves_open_of_a_rig_is_as_large_as_stated() -> None:
    rng = np.random.default_rng(4)
    half = np.diag([4e-5, 3e-4, 3e-4]) @ np.array([[1, 0, 0], [0.3, 0.95, 0], [0.2, -0.4, 0.9]])
    noise = np.array([[2e-5, 0], [1e-4, 2e-4]])
    squares = []
    for _ in range(2000):
        error = half @ rng.normal(size=3)
        seen = error[:2] + noise @ rng.normal(size=2)
        drift = RigDrift(seen[0], -seen[1], noise @ noise.T * [[1, -1], [-1, 1]], np.ones(2), 0.4, 7.0, True)
        left = residual_covariance(half @ half.T, drift, corrected=False)
        squares.append(error**2 / np.diag(left))
    assert np.mean(squares, axis=0) == pytest.approx(1, abs=0.12)
    unseen = residual_covariance(half @ half.T, None, corrected=False)
    np.testing.assert_array_equal(unseen, half @ half.T)


def test_what_was_held_of_the_drift_before_is_not_told_by_the_travel() -> None:
    calibrated = np.diag(np.square([4e-5, 1e-3, 5e-4]))
    held = np.array([3.5e-3, 5e-4])
    nothing = RigDrift(0.0, 0.0, np.diag(held**2), held, 0.4, 7.0, True)
    np.testing.assert_allclose(residual_covariance(calibrated, nothing, corrected=False), calibrated)
    told = np.array([[1.0, 0.06], [0.0, 1.0]]) @ np.diag([1e-5, 4e-4])
    known, seen = np.linalg.inv(told @ told.T), np.array([3e-5, 2e-4])
    both = np.linalg.inv(known + np.diag(held**-2))
    alone = RigDrift(*seen, told @ told.T, np.full(2, 1e3), 0.4, 7.0, True)
    combined = RigDrift(*(both @ known @ seen), both, held, 0.4, 7.0, True)
    left = [residual_covariance(calibrated, drift, corrected=False) for drift in (alone, combined)]
    np.testing.assert_allclose(left[1], left[0], rtol=1e-6, atol=1e-16)
