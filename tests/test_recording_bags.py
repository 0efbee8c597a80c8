"""Bags as other people write them: ROS 1, ROS 2 sqlite3 and mcap, raw pictures, Kalibr's files beside."""

import contextlib
import sqlite3
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_typestore

from barsight.calibration.files.rig_file import write_rig_file
from barsight.calibration.files.rig_formats import read_rig_file
from barsight.cli.main import run
from barsight.core.errors import CalibrationError, InputError
from barsight.core.records.pairs import RefusedFrame, StereoFrame
from barsight.recording.base import RecordingSettings
from barsight.recording.formats import bag
from barsight.recording.open import open_recording
from recording_samples import HEIGHT, NOISE, START_NS, WIDTH, camera_yaml, mounts, picture, png, stamps

KINDS = ("ros1", "ros2-sqlite3", "ros2-mcap")
IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
IMU = "sensor_msgs/msg/Imu"


@dataclass(frozen=True)
class Sent:
    """One message to write: its topic, type, header stamp, and what fills it."""

    topic: str
    kind: str
    stamp_ns: int
    content: Any


def write_bag(path: Path, kind: str, sent: list[Sent]) -> Path:
    """Write messages in the order given, received 1 ms apart."""
    ros1 = kind == "ros1"
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    plugin = StoragePlugin.MCAP if kind == "ros2-mcap" else StoragePlugin.SQLITE3
    path.parent.mkdir(parents=True, exist_ok=True)
    writer: Any = Ros1Writer(path) if ros1 else Ros2Writer(path, version=8, storage_plugin=plugin)
    with writer:
        connections: dict[str, Any] = {}
        for k, message in enumerate(sent):
            if message.topic not in connections:
                connections[message.topic] = writer.add_connection(
                    message.topic, message.kind, typestore=store
                )
            filled = fill(store.types, message, (0,) if ros1 else ())
            serialize = store.serialize_ros1 if ros1 else store.serialize_cdr
            writer.write(
                connections[message.topic], START_NS + k * 1_000_000, serialize(filled, message.kind)
            )
    return path


def fill(types: Any, message: Sent, leading: tuple[int, ...]) -> Any:
    seconds, nanoseconds = divmod(message.stamp_ns, 1_000_000_000)
    time = types["builtin_interfaces/msg/Time"](seconds, nanoseconds)
    header = types["std_msgs/msg/Header"](*leading, time, "frame")
    if message.kind == IMAGE:
        encoding, pixels = message.content
        data = np.frombuffer(pixels.tobytes(), np.uint8)
        height, width = pixels.shape[:2]
        return types[IMAGE](header, height, width, encoding, 0, pixels.nbytes // height, data)
    if message.kind == COMPRESSED:
        return types[COMPRESSED](header, "x", np.frombuffer(message.content, np.uint8))
    vector = types["geometry_msgs/msg/Vector3"]
    attitude = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    w, a = vector(*message.content[:3]), vector(*message.content[3:])
    return types[IMU](header, attitude, np.zeros(9), w, np.zeros(9), a, np.zeros(9))


def messages(count: int = 4, prefix: str = "/cam") -> list[Sent]:
    sent = []
    for k, stamp in enumerate(stamps(count)):
        sent.extend(
            Sent("/imu0", IMU, stamp + j * 5_000_000, (0.1 * k, j / 3, -0.2, 0.0, 0.1, 9.81))
            for j in range(3)
        )
        for camera in (1, 0):
            content = ("mono8", picture(10 * k + camera))
            sent.append(Sent(f"{prefix}{camera}/image_raw", IMAGE, stamp, content))
    return sent


def write_kalibr(folder: Path, *, knows_imu: bool = True, **changes: object) -> None:
    chain = {}
    for k, matrix in enumerate(mounts()):
        section = camera_yaml(matrix, distortion_model="radtan", rostopic=f"/cam{k}/image_raw", **changes)
        section["distortion_coeffs"] = section.pop("distortion_coefficients")
        del section["T_BS"]
        if knows_imu:
            section["T_cam_imu"] = np.linalg.inv(matrix).tolist()
        if k == 1:
            section["T_cn_cnm1"] = (np.linalg.inv(mounts()[1]) @ mounts()[0]).tolist()
        chain[f"cam{k}"] = section
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "camchain-imucam.yaml").write_text(yaml.safe_dump(chain))
    (folder / "imu.yaml").write_text(yaml.safe_dump({**NOISE, "rostopic": "/imu0", "update_rate": 200}))


def bag_path(tmp_path: Path, kind: str) -> Path:
    return tmp_path / ("a.bag" if kind == "ros1" else "a")


