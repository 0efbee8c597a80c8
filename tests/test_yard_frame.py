"""The yard file in use: poses, encoders and sigma moved as truth asks, a foreign or unsure file refused."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from barsight.calibration.files.yaml_document import read_document, write_document
from barsight.cli.main import run
from barsight.core.errors import CalibrationError, InputError
from barsight.core.pose import Pose
from barsight.core.records.sensor_samples import CraneSamples
from barsight.core.records.trajectory import PosedFrame, Trajectory
from barsight.mapping.surface.laser_profiles import runs_along_x
from barsight.recording.open import open_recording
from barsight.recording.sensor_selection import SelectedSensors
from barsight.registration.yard_file import YardFrame, read_yard_file
from barsight.yard_frame import (
    RecordingInYard,
    calibration_id,
    crane_in_yard,
    in_yard,
    mounting_id,
    placed_in_yard,
    shared_height_sigma_m,
    with_shared,
)
from recording_samples import write_euroc

TURN = Rotation.from_rotvec([0.002, -0.001, 0.4]).as_matrix()
SHIFT = np.array([100.0, 20.0, 0.05])
HEADER = "name,yard_x,yard_y,yard_z,x,y,z,sigma_m,check\n"


def targets_file(path: Path, seed: int, scale: float = 1.0) -> np.ndarray:
    """Six targets with 2 mm of noise; the map's places (200, 3) anywhere among them are given back."""
    rng = np.random.default_rng(seed)
    measured = rng.uniform((0, -3, 0), (20, 3, 2), (6, 3))
    yard = scale * (measured @ TURN.T + SHIFT + rng.normal(0, 0.002, (6, 3)))
    rows = (",".join(map(str, (f"t{k}", *yard[k], *measured[k], 0.002, 0))) for k in range(6))
    path.write_text(HEADER + "\n".join(rows) + "\n")
    return rng.uniform((0, -3, 0), (20, 3, 2), (200, 3))


def calibrated(folder: Path, seed: int, frame: str) -> tuple[YardFrame, np.ndarray]:
    places = targets_file(folder / "targets.csv", seed)
    out = folder / f"yard_{seed}.yaml"
    arguments = ["calibrate", "yard", str(folder / "targets.csv"), "-o", str(out), "--frame", frame]
    assert run(arguments) == 0
    return read_yard_file(out), places


def test_six_targets_place_check_points_within_5_mm_and_inside_sigma(tmp_path: Path) -> None:
    away, inside = [], []
    for seed in range(12):
        frame, places = calibrated(tmp_path, seed, "encoders")
        moved = frame.yard_from.apply(places)
        off = moved - (places @ TURN.T + SHIFT)
        away.append(np.linalg.norm(off, axis=1))
        sigma = shared_height_sigma_m(frame, moved[:, 0], moved[:, 1], np.zeros(3))
        inside.append(np.abs(off[:, 2]) < 2 * sigma)
    assert np.percentile(away, 95) < 0.005
    assert np.mean(inside) > 0.9


def test_encoders_and_poses_move_alike_and_share_the_frames_sigma(tmp_path: Path) -> None:
    frame, _ = calibrated(tmp_path, 3, "encoders")
    lever, hangs = np.array([0.3, 0.1, -0.5]), Rotation.from_rotvec([3.1, 0.0, 0.02]).as_matrix()
    crane = CraneSamples(np.arange(3), np.arange(9.0).reshape(3, 3), lever, hangs, 0.001)
    moved = crane_in_yard(crane, frame)
    assert moved.position_m + moved.crane_to_body_m == pytest.approx(
        frame.yard_from.apply(crane.position_m + lever)
    )
    assert moved.yard_from_body_nominal == pytest.approx(frame.yard_from.rotation @ hangs)
    own = np.diag([1e-8] * 3 + [1e-6] * 3)
    at = PosedFrame(1, Pose("yard", "body", hangs, frame.yard_from.apply(np.array([10.0, 0, 8]))), own)
    shared = with_shared(Trajectory("yard", (at,), (), ()), frame).frames[0].covariance - own
    rng = np.random.default_rng(0)
    errors = rng.multivariate_normal(np.zeros(6), frame.covariance, 20_000)
    away = at.reference_from_body.translation - frame.yard_from.translation
    scattered = np.cov((np.cross(errors[:, :3], away) + errors[:, 3:]).T)
    assert np.sqrt(np.diag(shared)[3:]) == pytest.approx(np.sqrt(np.diag(scattered)), rel=0.05)


