"""Rigs in EuRoC's and Kalibr's files: the same bits whichever way they were stored."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from barsight.calibration.files.euroc import read_imu, read_rig, write_imu_description, write_rig
from barsight.calibration.files.kalibr import read_camchain, read_imu_file, write_camchain, write_imu_file
from barsight.calibration.files.opencv import read_opencv_rig, write_opencv_rig
from barsight.calibration.files.yaml_document import canonical_pose, read_document
from barsight.calibration.geometry.camera import Camera, Distortion
from barsight.calibration.geometry.imu_noise import ImuNoise
from barsight.calibration.geometry.rig import StereoRig
from barsight.core.errors import CalibrationError
from recording_samples import NOISE, camera_yaml, mounts, real

TOPICS = ("/cam0/image_raw", "/cam1/image_raw")


def assert_same_rig(one: StereoRig, other: StereoRig) -> None:
    np.testing.assert_array_equal(one.body_from_cam0.matrix, other.body_from_cam0.matrix)
    np.testing.assert_array_equal(one.body_from_cam1.matrix, other.body_from_cam1.matrix)
    assert (one.cam0, one.cam1) == (other.cam0, other.cam1)
    assert one.timeshift_cam_imu_ns == other.timeshift_cam_imu_ns


def rig(camera: Camera, attitude: list[float], place: list[float]) -> StereoRig:
    body_from_cam0 = np.eye(4)
    body_from_cam0[:3, :3] = Rotation.from_rotvec(attitude).as_matrix()
    body_from_cam0[:3, 3] = place
    cam0_from_cam1 = np.eye(4)
    cam0_from_cam1[:3, :3] = Rotation.from_rotvec([0.01, 0.02, -0.015]).as_matrix()
    cam0_from_cam1[:3, 3] = 0.5, 0.004, -0.003
    return StereoRig(
        camera,
        camera,
        canonical_pose("body", "cam0", body_from_cam0),
        canonical_pose("body", "cam1", body_from_cam0 @ cam0_from_cam1),
        -3_456_789,
    )


numbers = st.floats(-3, 3, allow_subnormal=False)


@settings(max_examples=60, deadline=None)
@given(st.lists(numbers, min_size=3, max_size=3), st.lists(numbers, min_size=3, max_size=3))
def test_any_rig_comes_back_bit_for_bit(
    tmp_path_factory: pytest.TempPathFactory, attitude: list[float], place: list[float]
) -> None:
    folder = tmp_path_factory.mktemp("rig")
    camera = Camera(1280, 1024, 1250.1, 1250.3, 640.7, 511.2, Distortion.RADTAN, (-0.1, 1e-05, 3e-7, 1 / 3))
    original = rig(camera, attitude, place)
    write_camchain(folder / "camchain-imucam.yaml", original, TOPICS)
    from_kalibr = read_camchain(folder / "camchain-imucam.yaml").rig
    assert_same_rig(from_kalibr, original)
    write_rig(folder / "mav0", from_kalibr, 20.0)
    assert_same_rig(read_rig(folder / "mav0"), original)


@pytest.mark.parametrize(
    ("distortion", "coefficients"),
    [
        (Distortion.NONE, ()),
        (Distortion.RADTAN, (0.1, -0.2, 1e-3, 2e-3)),
        (Distortion.RADTAN, (0.1, -0.2, 1e-3, 2e-3, 0.05)),
        (Distortion.RADTAN, (0.1, -0.2, 1e-3, 2e-3, 0.05, 0.01, 0.02, 0.03)),
        (Distortion.EQUIDISTANT, (0.01, -0.02, 0.003, -0.004)),
    ],
)
def test_every_lens_in_both_files(
    tmp_path: Path, distortion: Distortion, coefficients: tuple[float, ...]
) -> None:
    camera = Camera(640, 480, 400.0, 401.0, 320.0, 240.0, distortion, coefficients)
    original = rig(camera, [0.1, 0.2, 0.3], [0.0, 0.1, 0.2])
    write_rig(tmp_path / "mav0", original, 20.0)
    assert_same_rig(read_rig(tmp_path / "mav0"), original)
    write_camchain(tmp_path / "chain.yaml", original, TOPICS)
    chain = read_camchain(tmp_path / "chain.yaml")
    assert_same_rig(chain.rig, original)
    assert chain.topics == TOPICS
    assert chain.knows_imu


@pytest.mark.parametrize("name", ["euroc_v101_still", "yard_dev"])
def test_real_rigs_through_kalibrs_inverse(tmp_path: Path, name: str) -> None:
    original = read_rig(real(name) / "mav0")
    write_camchain(tmp_path / "chain.yaml", original, TOPICS)
    assert_same_rig(read_camchain(tmp_path / "chain.yaml").rig, original)


def test_rounding_moves_a_mounting_by_less_than_a_picometre() -> None:
    matrix = mounts()[1]
    pose = canonical_pose("body", "cam1", matrix)
    assert np.abs(pose.rotation - matrix[:3, :3]).max() < 1e-13
    assert np.abs(pose.translation - matrix[:3, 3]).max() < 1e-12


def test_both_directions_mean_what_they_say(tmp_path: Path) -> None:
    matrix = mounts()[0]
    forward = canonical_pose("body", "cam0", matrix)
    backward = canonical_pose("body", "cam0", np.linalg.inv(matrix), inverted=True)
    np.testing.assert_array_equal(forward.matrix, backward.matrix)
    np.testing.assert_allclose(forward.apply(np.zeros(3)), matrix[:3, 3], atol=1e-12)


def chain_values() -> dict[str, dict[str, object]]:
    values: dict[str, dict[str, object]] = {}
    for k, matrix in enumerate(mounts()):
        section = camera_yaml(matrix, distortion_model="radtan", rostopic=f"/left_or_right_{k}")
        section["distortion_coeffs"] = section.pop("distortion_coefficients")
        del section["T_BS"]
        section["T_cam_imu"] = np.linalg.inv(matrix).tolist()
        values[f"cam{k}"] = section
    return values


def written(tmp_path: Path, values: object) -> Path:
    path = tmp_path / "camchain-imucam.yaml"
    path.write_text(yaml.safe_dump(values))
    return path


def test_a_camchain_without_imu_has_its_body_in_cam0(tmp_path: Path) -> None:
    values = chain_values()
    for section in values.values():
        del section["T_cam_imu"]
    values["cam1"]["T_cn_cnm1"] = (np.linalg.inv(mounts()[1]) @ mounts()[0]).tolist()
    chain = read_camchain(written(tmp_path, values))
    assert not chain.knows_imu
    np.testing.assert_array_equal(chain.rig.body_from_cam0.matrix, np.eye(4))
    np.testing.assert_allclose(chain.rig.body_from_cam1.translation, [0.12, 0.001, -0.002], atol=1e-9)


def test_kalibrs_two_statements_must_agree(tmp_path: Path) -> None:
    values = chain_values()
    stereo = np.linalg.inv(mounts()[1]) @ mounts()[0]
    values["cam1"]["T_cn_cnm1"] = stereo.tolist()
    read_camchain(written(tmp_path, values))
    stereo[0, 3] += 0.01
    values["cam1"]["T_cn_cnm1"] = stereo.tolist()
    with pytest.raises(CalibrationError, match=r"cam1\.T_cn_cnm1: contradicts both T_cam_imu by 10\.0 mm"):
        read_camchain(written(tmp_path, values))


@pytest.mark.parametrize(
    ("section", "key", "value", "message"),
    [
        ("cam1", None, None, "cam1: is missing"),
        ("cam0", "T_cam_imu", [[2.0, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]], "not a rotation"),
        ("cam0", "T_cam_imu", [[1.0, 0, 0, 0], [0, 1, 0, 0]], r"cam0\.T_cam_imu: is not a 4x4"),
        ("cam1", "distortion_coeffs", [0.1], r"cam1\.distortion_coeffs: radial-tangential takes"),
        ("cam1", "resolution", [64.5, 48], "whole number of pixels"),
        ("cam0", "timeshift_cam_imu", "soon", r"cam0\.timeshift_cam_imu: holds something"),
        ("cam0", "intrinsics", [float("inf"), 1, 1, 1], "is not finite"),
        ("cam0", "intrinsics", "wide", "is not a list"),
    ],
)
def test_a_wrong_key_is_named(
    tmp_path: Path, section: str, key: str | None, value: object, message: str
) -> None:
    values = chain_values()
    if key is None:
        del values[section]
    else:
        values[section][key] = value
    with pytest.raises(CalibrationError, match=message) as caught:
        read_camchain(written(tmp_path, values))
    assert "camchain-imucam.yaml" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_swapped_cameras_are_named(tmp_path: Path) -> None:
    values = chain_values()
    values["cam0"], values["cam1"] = values["cam1"], values["cam0"]
    with pytest.raises(CalibrationError, match="left and right are swapped"):
        read_camchain(written(tmp_path, values))


@pytest.mark.parametrize("data", ["[ 1., !!binary ???, 3. ]", "!!binary |", '"$base64$AAAA"'])
def test_opencv_isnt_given_base64(tmp_path: Path, data: str) -> None:
    """Its reader of 4.14 doesn't end on the first two."""
    path = tmp_path / "a.yaml"
    path.write_text(
        f"%YAML:1.0\n---\nM1: !!opencv-matrix\n   rows: 1\n   cols: 3\n   dt: d\n   data: {data}\n"
    )
    with pytest.raises(CalibrationError, match="base64"):
        read_opencv_rig(path)


