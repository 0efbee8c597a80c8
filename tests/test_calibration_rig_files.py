"""Rig files of every format: back bit for bit or to rounding, and mistakes named."""

from pathlib import Path

import numpy as np
import pytest

from barsight.calibration.boards.board_warp import BentBoard
from barsight.calibration.files.rig_file import read_board, read_covariance, write_rig_file
from barsight.calibration.files.rig_formats import RigFormat, read_rig_file, select_rig, write_any_rig
from barsight.calibration.files.yaml_document import canonical_pose
from barsight.calibration.geometry.camera import Camera, Distortion
from barsight.calibration.geometry.projection import Lens
from barsight.calibration.geometry.rig import StereoRig
from barsight.calibration.stereo.calibration import calibrate_stereo, rig_file_section
from barsight.calibration.stereo.disparity_uncertainty import disparity_sigma_px, rig_covariance
from barsight.calibration.stereo.projection_uncertainty import depth_sigma
from barsight.cli.main import run
from barsight.core.errors import CalibrationError
from barsight.core.pose import Pose
from barsight.motion.rig_check.calibration_part import calibration_covariance
from calibration_views import BOARD, CAM0, CAM1, ROTATION, SIZE, TRANSLATION_M, simulated


def rig(distortion: Distortion = Distortion.RADTAN) -> StereoRig:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = ROTATION, TRANSLATION_M
    cameras = [
        Camera(c.width, c.height, c.fx_px, c.fy_px, c.cx_px, c.cy_px, distortion, c.coefficients)
        for c in (CAM0, CAM1)
    ]
    right = canonical_pose("body", "cam1", matrix, inverted=True)
    return StereoRig(cameras[0], cameras[1], Pose.identity("body", "cam0"), right)


@pytest.mark.parametrize("distortion", [Distortion.RADTAN, Distortion.EQUIDISTANT])
@pytest.mark.parametrize(
    ("form", "name"),
    [(RigFormat.BARSIGHT, "rig.yaml"), (RigFormat.KALIBR, "camchain.yaml"), (RigFormat.OPENCV, "rig.yml"),
     (RigFormat.OPENCV, "rig.xml"), (RigFormat.EUROC, "euroc")],
)  # fmt: skip
def test_every_format_reads_back(tmp_path: Path, form: RigFormat, name: str, distortion: Distortion) -> None:
    original = rig(distortion)
    write_any_rig(tmp_path / name, original, form)
    read = read_rig_file(tmp_path / name)
    assert (read.cam0, read.cam1) == (original.cam0, original.cam1)
    assert np.abs(read.cam0_from_cam1.matrix - original.cam0_from_cam1.matrix).max() < 1e-12
    assert [p.name for p in tmp_path.iterdir()] == [name]


def test_a_calibrations_covariance_comes_back(tmp_path: Path) -> None:
    calibration = calibrate_stereo(simulated(4), BOARD, Lens.RADTAN5, (SIZE, SIZE), Path("simulated"))
    write_rig_file(tmp_path / "rig.yaml", calibration.rig, rig_file_section(calibration))
    found = read_covariance(tmp_path / "rig.yaml")
    assert found is not None
    assert found[0] == calibration.parameter_names
    assert np.array_equal(found[1], calibration.covariance)
    board = read_board(tmp_path / "rig.yaml", calibration.board)
    assert isinstance(board, BentBoard)
    np.testing.assert_array_equal(board.shape, calibration.shape.values)
    write_rig_file(tmp_path / "plain.yaml", calibration.rig)
    assert read_board(tmp_path / "plain.yaml", calibration.board) is calibration.board
    assert read_covariance(tmp_path / "plain.yaml") is None


def test_opencvs_two_files_are_read_together(tmp_path: Path) -> None:
    write_any_rig(tmp_path / "whole.yml", rig(), RigFormat.OPENCV)
    text = (tmp_path / "whole.yml").read_text()
    place = text.index("\nR:")
    (tmp_path / "intrinsics.yml").write_text(text[: place + 1])
    with pytest.raises(CalibrationError, match="R is missing"):
        read_rig_file(tmp_path / "intrinsics.yml")
    (tmp_path / "extrinsics.yml").write_text("%YAML:1.0\n---" + text[place:])
    assert read_rig_file(tmp_path / "intrinsics.yml").baseline_m == pytest.approx(rig().baseline_m)


@pytest.mark.parametrize(
    ("change", "expected"),
    [(("image_width", "image_wide"), "the pictures' size"),
     (("M2:", "M9:"), "M2 or K2 or cameraMatrix2 is missing"),
     (("[ -0.2000", "[ -200.2000"), "probably in mm")],
)  # fmt: skip
def test_mistakes_in_opencvs_files_are_named(tmp_path: Path, change: tuple[str, str], expected: str) -> None:
    path = tmp_path / "rig.yml"
    write_any_rig(path, rig(), RigFormat.OPENCV)
    text = path.read_text()
    assert change[0] in text
    path.write_text(text.replace(*change))
    with pytest.raises(CalibrationError, match=expected):
        read_rig_file(path)