def test_a_world_becomes_the_yard(tmp_path: Path) -> None:
    frame, _ = calibrated(tmp_path, 4, "world")
    pose = Pose("world", "body", np.eye(3), np.array([1.0, 2.0, 3.0]))
    way = Trajectory("world", (PosedFrame(1, pose, np.eye(6)),), (), ("stereo",))
    placed = placed_in_yard(way, frame)
    assert placed.reference == "yard"
    assert placed.positions_m[0] == pytest.approx(frame.yard_from.apply(pose.translation))
    assert placed_in_yard(way, None) is way


def test_units_that_differ_are_no_calibration(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for scale, code, said in ((1000.0, 3, "give metres"), (3.28, 5, "times as large as the measured ones")):
        targets_file(tmp_path / "units.csv", 1, scale=scale)
        words = ["calibrate", "yard", str(tmp_path / "units.csv"), "-o", str(tmp_path / "yard.yaml")]
        assert run(words) == code
        assert said in capsys.readouterr().err
    assert not (tmp_path / "yard.yaml").exists()


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("barsight_yard", 7, "is not a yard file"),
        ("covariance", [[1.0]], "covariance: is not a 6x6 matrix"),
        ("yard_from_encoders", [[2.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], "rotation"),
        ("calibration_id", 5, "is not text"),
    ],
)
def test_a_spoilt_file_is_refused(tmp_path: Path, key: str, value: object, said: str) -> None:
    calibrated(tmp_path, 0, "encoders")
    path = tmp_path / "yard_0.yaml"
    write_document(path, {**read_document(path).values, key: value})
    with pytest.raises(CalibrationError, match=said):
        read_yard_file(path)


def test_another_rigs_or_cranes_file_is_refused(tmp_path: Path) -> None:
    recording = open_recording(write_euroc(tmp_path / "recording", 4))
    crane = recording.crane()
    assert crane is not None
    calibrated(tmp_path, 0, "encoders")
    path = tmp_path / "yard_0.yaml"
    values = read_document(path).values
    own = {"calibration_id": calibration_id(recording.rig), "mounting_id": mounting_id(crane)}
    write_document(path, {**values, **own})
    assert in_yard(recording, path).crane() is not None
    with pytest.raises(InputError, match="no encoders"):
        in_yard(SelectedSensors(recording, ("stereo", "imu")), path)
    for key, said in (("calibration_id", "another rig"), ("mounting_id", "another crane")):
        write_document(path, {**values, **own, key: "0123456789abcdef"})
        with pytest.raises(InputError, match=said):
            in_yard(recording, path)
    unsure = replace(read_yard_file(path), covariance=np.eye(6))
    write_document(path, {**values, **own, "covariance": unsure.covariance.tolist()})
    with pytest.raises(InputError, match="too unsure"):
        in_yard(recording, path)


def test_the_laser_moves_with_the_encoders_and_an_askew_profile_is_left_out(
    tmp_path: Path, data: Path
) -> None:
    whole = open_recording(data / "yard_dev")
    frame, _ = calibrated(tmp_path, 3, "encoders")
    moved = RecordingInYard(whole, frame).laser()
    for one, other in zip(whole.laser(), moved, strict=True):
        there = frame.yard_from.apply(np.column_stack([one.x_m, one.y_m, one.z_m]))
        assert np.column_stack([other.x_m, other.y_m, other.z_m]) == pytest.approx(there)
        assert (other.profile, other.range_std_m) == (one.profile, one.range_std_m)
        assert runs_along_x(one) and not runs_along_x(other), "23 degrees askew"
    turned = RecordingInYard(whole, replace(frame, yard_from=Pose("yard", "encoders", np.eye(3), SHIFT)))
    assert all(runs_along_x(one) for one in turned.laser())