@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_of_another_tool(tmp_path: Path, kind: str) -> None:
    path = write_bag(bag_path(tmp_path, kind), kind, messages())
    write_kalibr(tmp_path)
    recording = open_recording(path)
    assert recording.format == kind
    assert recording.index.stamps_ns == tuple(stamps(4))
    assert recording.index.unpaired == ()
    frames = list(recording.frames())
    for k, frame in enumerate(frames):
        assert isinstance(frame, StereoFrame)
        np.testing.assert_array_equal(frame.left, picture(10 * k))
        np.testing.assert_array_equal(frame.right, picture(10 * k + 1))
    imu = recording.imu()
    assert imu is not None
    assert imu.stamp_ns.tolist() == [s + j * 5_000_000 for s in stamps(4) for j in range(3)]
    assert imu.gyro_radps[5].tolist() == [0.1, 2 / 3, -0.2]
    noise = recording.imu_noise()
    assert noise is not None
    assert noise.gyro_density == 1.7e-4
    np.testing.assert_allclose(recording.rig.body_from_cam1.matrix, mounts()[1], atol=1e-12)
    assert (recording.crane(), recording.laser(), recording.is_simulated) == (None, (), False)
    assert {"camchain-imucam.yaml", "imu.yaml"} <= {Path(name).name for name in recording.digests()}


@pytest.mark.parametrize("kind", ["ros2-sqlite3", "ros2-mcap"])
def test_the_lone_file_and_a_folder_without_metadata(tmp_path: Path, kind: str) -> None:
    path = write_bag(tmp_path / "a", kind, messages())
    write_kalibr(path)
    (file,) = [file for file in path.iterdir() if file.suffix in (".db3", ".mcap")]
    assert len(list(open_recording(file).frames())) == 4
    (path / "metadata.yaml").unlink()
    assert len(list(open_recording(path).frames())) == 4
    (path / "b.db3").write_bytes(b"")
    with pytest.raises(InputError, match="holds several bags and no metadata"):
        open_recording(path)


@pytest.mark.parametrize(
    ("encoding", "pixels", "expected"),
    [
        ("8UC1", picture(1), picture(1)),
        ("mono16", picture(1).astype(np.uint16) * 257, picture(1)),
        ("bgr8", np.dstack([picture(k) for k in range(3)]), None),
        ("rgb8", np.dstack([picture(k) for k in (2, 1, 0)]), None),
        ("bgra8", np.dstack([picture(k) for k in (0, 1, 2, 5)]), None),
        ("rgba8", np.dstack([picture(k) for k in (2, 1, 0, 5)]), None),
        ("bayer_rggb8", np.full((HEIGHT, WIDTH), 90, np.uint8), np.full((HEIGHT, WIDTH), 90, np.uint8)),
    ],
)
def test_encodings(tmp_path: Path, encoding: str, pixels: np.ndarray, expected: np.ndarray | None) -> None:
    if expected is None:
        expected = cv2.cvtColor(np.dstack([picture(k) for k in range(3)]), cv2.COLOR_BGR2GRAY)
    sent = [Sent(f"/cam{k}/image_raw", IMAGE, START_NS, (encoding, pixels)) for k in (0, 1)]
    path = write_bag(tmp_path / "a", "ros2-sqlite3", sent)
    write_kalibr(tmp_path)
    (frame,) = open_recording(path).frames()
    assert isinstance(frame, StereoFrame)
    np.testing.assert_array_equal(frame.left, expected)


def test_torn_and_odd_messages_are_refused(tmp_path: Path) -> None:
    data = png(picture(0))
    contents = [
        data,
        data[:-12],
        cv2.imencode(".jpg", picture(0))[1].tobytes(),
        b"GIF89a",
        png(picture(0)[:9]),
    ]
    sent = [
        Sent(f"/cam{camera}/image_raw/compressed", COMPRESSED, stamp, content if camera else data)
        for stamp, content in zip(stamps(5), contents, strict=True)
        for camera in (0, 1)
    ]
    path = write_bag(tmp_path / "a", "ros2-mcap", sent)
    write_kalibr(tmp_path)
    frames = list(open_recording(path).frames())
    reasons = [frame.reason if isinstance(frame, RefusedFrame) else "" for frame in frames]
    assert [bool(reason) for reason in reasons] == [False, True, False, True, True]
    assert reasons[1].startswith(f"/cam1/image_raw/compressed at {stamps(5)[1]} is a PNG cut short")
    assert "is 64x9, the calibration is for 64x48" in reasons[4]


