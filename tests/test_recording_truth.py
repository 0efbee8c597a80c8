"""True trajectories of the three kinds."""

from pathlib import Path

import numpy as np
import pytest

from barsight.core.errors import InputError
from barsight.recording.formats.ground_truth import find_ground_truth, read_ground_truth, truth_as_euroc
from recording_samples import real

EUROC = "#timestamp,p,q\n7,1,2,3,1,0,0,0,0.1,0.2\n9,4,5,6,0,1,0,0,0.1,0.2\n"
TUM = "# time x y z\n1403715273.262142977 1 2 3 0 0 0 1\n1403715273.362142977 4 5 6 1 0 0 0\n"
KITTI = "1 0 0 5 0 1 0 6 0 0 1 7\n1 0 0 8 0 0 -1 9 0 1 0 1\n"


def test_euroc(tmp_path: Path) -> None:
    folder = tmp_path / "mav0" / "state_groundtruth_estimate0"
    folder.mkdir(parents=True)
    (folder / "data.csv").write_text(EUROC)
    for path in (tmp_path, tmp_path / "mav0", folder / "data.csv"):
        truth = read_ground_truth(path, reference="yard")
        assert truth.stamp_ns.tolist() == [7, 9]
        assert (truth.poses[0].target, truth.poses[0].source) == ("yard", "body")
        np.testing.assert_array_equal(truth.poses[1].translation, [4, 5, 6])
        np.testing.assert_allclose(truth.poses[1].rotation, np.diag([1, -1, -1]), atol=1e-15)


def test_tum(tmp_path: Path) -> None:
    path = tmp_path / "truth.txt"
    path.write_text(TUM)
    truth = read_ground_truth(path)
    assert truth.stamp_ns.tolist() == [1403715273262142977, 1403715273362142977]
    np.testing.assert_allclose(truth.poses[1].rotation, np.diag([1, -1, -1]), atol=1e-15)


def test_kitti(tmp_path: Path) -> None:
    (tmp_path / "poses.txt").write_text(KITTI)
    stamps = np.array([0, 100], dtype=np.int64)
    truth = read_ground_truth(tmp_path, stamps)
    np.testing.assert_array_equal(truth.poses[1].translation, [8, 9, 1])
    with pytest.raises(InputError, match="2 poses for no frames' times"):
        read_ground_truth(tmp_path)
    (tmp_path / "data.csv").write_text(truth_as_euroc(tmp_path / "poses.txt", stamps))
    again = read_ground_truth(tmp_path / "data.csv")
    np.testing.assert_allclose(again.poses[1].matrix, truth.poses[1].matrix, atol=1e-15)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.csv", EUROC.replace("4,5", "4,nan"), "line 3: a value is NaN"),
        ("a.csv", EUROC.replace("9,4", "6,4"), "line 3: .*goes back"),
        ("a.csv", EUROC.replace("6,0,1", "6,0,2"), "the quaternion's length is 2.000"),
        ("a.txt", "1 2 3\n", "line 1: 3 columns; TUM has 8"),
        ("a.txt", TUM + "3 4\n", "line 4: expected 8 numbers"),
        ("a.txt", TUM.replace("4 5", "4 x"), "line 3: expected 8 numbers"),
        ("a.txt", "# nothing\n", "has no rows"),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, name: str, text: str, message: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=message):
        read_ground_truth(tmp_path / name)


def test_none_there(tmp_path: Path) -> None:
    assert find_ground_truth(tmp_path) is None
    with pytest.raises(InputError, match="holds no true trajectory"):
        read_ground_truth(tmp_path)


def test_real_truths() -> None:
    yard = read_ground_truth(real("yard_dev"), reference="yard")
    assert len(yard.poses) == 404
    kitti = read_ground_truth(real("kitti_odometry_a"), np.arange(41, dtype=np.int64))
    assert abs(kitti.poses[1].translation[2] - 1.199) < 1e-3
    assert len(read_ground_truth(real("euroc_imu_truth") / "V2_01_easy.txt").poses) > 1000
