"""Recordings and logs by others, as found: read, or refused with the true reason."""

from pathlib import Path

import numpy as np
import pytest

from barsight.calibration.files.kalibr import read_camchain
from barsight.calibration.files.kalibr_lens import MAX_OFF_PX, fit_four
from barsight.calibration.files.rig_file import write_rig_file
from barsight.calibration.geometry.camera import Camera, Distortion
from barsight.calibration.geometry.rig import StereoRig
from barsight.cli.main import run
from barsight.core.errors import InputError
from barsight.core.pose import Pose
from barsight.core.records.pairs import RectifiedCamera
from barsight.recording.formats.bag_setup import side_by_side
from barsight.recording.formats.image_pairs import find_pairs
from barsight.recording.formats.imu_log import read_imu_log
from barsight.recording.open import bag_at
from barsight.stereo.disparity_files import write_calib

AT_REST = "1e-3,2e-3,-1e-3,0.1,0.2,9.8"


@pytest.mark.parametrize(
    ("left", "right"),
    [("imageL0", "imageR0"), ("left12", "right12"), ("shot_l_3", "shot_r_3"), ("x_cam0_7", "x_cam1_7")],
)
def test_names_of_a_pair(tmp_path: Path, left: str, right: str) -> None:
    for name in (left, right):
        (tmp_path / f"{name}.png").write_bytes(b"x")
    (pair,) = find_pairs(tmp_path)
    assert (pair.left.stem, pair.right.stem) == (left, right)


def test_only_a_left_and_a_right_topic_are_a_pair() -> None:
    assert side_by_side("/cam0/image_raw", "/cam1/image_raw")
    assert side_by_side("/left/image", "/right/image")
    assert side_by_side("/camera/infra1/image", "/camera/infra2/image")
    assert not side_by_side("/camera/color/image", "/camera/depth/image")


def test_every_foreign_bag_says_what_is_in_it(data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bags = [path for path in sorted((data / "foreign_bags").iterdir()) if path.suffix != ".md"]
    assert len(bags) == 8
    for path in bags:
        bag = bag_at(path)
        assert bag is not None and bag.topics
        assert run(["info", str(path)]) == 0
        said = capsys.readouterr().out
        assert "messages" in said and "--camchain" in said and "recording.camchain" not in said


def test_foreign_imu_logs(data: Path) -> None:
    folder = data / "foreign_imu_logs"
    log = read_imu_log(folder / "boot_ns_stamps.csv").samples
    assert log.stamp_ns[0] == 251_350_000_000
    assert np.median(np.diff(log.stamp_ns)) == 10_000_000
    log = read_imu_log(folder / "xio_fusion_sensor_data.csv").samples
    assert np.median(np.diff(log.stamp_ns)) == pytest.approx(1e7, rel=0.02)
    assert np.linalg.norm(log.accel_mps2[0]) == pytest.approx(9.78, abs=0.1)
    assert np.degrees(log.gyro_radps[0, 1]) == pytest.approx(-0.1517251)
    bag = read_imu_log(data / "foreign_bags" / "ardrone_imu.bag").samples
    assert np.median(np.linalg.norm(bag.accel_mps2, axis=1)) == pytest.approx(9.8, abs=1)


@pytest.mark.parametrize("unit_ns", [1, 1_000, 1_000_000])
@pytest.mark.parametrize("since_s", [3, 1_700_000_000])
def test_stamps_of_any_unit_and_epoch(tmp_path: Path, unit_ns: int, since_s: int) -> None:
    stamps = [since_s * 10**9 + k * 5_000_000 for k in range(20)]
    (tmp_path / "log.csv").write_text("".join(f"{s // unit_ns},{AT_REST}\n" for s in stamps))
    assert read_imu_log(tmp_path / "log.csv").samples.stamp_ns.tolist() == stamps


def test_columns_without_names_are_not_guessed(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text("".join(f"{k * 0.01},{AT_REST},1,2,3\n" for k in range(9)))
    with pytest.raises(InputError, match="10 columns whose names"):
        read_imu_log(tmp_path / "log.csv")


def test_kalibr_gets_four_coefficients_or_a_reason() -> None:
    mild = (-0.1, 0.02, 1e-3, -1e-3, -0.002)
    fitted, off_px = fit_four(Camera(640, 480, 660, 660, 320, 240, Distortion.RADTAN, mild))
    assert len(fitted.coefficients) == 4 and off_px < MAX_OFF_PX
    strong = (-0.1, 0.02, 0, 0, -0.1, 0.2, 0.05, -0.08)
    assert fit_four(Camera(640, 480, 300, 300, 320, 240, Distortion.RADTAN, strong))[1] > MAX_OFF_PX


@pytest.mark.parametrize(
    "lens", [(-0.1, 0.02, 1e-3, -1e-3, -0.002), (-0.1, 0.02, 0, 0, -0.1, 0.2, 0.05, -0.08)]
)
def test_kalibr_is_written_through_the_command_or_refused(
    tmp_path: Path, lens: tuple[float, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    wide = len(lens) == 8
    focal = 300.0 if wide else 660.0
    camera = Camera(640, 480, focal, focal, 320, 240, Distortion.RADTAN, lens)
    aside = Pose("cam0", "cam1", np.eye(3), np.array([0.2, 0, 0]))
    body = Pose("body", "cam0", np.eye(3), np.zeros(3))
    write_rig_file(tmp_path / "rig.yaml", StereoRig(camera, camera, body, body @ aside))
    out = tmp_path / "camchain.yaml"
    words = ["calibrate", "export", str(tmp_path / "rig.yaml"), "-o", str(out), "--to", "kalibr"]
    assert (run(words) == 0) is not wide
    told = " ".join(capsys.readouterr().err.split())
    assert out.exists() is not wide
    if wide:
        assert "calibrate with --lens radtan4" in told
    else:
        assert len(read_camchain(out).rig.cam0.coefficients) == 4 and "four coefficients, up to" in told


def test_disparities_can_be_made_into_depth(tmp_path: Path) -> None:
    camera = RectifiedCamera(994.978, 311.193, 254.877, 0.193001, 31.086, 741, 497)
    write_calib(tmp_path / "calib.txt", camera)
    said = dict(line.split("=") for line in (tmp_path / "calib.txt").read_text().splitlines())
    assert said["cam0"] == "[994.978 0 311.193; 0 994.978 254.877; 0 0 1]"
    assert float(said["doffs"]) == 31.086
    assert float(said["baseline"]) == pytest.approx(193.001)
