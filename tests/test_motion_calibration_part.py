"""Lenses calibrated a little wrong, as rows of matches show them: as much as the file's covariance says."""

from pathlib import Path

import numpy as np
import pytest

from barsight.calibration.files.rig_file import write_rig_file
from barsight.calibration.geometry.rectification import right_from_rectified
from barsight.calibration.geometry.rig import StereoRig
from barsight.calibration.stereo.projection_uncertainty import sample_pairs
from barsight.motion.rig_check.calibration_part import calibration_covariance
from barsight.motion.rig_check.epipolar_error import row_design
from barsight.simulation.optics import mount_rig
from barsight.simulation.settings import SimulationSettings
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