def test_raw_pictures_that_are_too_short_or_unknown_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sent = [Sent(f"/cam{k}/image_raw", IMAGE, START_NS, ("yuv422", picture(0))) for k in (0, 1)]
    path = write_bag(tmp_path / "a", "ros2-sqlite3", sent)
    write_kalibr(tmp_path)
    (frame,) = open_recording(path).frames()
    assert isinstance(frame, RefusedFrame)
    assert "has the encoding 'yuv422'" in frame.reason
    assert run(["convert", str(path), "-o", str(tmp_path / "whole"), "--to", "euroc"]) == 3
    told = " ".join(capsys.readouterr().err.split())
    assert "none of its pictures can be read" in told and "yuv422" in told
    assert not (tmp_path / "whole").exists()
    sent = [replace(message, content=("mono16", picture(0))) for message in sent]
    (frame,) = open_recording_of(tmp_path / "b", sent)
    assert isinstance(frame, RefusedFrame)
    assert "is cut short: 3072 bytes for 64x48 mono16" in frame.reason


def open_recording_of(path: Path, sent: list[Sent]) -> list[Any]:
    return list(open_recording(write_bag(path, "ros2-sqlite3", sent)).frames())


def test_frames_on_one_side_and_messages_late(tmp_path: Path) -> None:
    """The right camera's messages come three frames late, one frame of each camera is lost."""
    left = [Sent("/cam0/image_raw", IMAGE, s, ("mono8", picture(k))) for k, s in enumerate(stamps(9))]
    right = [Sent("/cam1/image_raw", IMAGE, s + 100, ("mono8", picture(k))) for k, s in enumerate(stamps(9))]
    del left[2], right[5]
    order = [*left[:3], *(m for pair in zip(right, left[3:], strict=False) for m in pair), *right[5:]]
    path = write_bag(tmp_path / "a", "ros2-mcap", order)
    write_kalibr(tmp_path)
    recording = open_recording(path)
    assert recording.index.stamps_ns == tuple(s for k, s in enumerate(stamps(9)) if k not in (2, 5))
    assert len(recording.index.unpaired) == 2
    frames = list(recording.frames())
    assert [frame.stamp_ns for frame in frames] == list(recording.index.stamps_ns)
    assert all(isinstance(f, StereoFrame) and np.array_equal(f.left, f.right) for f in frames)
    chosen = list(recording.frames({stamps(9)[1], stamps(9)[7]}))
    assert [frame.stamp_ns for frame in chosen] == [stamps(9)[1], stamps(9)[7]]


def test_a_bag_out_of_time_does_not_fill_the_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bag, "WAITING_LIMIT", 5)
    sent = sorted((m for m in messages(8) if m.kind == IMAGE), key=lambda m: m.topic)
    path = write_bag(tmp_path / "a", "ros2-mcap", sent)
    write_kalibr(tmp_path)
    with pytest.raises(InputError, match="more than 5 pictures wait"):
        list(open_recording(path).frames())


def test_topics_are_recognised_by_type_or_named(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "a", "ros2-mcap", messages(prefix="/stereo/eye"))
    write_kalibr(tmp_path)
    assert len(list(open_recording(path).frames())) == 4
    swapped = RecordingSettings(cam0_topic="/stereo/eye1/image_raw", cam1_topic="/stereo/eye0/image_raw")
    frame = next(open_recording(path, swapped).frames())
    assert isinstance(frame, StereoFrame)
    np.testing.assert_array_equal(frame.left, picture(1))
    wrong = r"cam0_topic /nowhere is not a suitable topic .* choose one of /stereo/eye0"
    with pytest.raises(InputError, match=wrong):
        open_recording(path, RecordingSettings(cam0_topic="/nowhere"))
    with pytest.raises(InputError, match="imu_topic /nowhere"):
        open_recording(path, RecordingSettings(imu_topic="/nowhere"))
    same = RecordingSettings(cam0_topic="/stereo/eye1/image_raw", cam1_topic="/stereo/eye1/image_raw")
    with pytest.raises(InputError, match="cam0 and cam1 are both"):
        open_recording(path, same)


def test_left_and_right_by_their_names(tmp_path: Path) -> None:
    sent = [
        Sent(f"/a_{side}/image", IMAGE, s, ("mono8", picture(k)))
        for s in stamps(2)
        for k, side in ((7, "right"), (3, "left"))
    ]
    path = write_bag(tmp_path / "a", "ros2-mcap", sent)
    write_kalibr(tmp_path)
    frame = next(open_recording(path).frames())
    assert isinstance(frame, StereoFrame)
    np.testing.assert_array_equal(frame.left, picture(3))


def test_too_many_and_too_few_topics(tmp_path: Path) -> None:
    write_kalibr(tmp_path)
    third = [Sent("/depth", IMAGE, START_NS, ("mono8", picture(0)))]
    path = write_bag(tmp_path / "a", "ros2-mcap", [*messages(prefix="/eye"), *third])
    with pytest.raises(
        InputError, match=r"has 3 picture topics \(/depth, /eye0/image_raw, /eye1/image_raw\)"
    ):
        open_recording(path)
    path = write_bag(tmp_path / "b", "ros2-mcap", [m for m in messages() if m.kind == IMU])
    with pytest.raises(InputError, match=r"has 0 picture topics \(none\)"):
        open_recording(path)
    more = [replace(m, topic=topic) for m in messages() if m.kind == IMU for topic in ("/imu1", "/imu2")]
    pictures = [m for m in messages() if m.kind == IMAGE]
    path = write_bag(tmp_path / "c", "ros2-mcap", [*pictures, *more])
    with pytest.raises(InputError, match="has several IMU topics"):
        open_recording(path)
    assert open_recording(path, RecordingSettings(imu_topic="/imu2")).imu() is not None


