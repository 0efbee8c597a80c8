"""A round trip through any format is the same recording; an output is whole or not there."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from barsight.core.errors import OutputError
from barsight.recording import stored_images
from barsight.recording.formats.euroc import EurocRecording
from barsight.recording.formats.ground_truth import read_ground_truth
from barsight.recording.open import open_recording
from barsight.recording.writers.convert import Target, convert
from recording_samples import assert_same, camera_yaml, mounts, png, real, stamps, write_euroc, write_imu

TARGETS: tuple[Target, ...] = ("euroc", "ros2-mcap", "ros2-sqlite3", "ros1")
TRUTH = "#timestamp,p,q\n" + "".join(f"{s},1,2,3,1,0,0,0,0.5,0.25\n" for s in stamps(3))


def with_truth(root: Path) -> Path:
    folder = root / "mav0" / "state_groundtruth_estimate0"
    folder.mkdir()
    (folder / "data.csv").write_text(TRUTH)
    return root


@pytest.mark.parametrize("target", TARGETS)
def test_round_trip(tmp_path: Path, target: Target) -> None:
    source = open_recording(with_truth(write_euroc(tmp_path / "source")))
    (source.path / "mav0" / "body.yaml").write_text("is_simulated: true\n")
    done: list[tuple[int, int]] = []
    report = convert(source, tmp_path / "there", target, lambda k, n: done.append((k, n)))
    assert (report.images, report.left_out) == (6, 0)
    assert done == [(k, 6) for k in range(1, 7)]
    there = open_recording(tmp_path / "there")
    assert there.format == target
    assert there.is_simulated
    assert_same(there, source)
    convert(there, tmp_path / "back", "euroc")
    back = open_recording(tmp_path / "back")
    assert_same(back, source)
    for file in sorted((source.path / "mav0").glob("cam?/data/*.png")):
        assert (tmp_path / "back" / file.relative_to(source.path)).read_bytes() == file.read_bytes()
    truth = tmp_path / "back" / "mav0" / "state_groundtruth_estimate0" / "data.csv"
    assert truth.read_text() == TRUTH
    assert [path.name for path in tmp_path.iterdir() if path.name.startswith(".")] == []


def test_a_second_round_trip_is_byte_for_byte_the_first(tmp_path: Path) -> None:
    convert(open_recording(write_euroc(tmp_path / "source")), tmp_path / "a.bag", "ros2-mcap")
    convert(open_recording(tmp_path / "a.bag"), tmp_path / "b", "euroc")
    convert(open_recording(tmp_path / "b"), tmp_path / "c", "ros2-mcap")
    convert(open_recording(tmp_path / "c"), tmp_path / "d", "euroc")
    files = sorted(path.relative_to(tmp_path / "b") for path in (tmp_path / "b").rglob("*") if path.is_file())
    assert len(files) > 15
    for name in files:
        assert (tmp_path / "b" / name).read_bytes() == (tmp_path / "d" / name).read_bytes(), name


@pytest.mark.parametrize("name", ["euroc_v101_still", "yard_dev", "kitti_odometry_a"])
def test_real_round_trip(tmp_path: Path, name: str) -> None:
    source = open_recording(real(name))
    convert(source, tmp_path / "bag", "ros2-mcap")
    there = open_recording(tmp_path / "bag")
    assert_same(there, source)
    convert(there, tmp_path / "back", "euroc")
    assert_same(open_recording(tmp_path / "back"), source)
    if name == "kitti_odometry_a":
        left = source.camera_stamps.left_ns
        for original, copy in zip(
            read_ground_truth(source.path, left).poses,
            read_ground_truth(tmp_path / "back").poses,
            strict=True,
        ):
            np.testing.assert_allclose(copy.matrix, original.matrix, atol=1e-12)


def test_an_imu_mounted_askew_is_written_in_body(tmp_path: Path) -> None:
    write_euroc(tmp_path / "source")
    askew = np.eye(4)
    askew[:3, :3] = Rotation.from_rotvec([0.3, 0.2, -0.4]).as_matrix()
    write_imu(tmp_path / "source" / "mav0", askew)
    source = open_recording(tmp_path / "source")
    convert(source, tmp_path / "bag", "ros2-mcap")
    assert_same(open_recording(tmp_path / "bag"), source)


def test_bare_recordings_and_colour_pictures(tmp_path: Path) -> None:
    write_euroc(tmp_path / "source", imu=False, crane=False)
    path = tmp_path / "source" / "mav0" / "cam0" / "data" / f"{stamps(3)[0]}.png"
    path.write_bytes(png(np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)))
    source = open_recording(tmp_path / "source")
    for target in TARGETS:
        convert(source, tmp_path / target, target)
        assert_same(open_recording(tmp_path / target), source)


def test_missing_pictures_are_counted_and_one_side_is_kept(tmp_path: Path) -> None:
    write_euroc(tmp_path / "source")
    (tmp_path / "source" / "mav0" / "cam1" / "data" / f"{stamps(3)[1]}.png").unlink()
    report = convert(open_recording(tmp_path / "source"), tmp_path / "bag", "ros2-mcap")
    assert (report.images, report.left_out) == (5, 1)
    index = open_recording(tmp_path / "bag").index
    assert index.stamps_ns == (stamps(3)[0], stamps(3)[2])
    assert [frame.stamp_ns for frame in index.unpaired] == [stamps(3)[1]]


def test_garbled_truth_is_never_read_by_a_measurement(tmp_path: Path) -> None:
    root = with_truth(write_euroc(tmp_path / "source"))
    (root / "mav0" / "state_groundtruth_estimate0" / "data.csv").write_bytes(b"\xff\x00 garbage")
    source = open_recording(root)
    convert(source, tmp_path / "bag", "ros2-mcap")
    assert_same(open_recording(tmp_path / "bag"), source)
    assert not any("groundtruth" in name for name in source.digests())


def test_out_must_be_free_and_elsewhere(tmp_path: Path) -> None:
    source = open_recording(write_euroc(tmp_path / "source"))
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").write_text("mine")
    for out, message in (
        (tmp_path / "full", "not empty"),
        (tmp_path / "full" / "file", "is a file"),
        (tmp_path / "full" / "file" / "deep" / "out", "a part of the path is a file"),
        (tmp_path / "source" / "bag", "lies in the recording itself"),
        (tmp_path / "source", "lies in the recording itself"),
    ):
        with pytest.raises(OutputError, match=message):
            convert(source, out, "ros2-mcap")
    assert (tmp_path / "full" / "file").read_text() == "mine"


@pytest.mark.parametrize("target", TARGETS)
@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_a_failure_in_the_middle_leaves_nothing(tmp_path: Path, target: Target, error: BaseException) -> None:
    source = open_recording(write_euroc(tmp_path / "source"))

    def progress(done: int, total: int) -> None:
        if done == 3:
            raise error

    expected = OutputError if isinstance(error, OSError) else KeyboardInterrupt
    with pytest.raises(expected):
        convert(source, tmp_path / "out", target, progress)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["source"]


def test_pictures_are_handed_on_one_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No more than two stored pictures are alive at any moment of a conversion."""
    alive = 0
    most = 0

    class Counted(stored_images.StoredImage):
        def __del__(self) -> None:
            nonlocal alive
            alive -= 1

    original = EurocRecording.stored_images

    def counted(self: EurocRecording):  # type: ignore[no-untyped-def]
        nonlocal alive, most
        for image in original(self):
            alive += 1
            most = max(most, alive)
            yield Counted(image.camera, image.stamp_ns, image.kind, image.data)
            del image

    monkeypatch.setattr(EurocRecording, "stored_images", counted)
    source = open_recording(write_euroc(tmp_path / "source", 20))
    for target in TARGETS:
        convert(source, tmp_path / target, target)
    assert most <= 2


def test_a_rig_that_rounds_differently_reads_back(tmp_path: Path) -> None:
    """Mountings given to five digits, as people type them: projected once, then stable."""
    write_euroc(tmp_path / "source")
    for camera, matrix in enumerate(mounts()):
        text = yaml.safe_dump(camera_yaml(np.round(matrix, 5)))
        (tmp_path / "source" / "mav0" / f"cam{camera}" / "sensor.yaml").write_text(text)
    source = open_recording(tmp_path / "source")
    convert(source, tmp_path / "bag", "ros2-mcap")
    assert_same(open_recording(tmp_path / "bag"), source)
