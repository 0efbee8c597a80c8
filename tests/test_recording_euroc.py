"""The EuRoC reader: what it reads, and one line for each thing that can be wrong."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from barsight.core.errors import CalibrationError, InputError
from barsight.core.records.pairs import RefusedFrame, StereoFrame
from barsight.recording.base import RecordingSettings
from barsight.recording.open import open_recording
from recording_samples import (
    START_NS,
    STEP_NS,
    assert_same,
    camera_yaml,
    mounts,
    picture,
    png,
    real,
    stamps,
    write_euroc,
    write_imu,
)


def test_everything_is_read(tmp_path: Path) -> None:
    recording = open_recording(write_euroc(tmp_path))
    assert recording.format == "euroc"
    assert recording.index.stamps_ns == tuple(stamps(3))
    frames = list(recording.frames())
    for k, frame in enumerate(frames):
        assert isinstance(frame, StereoFrame)
        assert frame.stamp_ns == stamps(3)[k]
        np.testing.assert_array_equal(frame.left, picture(10 * k))
        np.testing.assert_array_equal(frame.right, picture(10 * k + 1))
    assert [frame.stamp_ns for frame in recording.frames({stamps(3)[1]})] == [stamps(3)[1]]
    assert recording.rig.timeshift_cam_imu_ns == -3_500_000
    np.testing.assert_allclose(recording.rig.body_from_cam1.matrix, mounts()[1], atol=1e-12)
    imu, crane, laser = recording.imu(), recording.crane(), recording.laser()
    assert imu is not None
    assert imu.stamp_ns[1] == START_NS + 5_000_000
    assert imu.accel_mps2.shape == (40, 3)
    assert crane is not None
    assert crane.position_m[1].tolist() == [0.1, 1 / 3, 8.5]
    assert [profile.profile for profile in laser] == [0, 3]
    assert laser[1].y_m.tolist() == [2.0999999999999996] * 5
    assert laser[0].range_std_m == 0.001
    noise = recording.imu_noise()
    assert noise is not None
    assert noise.gyro_walk == 2e-5
    assert set(recording.digests()) >= {"cam0/data.csv", "imu0/sensor.yaml", "laser0/data.csv"}
    assert all(len(digest) == 64 for digest in recording.digests().values())


def test_the_folder_or_mav0_itself(tmp_path: Path) -> None:
    write_euroc(tmp_path)
    assert_same(open_recording(tmp_path), open_recording(tmp_path / "mav0"))


def test_sensors_that_are_not_there(tmp_path: Path) -> None:
    recording = open_recording(write_euroc(tmp_path, imu=False, crane=False))
    assert recording.imu() is None
    assert recording.imu_noise() is None
    assert recording.crane() is None
    assert recording.laser() == ()
    assert not recording.is_simulated


def test_is_simulated_is_said_by_the_recording(tmp_path: Path) -> None:
    write_euroc(tmp_path)
    (tmp_path / "mav0" / "body.yaml").write_text("%YAML:1.0\nis_simulated: true\n")
    assert open_recording(tmp_path).is_simulated


def test_an_imu_that_is_mounted_askew_is_turned_into_body(tmp_path: Path) -> None:
    write_euroc(tmp_path)
    straight = open_recording(tmp_path).imu()
    askew = np.eye(4)
    askew[:3, :3] = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    askew[0, 3] = 0.1
    write_imu(tmp_path / "mav0", askew)
    recording = open_recording(tmp_path)
    turned = recording.imu()
    assert straight is not None
    assert turned is not None
    np.testing.assert_allclose(turned.gyro_radps[:, 0], -straight.gyro_radps[:, 1], atol=1e-15)
    np.testing.assert_allclose(turned.accel_mps2[:, 1], straight.accel_mps2[:, 0], atol=1e-15)
    assert "lever arm" in recording.notes[0]


def test_frames_on_one_side_only_are_told_apart(tmp_path: Path) -> None:
    write_euroc(tmp_path, 4)
    for camera, gone in ((0, 1), (1, 2)):
        path = tmp_path / "mav0" / f"cam{camera}" / "data.csv"
        lines = path.read_text().splitlines()
        del lines[1 + gone]
        path.write_text("\n".join(lines) + "\n")
    index = open_recording(tmp_path).index
    assert index.stamps_ns == (stamps(4)[0], stamps(4)[3])
    assert [frame.stamp_ns for frame in index.unpaired] == [stamps(4)[1], stamps(4)[2]]
    assert "cam1 only" in index.unpaired[0].reason
    assert "cam0 only" in index.unpaired[1].reason


def shift_right(root: Path, by_ns: int) -> None:
    path = root / "mav0" / "cam1" / "data.csv"
    rows = [f"{stamp + by_ns},{stamp}.png" for stamp in stamps(3)]
    path.write_text("\n".join(rows) + "\n")


def test_pairs_within_the_tolerance(tmp_path: Path) -> None:
    write_euroc(tmp_path)
    shift_right(tmp_path, 1_900_000)
    assert open_recording(tmp_path).index.stamps_ns == tuple(stamps(3))
    shift_right(tmp_path, 3_000_000)
    with pytest.raises(InputError, match="the nearest is 3 ms away"):
        open_recording(tmp_path)
    wide = RecordingSettings(pair_tolerance_s=0.005)
    assert len(open_recording(tmp_path, wide).index.stamps_ns) == 3
    assert STEP_NS > 5_000_000


@pytest.mark.parametrize(("left", "kept"), [(0, 2), (0.5, 2), (-12, 2), (-1, 2)])
def test_a_picture_cut_short_is_refused_and_the_rest_goes_on(tmp_path: Path, left: float, kept: int) -> None:
    write_euroc(tmp_path)
    path = tmp_path / "mav0" / "cam1" / "data" / f"{stamps(3)[1]}.png"
    data = path.read_bytes()
    path.write_bytes(data[: int(left * len(data)) if left >= 0 and left < 1 else int(left)])
    frames = list(open_recording(tmp_path).frames())
    refused = frames[1]
    assert isinstance(refused, RefusedFrame)
    assert f"cam1/data/{stamps(3)[1]}.png" in refused.reason
    assert sum(isinstance(frame, StereoFrame) for frame in frames) == kept


def test_missing_and_misfit_pictures_are_refused(tmp_path: Path) -> None:
    write_euroc(tmp_path)
    (tmp_path / "mav0" / "cam0" / "data" / f"{stamps(3)[0]}.png").unlink()
    (tmp_path / "mav0" / "cam0" / "data" / f"{stamps(3)[2]}.png").write_bytes(png(picture(0)[:40]))
    first, _, last = open_recording(tmp_path).frames()
    assert isinstance(first, RefusedFrame)
    assert "is missing" in first.reason
    assert isinstance(last, RefusedFrame)
    assert "is 64x40, the calibration is for 64x48" in last.reason


def break_sensor(camera: int, **changes: object) -> Callable[[Path], None]:
    def breaks(mav0: Path) -> None:
        text = yaml.safe_dump(camera_yaml(mounts()[camera], **changes))
        (mav0 / f"cam{camera}" / "sensor.yaml").write_text(text)

    return breaks


def write(name: str, text: str) -> Callable[[Path], None]:
    return lambda mav0: (mav0 / name).write_text(text) and None


def remove(name: str) -> Callable[[Path], None]:
    def breaks(mav0: Path) -> None:
        path = mav0 / name
        for file in [path] if path.is_file() else sorted(path.iterdir()):
            file.unlink()

    return breaks


def rename(name: str, other: str) -> Callable[[Path], None]:
    return lambda mav0: (mav0 / name).rename(mav0 / other) and None


def swap_calibrations(mav0: Path) -> None:
    for camera in (0, 1):
        text = yaml.safe_dump(camera_yaml(mounts()[1 - camera]))
        (mav0 / f"cam{camera}" / "sensor.yaml").write_text(text)


def edit_imu(line: int, old: str, new: str) -> Callable[[Path], None]:
    def breaks(mav0: Path) -> None:
        path = mav0 / "imu0" / "data.csv"
        lines = path.read_text().splitlines()
        fields = lines[line - 1].split(",")
        fields[int(old)] = new
        lines[line - 1] = ",".join(fields)
        path.write_text("\n".join(lines) + "\n")

    return breaks


def imu_in_g(mav0: Path) -> None:
    path = mav0 / "imu0" / "data.csv"
    rows = [f"{START_NS + k},0,0,0,0.01,0.02,0.99" for k in range(10)]
    path.write_text("\n".join(rows) + "\n")


SCALED = {"data": [2.0, 0, 0, 0, 0, 2, 0, 0, 0, 0, 2, 0, 0, 0, 0, 1]}
MIRRORED = {"data": [1.0, 0, 0, 0, 0, 1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1]}
BAD = {
    "no cam1": (rename("cam1", "cam2"), InputError, "has no folder cam1"),
    "no sensor.yaml": (remove("cam1/sensor.yaml"), CalibrationError, "cam1/sensor.yaml: no such file"),
    "garbled sensor.yaml": (write("cam0/sensor.yaml", "a: [1, 2\nb"), CalibrationError, "not YAML"),
    "empty sensor.yaml": (write("cam0/sensor.yaml", "%YAML:1.0\n"), CalibrationError, "is empty"),
    "binary sensor.yaml": (write("cam0/sensor.yaml", "\x01\x02"), CalibrationError, "cam0/sensor.yaml"),
    "no rotation": (
        break_sensor(1, T_BS=SCALED),
        CalibrationError,
        "cam1/sensor.yaml: T_BS: .*not a rotation",
    ),
    "reflection": (break_sensor(0, T_BS=MIRRORED), CalibrationError, "T_BS: .*reflection"),
    "short T_BS": (break_sensor(0, T_BS={"data": [1.0]}), CalibrationError, "T_BS: is not a 4x4 matrix"),
    "NaN in T_BS": (break_sensor(0, T_BS={"data": [float("nan")] * 16}), CalibrationError, "not finite"),
    "no intrinsics": (break_sensor(0, intrinsics=None), CalibrationError, "intrinsics: is missing"),
    "three intrinsics": (break_sensor(0, intrinsics=[1.0, 2, 3]), CalibrationError, "has 3 numbers"),
    "text in intrinsics": (break_sensor(0, intrinsics=["x", 2, 3, 4]), CalibrationError, "not a number"),
    "negative focal": (break_sensor(0, intrinsics=[-60.0, 60, 31, 23]), CalibrationError, "must be positive"),
    "omni camera": (break_sensor(0, camera_model="omni"), CalibrationError, "camera_model: 'omni'"),
    "unknown lens": (break_sensor(0, distortion_model="fov"), CalibrationError, "distortion_model: 'fov'"),
    "three coefficients": (
        break_sensor(0, distortion_coefficients=[0.1, 0.2, 0.3]),
        CalibrationError,
        "distortion_coefficients: .*4 or 5 or 8",
    ),
    "swapped calibrations": (swap_calibrations, CalibrationError, "left and right are swapped"),
    "the same calibration twice": (
        lambda mav0: break_sensor(0, T_BS={"data": mounts()[1].ravel().tolist()})(mav0),
        CalibrationError,
        "the baseline is zero",
    ),
    "empty camera list": (write("cam0/data.csv", "#timestamp [ns],filename\n"), InputError, "has no rows"),
    "no camera list": (remove("cam1/data.csv"), InputError, "cam1/data.csv: no such file"),
    "no pictures": (remove("cam1/data"), InputError, "not one of the 3 pictures"),
    "doubled stamps": (write("cam0/data.csv", "7,a.png\n7,b.png\n"), InputError, "line 2: .*same as the one"),
    "stamps go back": (write("cam0/data.csv", "7,a.png\n5,b.png\n"), InputError, "line 2: .*goes back"),
    "no imu list": (remove("imu0/data.csv"), InputError, "imu0/data.csv: no such file"),
    "empty imu": (write("imu0/data.csv", "#timestamp\n"), InputError, "imu0/data.csv: has no rows"),
    "NaN in the imu": (edit_imu(7, "3", "nan"), InputError, "line 7: a value is NaN"),
    "text in the imu": (edit_imu(7, "3", "oops"), InputError, "line 7: w_z 'oops' is not a number"),
    "imu goes back": (edit_imu(7, "0", "5"), InputError, "line 7: stamp 5 goes back"),
    "imu in g": (imu_in_g, InputError, "probably in g"),
    "NaN in the crane": (write("crane0/data.csv", "1,0,nan,0\n"), InputError, "crane0/data.csv: line 1"),
    "crane of three columns": (write("crane0/data.csv", "1,0,0\n"), InputError, "line 1: 3 columns"),
    "no crane mounting": (remove("crane0/sensor.yaml"), CalibrationError, "crane0/sensor.yaml: no such"),
    "crane askew": (
        write("crane0/sensor.yaml", "R_yard_body: [2, 0, 0, 0, 1, 0, 0, 0, 1]\n"),
        CalibrationError,
        "R_yard_body: .*not a rotation",
    ),
    "crane without sigma": (
        write("crane0/sensor.yaml", "R_yard_body: [1, 0, 0, 0, 1, 0, 0, 0, 1]\nposition_std_m: 0\n"),
        CalibrationError,
        "position_std_m: .*must be positive",
    ),
    "NaN in the laser": (write("laser0/data.csv", "0,1,2,nan\n"), InputError, "laser0/data.csv: line 1"),
    "empty laser": (write("laser0/data.csv", ""), InputError, "laser0/data.csv: has no rows"),
}


@pytest.mark.parametrize("name", BAD)
def test_what_is_wrong_is_said_in_one_line(tmp_path: Path, name: str) -> None:
    breaks, kind, message = BAD[name]
    write_euroc(tmp_path)
    breaks(tmp_path / "mav0")
    with pytest.raises(kind, match=message) as caught:
        recording = open_recording(tmp_path)
        recording.imu(), recording.crane(), recording.laser()
    assert type(caught.value) is kind
    assert str(tmp_path) in str(caught.value)
    assert "\n" not in str(caught.value)
    assert caught.value.remedy


def test_no_such_folder_and_no_recording(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file or folder"):
        open_recording(tmp_path / "nowhere")
    with pytest.raises(InputError, match="not a recording that Barsight recognises"):
        open_recording(tmp_path)
    (tmp_path / "a.txt").write_text("x")
    with pytest.raises(InputError, match="of an unknown file type"):
        open_recording(tmp_path / "a.txt")
    write_euroc(tmp_path / "inside")
    with pytest.raises(InputError, match=r"give the folder inside, .*inside"):
        open_recording(tmp_path)


def test_a_recording_that_may_not_be_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_euroc(tmp_path)

    def refuse(path: Path) -> None:
        raise PermissionError(13, "Permission denied", str(path / "cam0" / "sensor.yaml"))

    monkeypatch.setattr("barsight.recording.formats.euroc.read_rig", refuse)
    with pytest.raises(InputError, match=r"cam0/sensor\.yaml: no permission to read it"):
        open_recording(tmp_path)


def test_real_euroc() -> None:
    recording = open_recording(real("euroc_v101_still"))
    assert abs(recording.rig.baseline_m - 0.11007) < 1e-4
    frames = list(recording.frames())
    assert [type(frame) for frame in frames] == [StereoFrame] * 10
    imu = recording.imu()
    assert imu is not None
    assert imu.stamp_ns[0] == 1403715273262142976
    assert imu.accel_mps2[0, 0] == 9.0874956666666655


def test_real_yard() -> None:
    recording = open_recording(real("yard_dev"))
    assert len(recording.index.stamps_ns) == 19
    crane = recording.crane()
    assert crane is not None
    assert crane.position_m[0].tolist() == [-0.949, 0.353, 8.547]
    assert [profile.x_m.size for profile in recording.laser()] == [760, 760]
