"""Recorded corners as tracks: EuRoC's board against the poses that a PnP of the board gives."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from barsight.calibration.boards.detection_files import NAMES
from barsight.calibration.geometry.rectification import Rectifier
from barsight.cli.main import run
from barsight.core.errors import InputError
from barsight.core.pose import Pose
from barsight.core.records.pairs import RefusedFrame
from barsight.evaluation.board_poses import board_poses, gyro_only_rmse_deg
from barsight.evaluation.trajectory_error import Drift, trajectory_drift
from barsight.motion.batch.fusion import BatchFusion, FusionSettings
from barsight.motion.crane.encoder_trajectory import CraneSettings
from barsight.recording.base import RecordingSettings
from barsight.recording.formats import board_corners as corners
from barsight.recording.formats.board_corners import CornerRecording
from barsight.recording.formats.ground_truth import GroundTruth
from barsight.recording.open import open_recording
from camera_imu_recordings import START_NS, Way, simulated


def cut(source: Path, target: Path, seconds: float) -> Path:
    """The first seconds of a recording of corners."""
    target.mkdir()
    for name in NAMES:
        rows = np.load(source / name)["detections"]
        np.savez(target / name, detections=rows[rows["stamp_ns"] < rows["stamp_ns"][0] + seconds * 1e9])
    shutil.copy(source / "imu0.csv", target / "imu0.csv")
    return target


def flags(data: Path) -> list[str]:
    rig = data / "euroc_v101_still"
    return ["--reading.rig", str(rig), "--reading.imu-yaml", str(rig / "mav0" / "imu0" / "sensor.yaml")]


def opened(path: Path, data: Path) -> CornerRecording:
    rig = data / "euroc_v101_still"
    noise = rig / "mav0" / "imu0" / "sensor.yaml"
    recording = open_recording(path, RecordingSettings(rig=rig, imu_yaml=noise))
    assert isinstance(recording, CornerRecording)
    return recording


def drift(recording: CornerRecording, truth: GroundTruth, use: str) -> Drift:
    estimator = BatchFusion(FusionSettings(use=use), CraneSettings())
    trajectory = estimator(recording, Rectifier(recording.rig), lambda: None)
    assert len(trajectory.refused) <= 1
    found = trajectory_drift(trajectory, truth, 0)
    assert found is not None
    return found


def test_the_reader(data: Path, tmp_path: Path) -> None:
    path = cut(data / "euroc_april_imu", tmp_path / "a [b] c", 1.0)
    recording = opened(path, data)
    points = list(recording.points())
    assert [p.stamp_ns for p in points] == list(recording.index.stamps_ns)
    assert len(points) == 20
    assert all(isinstance(frame, RefusedFrame) for frame in recording.frames())
    rectifier = Rectifier(recording.rig)
    left, right = rectifier.places(points[0].left, points[0].right)
    assert np.abs(left[:, 1] - right[:, 1]).max() < 1.5
    assert (left[:, 0] - right[:, 0] + rectifier.camera.doffs_px > 20).all()
    with pytest.raises(InputError, match="without a calibration"):
        open_recording(path)


def test_the_command(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = cut(data / "euroc_april_imu", tmp_path / "corners", 2.0)
    assert run(["odometry", str(path), "-o", str(tmp_path / "out"), *flags(data)]) == 0
    said = capsys.readouterr().out
    assert "40 frames placed in world" in said
    assert "against a PnP of the board by cam0: " in said
    assert "the gyro alone, one bias fitted to those poses, is " in said
    assert len((tmp_path / "out" / "trajectory.tum").read_text().splitlines()) == 42
    assert run(["odometry", str(path)]) == 3
    assert "name its rig file" in capsys.readouterr().err
    assert run(["info", str(path), "--rig", flags(data)[1]]) == 0
    assert "corners were recorded" in capsys.readouterr().out


def test_the_imu_helps(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Simulated corners with noise of 0.25 px and EuRoC's IMU, against truth."""
    views, imu, truth = simulated(1, seconds=6.0, shift_s=(0.0, 0.0))
    monkeypatch.setattr(corners, "read_rig_file", lambda path: truth.rig)
    for camera, name in enumerate(NAMES):
        rows = [
            (int(view.name), name_ // 4, name_ % 4, *pixel)
            for view in views if (seen := view.cameras[camera]) is not None
            for name_, pixel in zip(seen.ids.tolist(), seen.pixels.tolist(), strict=True)
        ]  # fmt: skip
        kinds = [("stamp_ns", "<i8"), ("tag", "<i4"), ("corner", "<i4"), ("u", "<f4"), ("v", "<f4")]
        np.savez(tmp_path / name, detections=np.array(rows, dtype=kinds))
    samples = zip(imu.stamp_ns.tolist(), imu.gyro_radps.tolist(), imu.accel_mps2.tolist(), strict=True)
    lines = [",".join([str(stamp), *map(repr, [*gyro, *accel])]) for stamp, gyro, accel in samples]
    (tmp_path / "imu0.csv").write_text("\n".join(lines) + "\n")
    recording = open_recording(tmp_path, RecordingSettings(rig=tmp_path))
    assert isinstance(recording, CornerRecording)
    way = Way(np.random.default_rng(1), truth.rig.body_from_cam0)
    time = (np.array(recording.index.stamps_ns) - START_NS) / 1e9
    poses = zip(way.rotation(time), way.place + way.waves(1, time, 0), strict=True)
    true = GroundTruth(
        np.array(recording.index.stamps_ns), tuple(Pose("world", "body", r, p) for r, p in poses)
    )
    both, pictures = drift(recording, true, "stereo,imu"), drift(recording, true, "stereo")
    assert both.aligned_rmse_mm < 0.6
    assert both.aligned_rmse_deg < 0.04
    assert both.aligned_rmse_mm < 0.6 * pictures.aligned_rmse_mm


def test_the_gyro_alone_follows_true_poses() -> None:
    """Simulated: what it is off by is its noise, and the bias is found; a wrong clock shows."""
    _, imu, rig_truth = simulated(2, seconds=4.0, shift_s=(0.0, 0.0))
    way = Way(np.random.default_rng(2), rig_truth.rig.body_from_cam0)
    stamps = START_NS + (np.arange(0.1, 3.9, 0.05) * 1e9).astype(np.int64)
    turns = way.rotation((stamps - START_NS) / 1e9)
    true = GroundTruth(stamps, tuple(Pose("world", "body", turn, np.zeros(3)) for turn in turns))
    assert gyro_only_rmse_deg(imu, true, 0) < 0.05
    assert gyro_only_rmse_deg(imu, true, 20_000_000) > 0.2
    assert np.isnan(gyro_only_rmse_deg(imu, true, 10**12))


def test_euroc_s_board(data: Path, tmp_path: Path) -> None:
    """PnP takes the board for flat, which it isn't, and the lenses as published. The gyro
    without any estimate is further from it than 0.3 degrees, too, even with a bias fitted to it.
    """
    recording = opened(cut(data / "euroc_april_imu", tmp_path / "part", 10.0), data)
    truth, imu = board_poses(recording), recording.imu()
    assert truth is not None and imu is not None
    both, pictures = drift(recording, truth, "stereo,imu"), drift(recording, truth, "stereo")
    assert both.aligned_rmse_mm < 10
    assert gyro_only_rmse_deg(imu, truth, 0) > 0.3
    assert both.aligned_rmse_deg < 0.45
    assert pictures.aligned_rmse_mm < 8
    assert pictures.aligned_rmse_deg < 0.3