def test_what_is_no_rig_is_said(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text("barsight_rig: 7\n")
    with pytest.raises(CalibrationError, match="version 7 is not known"):
        read_rig_file(path)
    path.write_text("a: 1\n")
    with pytest.raises(CalibrationError, match="holds no stereo rig"):
        read_rig_file(path)
    with pytest.raises(CalibrationError, match="no such file"):
        read_rig_file(tmp_path / "none.xml")
    (tmp_path / "torn.xml").write_text("<a")
    with pytest.raises(CalibrationError, match="not a file that OpenCV reads"):
        read_rig_file(tmp_path / "torn.xml")


def test_export_command(tmp_path: Path) -> None:
    write_any_rig(tmp_path / "rig.yaml", rig(), RigFormat.BARSIGHT)
    for form, name in (("kalibr", "chain.yaml"), ("opencv", "cv.xml"), ("euroc", "folder")):
        out = tmp_path / name
        assert run(["calibrate", "export", str(tmp_path / "rig.yaml"), "-o", str(out), "--to", form]) == 0
        assert read_rig_file(out).baseline_m == pytest.approx(rig().baseline_m)
    assert (
        run(["calibrate", "export", str(tmp_path / "no.yaml"), "-o", str(tmp_path / "x"), "--to", "euroc"])
        == 3
    )


def test_a_covariance_gives_the_shared_disparity_error(tmp_path: Path) -> None:
    """As the calibration's own depth uncertainty has it, and None where nothing is known."""
    calibration = calibrate_stereo(simulated(3), BOARD, Lens.RADTAN4, (SIZE, SIZE), Path("views"), [])
    write_rig_file(tmp_path / "rig.yaml", calibration.rig, rig_file_section(calibration))
    write_rig_file(tmp_path / "bare.yaml", calibration.rig)
    sigma_m = depth_sigma(calibration, [2.0])[0, 0]
    expected = sigma_m * calibration.rig.cam0.fx_px * calibration.rig.baseline_m / 2.0**2
    found = disparity_sigma_px(tmp_path / "rig.yaml", 2.0)
    assert found == pytest.approx(expected, rel=0.02)
    assert disparity_sigma_px(tmp_path / "bare.yaml", 2.0) is None
    assert disparity_sigma_px(None, 2.0) is None


def test_a_mounting_on_an_imu_changes_no_disparity_error(tmp_path: Path) -> None:
    """A file of `calibrate camera-imu` tells of the mountings and clocks too."""
    calibration = calibrate_stereo(simulated(3), BOARD, Lens.RADTAN4, (SIZE, SIZE), Path("views"), [])
    section = rig_file_section(calibration)
    write_rig_file(tmp_path / "rig.yaml", calibration.rig, section)
    count = 2 * len(Lens.RADTAN4.parameter_names)
    parts = ("rx_rad", "ry_rad", "rz_rad", "tx_m", "ty_m", "tz_m", "timeshift_s")
    mounts = [f"body_from_cam{camera}.{part}" for camera in (0, 1) for part in parts]
    names = calibration.parameter_names
    section["parameters"] = [*names[:count], *mounts, *names[count:]]
    whole = np.eye(len(names) + len(mounts)) * 1e-6
    own = np.r_[:count, count + len(mounts) : len(whole)]
    whole[np.ix_(own, own)] = calibration.covariance
    section["covariance"] = whole.tolist()
    write_rig_file(tmp_path / "imu.yaml", calibration.rig, section)
    for found in (disparity_sigma_px, rig_covariance, calibration_covariance):
        without, with_imu = (np.array(found(tmp_path / f"{name}.yaml", 2.0)) for name in ("rig", "imu"))
        np.testing.assert_allclose(with_imu, without, rtol=1e-9)
    section["parameters"], section["covariance"] = [*mounts, *names[count:]], whole[count:, count:].tolist()
    write_rig_file(tmp_path / "exact.yaml", calibration.rig, section)
    assert disparity_sigma_px(tmp_path / "exact.yaml", 2.0) is None


def test_a_rig_of_two_cameras_keeps_the_recordings_mounting(tmp_path: Path) -> None:
    mount = Pose("body", "cam0", np.diag([1.0, -1, -1]), np.array([0.1, 0.2, 0.3]))
    bare = rig()
    own = StereoRig(bare.cam0, bare.cam1, mount, mount @ bare.cam0_from_cam1, 7)
    write_rig_file(tmp_path / "cameras.yaml", bare)
    write_rig_file(tmp_path / "whole.yaml", StereoRig(bare.cam0, bare.cam1, mount, own.body_from_cam1, 9))
    assert select_rig(None, own) is own
    kept = select_rig(tmp_path / "cameras.yaml", own)
    assert kept.body_from_cam0.distance_to(mount) == 0
    assert kept.timeshift_cam_imu_ns == 7
    assert kept.cam0_from_cam1.distance_to(bare.cam0_from_cam1) < 1e-12
    assert select_rig(tmp_path / "whole.yaml", own).timeshift_cam_imu_ns == 9
    with pytest.raises(CalibrationError):
        select_rig(tmp_path / "none.yaml", own)