@pytest.mark.parametrize("list_items", ["-" * 100_000, "- " * 100_000, "-\t" * 100_000])
def test_opencv_isnt_given_lists_in_lists(tmp_path: Path, list_items: str) -> None:
    """Its reader overflows the stack; a rule of dashes in a comment is none."""
    path = tmp_path / "a.yaml"
    camera = Camera(64, 48, 50.0, 50.0, 32.0, 24.0, Distortion.RADTAN, (-0.1, 0.0, 0.0, 0.0))
    write_opencv_rig(path, rig(camera, [0.1, -0.2, 0.3], [0.0, -0.1, 0.2]))
    path.write_text(path.read_text().replace("---\n", f"---\n# {'-' * 100}\n", 1))
    read_opencv_rig(path)
    path.write_text(path.read_text().replace("rows: 3", f"rows: {list_items}", 1))
    with pytest.raises(CalibrationError, match="brackets"):
        read_opencv_rig(path)


def test_yaml_as_it_is_in_the_wild(tmp_path: Path) -> None:
    """OpenCV's first line, a BOM, CRLF, and numbers that YAML 1.1 takes for text."""
    path = tmp_path / "a.yaml"
    path.write_bytes("\ufeff%YAML:1.0\r\n---\r\nvalues: [1e-5, 2, '3.5']\r\n".encode())
    assert read_document(path).numbers("values") == (1e-5, 2.0, 3.5)


def test_imu_files(tmp_path: Path) -> None:
    noise = ImuNoise(1.7e-4, 2e-05, 2e-3, 1 / 3, 200.0)
    write_imu_file(tmp_path / "imu.yaml", noise, "/imu0")
    assert read_imu_file(tmp_path / "imu.yaml").noise == noise
    assert read_imu_file(tmp_path / "imu.yaml").topic == "/imu0"
    nested = {"imu0": {**NOISE, "update_rate": 100, "rostopic": "/imu/data"}}
    (tmp_path / "nested.yaml").write_text(yaml.safe_dump(nested))
    assert read_imu_file(tmp_path / "nested.yaml").noise.rate_hz == 100
    write_imu_description(tmp_path / "sensor.yaml", noise, 200.0)
    assert read_imu(tmp_path / "sensor.yaml").noise == noise
    write_imu_description(tmp_path / "sensor.yaml", None, 200.0)
    assert read_imu(tmp_path / "sensor.yaml").noise is None
    (tmp_path / "imu.yaml").write_text("update_rate: 200\n")
    with pytest.raises(CalibrationError, match="gyroscope_noise_density: is missing"):
        read_imu_file(tmp_path / "imu.yaml")