def test_calibration_is_found_or_named(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "bags" / "a", "ros2-mcap", messages())
    with pytest.raises(InputError, match="no calibration in or beside the bag"):
        open_recording(path)
    write_kalibr(tmp_path / "calibration")
    named = RecordingSettings(camchain=tmp_path / "calibration" / "camchain-imucam.yaml")
    recording = open_recording(path, named)
    assert recording.imu_noise() is not None
    with pytest.raises(CalibrationError, match="no such file"):
        open_recording(path, RecordingSettings(camchain=tmp_path / "nowhere.yaml"))
    for name in ("one", "two"):
        write_kalibr(path)
        (path / "camchain-imucam.yaml").rename(path / f"{name}-camchain-imucam.yaml")
    with pytest.raises(InputError, match=r"several calibrations: one-camchain-imucam\.yaml, two-"):
        open_recording(path)


def test_another_rig_takes_the_camchains_place(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "bags" / "a", "ros2-mcap", messages())
    write_kalibr(tmp_path / "calibration")
    rig = read_rig_file(tmp_path / "calibration" / "camchain-imucam.yaml")
    write_rig_file(tmp_path / "rig.yaml", rig)
    recording = open_recording(path, RecordingSettings(rig=tmp_path / "rig.yaml"))
    assert recording.rig.baseline_m == pytest.approx(rig.baseline_m)
    assert len(list(recording.frames())) == len(recording.index.stamps_ns)
    with pytest.raises(CalibrationError, match="no such file"):
        open_recording(path, RecordingSettings(rig=tmp_path / "none.yaml"))


def test_a_camchain_without_imu(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "a", "ros2-mcap", messages())
    write_kalibr(tmp_path, knows_imu=False)
    recording = open_recording(path)
    assert recording.imu() is None
    assert "no T_cam_imu" in recording.notes[0]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("share", [0.0, 0.3, 0.9, 0.999])
def test_a_bag_cut_short(tmp_path: Path, kind: str, share: float) -> None:
    path = write_bag(bag_path(tmp_path, kind), kind, messages(12))
    write_kalibr(tmp_path)
    (file,) = [path] if kind == "ros1" else [f for f in path.iterdir() if f.suffix in (".db3", ".mcap")]
    data = file.read_bytes()
    file.write_bytes(data[: int(share * len(data))])
    with pytest.raises(InputError, match=r"can't be read.*copy it again") as caught:
        recording = open_recording(path)
        recording.imu()
        list(recording.frames())
    assert "\n" not in str(caught.value)


def test_a_topic_whose_messages_are_gone_is_named(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "a", "ros2-sqlite3", messages())
    write_kalibr(tmp_path)
    with contextlib.closing(sqlite3.connect(path / "a.db3")) as rows, rows:
        rows.execute("DELETE FROM messages WHERE topic_id = (SELECT id FROM topics WHERE name = '/imu0')")
    with pytest.raises(InputError, match="/imu0 has no message, though the bag counts some"):
        open_recording(path).imu()


def test_a_type_that_is_no_text_is_refused(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "a", "ros2-sqlite3", messages())
    write_kalibr(tmp_path)
    metadata = path / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("type: sensor_msgs/msg/Imu", "type: [Imu]"))
    with pytest.raises(InputError, match=r"\['Imu'\] is not text.*copy it again"):
        open_recording(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: replace(m, stamp_ns=0), "message 2 of stamp 0 carries no time"),
        (lambda m: replace(m, stamp_ns=START_NS), "message 2 of stamp .* is there twice"),
        (lambda m: replace(m, stamp_ns=10**18 - m.stamp_ns % 10**18), "goes back in time"),
        (lambda m: replace(m, content=(*m.content[:5], float("nan"))), "/imu0: value 1 is NaN"),
        (lambda m: replace(m, content=(0.0, 0.0, 0.0, 0.0, 0.0, 1.0)), "probably in g"),
    ],
)
def test_a_bad_imu(tmp_path: Path, change: Callable[[Sent], Sent], message: str) -> None:
    sent = [change(m) if m.kind == IMU else m for m in messages()]
    path = write_bag(tmp_path / "a", "ros2-mcap", sent)
    write_kalibr(tmp_path)
    with pytest.raises(InputError, match=message):
        open_recording(path).imu()
