"""Read ROS 1 and ROS 2 bags with Kalibr's calibration.

A bag is read from front to back twice: once for the stamps and the slow sensors when one of them is first
requested, once for the pictures. Only pictures that wait for their partner are held.
"""

from __future__ import annotations

from array import array
from collections.abc import Container, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from barsight.calibration.files.yaml_document import read_document
from barsight.calibration.geometry.imu_noise import ImuNoise
from barsight.calibration.geometry.rig import StereoRig
from barsight.core.arrays import Float64, Int64, UInt8
from barsight.core.errors import InputError
from barsight.core.pose import Pose
from barsight.core.reading.bounded_reading import in_range
from barsight.core.records.gray_levels import TornImageError
from barsight.core.records.pairs import RefusedFrame, StereoFrame
from barsight.core.records.sensor_samples import CraneSamples, ImuSamples, LaserProfile
from barsight.core.stamps import rows_not_later
from barsight.recording.base import FrameIndex, RecordingSettings
from barsight.recording.formats.bag_file import BAG_KINDS, BagFile, RawMessage
from barsight.recording.formats.bag_images import file_of, gray_of
from barsight.recording.formats.bag_laser import laser_rows
from barsight.recording.formats.bag_setup import choose_topics, find_calibration
from barsight.recording.formats.segments import SEGMENTS, SegmentFile
from barsight.recording.own_files import expect_own_files, file_digests, states_simulated
from barsight.recording.pairing import PairedStamps, pair_cameras
from barsight.recording.sensor_samples import laser_std, make_crane, make_imu, make_laser
from barsight.recording.stored_images import StoredImage

BESIDE = ("crane0.yaml", "laser0.yaml", "body.yaml")
"""Files that describe what the messages of a bag don't."""
WAITING_LIMIT = 64


@dataclass
class _Column:
    """Stamps and values of one sensor while the bag is scanned."""

    stamps: array[int] = field(default_factory=lambda: array("q"))
    values: array[float] = field(default_factory=lambda: array("d"))

    def stamp_ns(self) -> Int64:
        return np.array(self.stamps, dtype=np.int64)

    def table(self, width: int) -> Float64:
        return np.array(self.values, dtype=np.float64).reshape(-1, width)


class BagRecording:
    """A `Recording` in a bag. Opening checks the calibration and the topics.

    path: a `.bag`, a ROS 2 bag folder, a `.mcap` or a `.db3`. Crane and laser are on `/crane0/position`
    (PointStamped, with a `crane0.yaml` beside) and `/laser0/profiles` (PointCloud2 with profile, x, y, z), as
    `barsight convert` writes them. Raises `InputError` and `CalibrationError`.
    """

    def __init__(self, path: Path, bag_path: Path, kind: str, settings: RecordingSettings) -> None:
        self.path = path
        self.format = kind
        self._folder = path if path.is_dir() else path.parent
        self._settings = settings
        own = self._bag_files() if path.is_dir() else []
        expect_own_files(self._folder, [*(file.name for file in own), *BESIDE])
        self._bag = SegmentFile(bag_path) if kind == SEGMENTS else BagFile(bag_path)
        self._calibration = find_calibration(path, settings)
        self._topics = choose_topics(path, self._bag.topics, self._calibration, settings)

    @property
    def rig(self) -> StereoRig:
        """Return the rig; see `Recording.rig`."""
        return self._calibration.chain.rig

    @cached_property
    def is_simulated(self) -> bool:
        """Return `is_simulated` of a `body.yaml` in the bag's folder; False if it isn't stated."""
        return states_simulated(self._folder)

    @property
    def notes(self) -> tuple[str, ...]:
        """Return the notes; see `Recording.notes`."""
        if not self._calibration.chain.knows_imu:
            return ("the camchain has no T_cam_imu: the body is cam0 and an IMU in the bag isn't used",)
        return ()

    @cached_property
    def _scan(self) -> dict[str, _Column]:
        names = self._topics
        columns = {name: _Column() for name in vars(names).values() if name}
        for message in self._bag.messages(list(columns)):
            column = columns[message.topic]
            if message.topic == names.laser:
                rows = laser_rows(self._bag.path, self._decoded(message))
                column.values.extend(rows.ravel())
                continue
            column.stamps.append(message.stamp_ns)
            if message.topic == names.imu:
                decoded = self._decoded(message)
                w, a = decoded.angular_velocity, decoded.linear_acceleration
                column.values.extend((w.x, w.y, w.z, a.x, a.y, a.z))
            elif message.topic == names.crane:
                point = self._decoded(message).point
                column.values.extend((point.x, point.y, point.z))
        for name, column in columns.items():
            if name != names.laser and not column.stamps:
                raise InputError(
                    self._bag.path, f"{name} has no message, though the bag counts some", "copy the bag again"
                )
            self._expect_increasing(name, column.stamp_ns())
        return columns

    @cached_property
    def camera_stamps(self) -> PairedStamps:
        """Return all pictures' stamps, paired or not."""
        left, right = (self._scan[name].stamp_ns() for name in (self._topics.cam0, self._topics.cam1))
        return pair_cameras(self.path, left, right, self._settings.pair_tolerance_s)

    @property
    def index(self) -> FrameIndex:
        """Return the index; see `Recording.index`."""
        return self.camera_stamps.index

    def frames(self, wanted: Container[int] | None = None) -> Iterator[StereoFrame | RefusedFrame]:
        """Yield frames as `Recording.frames`.

        The bag is read once; a picture waits undecoded for its partner.
        """
        pairs = self.camera_stamps
        turns = (
            {int(pairs.left_ns[k]): turn for turn, k in enumerate(pairs.pairing.left)},
            {int(pairs.right_ns[k]): turn for turn, k in enumerate(pairs.pairing.right)},
        )
        waiting: dict[int, dict[int, RawMessage]] = {}
        due = 0
        for message in self._pictures():
            camera = 0 if message.topic == self._topics.cam0 else 1
            turn = turns[camera].get(message.stamp_ns)
            if turn is None:
                continue
            waiting.setdefault(turn, {})[camera] = message
            while len(waiting.get(due, ())) == 2:
                stamp, pair = self.index.stamps_ns[due], waiting.pop(due)
                if wanted is None or stamp in wanted:
                    yield self._pair(stamp, pair)
                due += 1
            if sum(map(len, waiting.values())) > WAITING_LIMIT:
                raise InputError(
                    self._bag.path,
                    f"more than {WAITING_LIMIT} pictures wait for the other camera's: the bag isn't in "
                    "time's order",
                    "sort the bag by time (`ros2 bag convert`) or record both cameras together",
                )

    def stored_images(self) -> Iterator[StoredImage]:
        """Yield every picture as a file's bytes, in the bag's order: raw pixels as PNG, damaged pictures
        left out.
        """
        for message in self._pictures():
            try:
                kind, data = file_of(message.kind, self._picture(message))
            except TornImageError:
                continue
            yield StoredImage(int(message.topic == self._topics.cam1), message.stamp_ns, kind, data)

    @cached_property
    def _imu(self) -> ImuSamples | None:
        name = self._topics.imu
        if name is None:
            return None
        table = self._finite(name, 6)
        stamps = self._scan[name].stamp_ns()
        identity = Pose.identity("body", "imu")
        return make_imu(self._bag.path, stamps, table[:, :3].copy(), table[:, 3:].copy(), identity)

    def imu(self) -> ImuSamples | None:
        """Read the IMU; see `Recording.imu`."""
        return self._imu

    def imu_noise(self) -> ImuNoise | None:
        """Read the IMU's noise; see `Recording.imu_noise`."""
        return self._calibration.imu.noise if self._calibration.imu and self._topics.imu else None

    def crane(self) -> CraneSamples | None:
        """Read the encoders; see `Recording.crane`."""
        return self._crane

    @cached_property
    def _crane(self) -> CraneSamples | None:
        name = self._topics.crane
        if name is None:
            return None
        document = read_document(self._folder / "crane0.yaml")
        return make_crane(document, self._scan[name].stamp_ns(), self._finite(name, 3))

    def laser(self) -> tuple[LaserProfile, ...]:
        """Read the laser; see `Recording.laser`."""
        name = self._topics.laser
        if name is None:
            return ()
        path = self._folder / "laser0.yaml"
        rows = self._finite(name, 4)
        std = laser_std(read_document(path) if path.is_file() else None)
        return make_laser(self.path, rows[:, 0].astype(np.int64), rows[:, 1:], std)

    def digests(self) -> dict[str, str]:
        """Compute digests; see `Recording.digests`."""
        extra = [self._folder / name for name in BESIDE]
        return file_digests(self._folder, [*self._calibration.files, *extra], self._bag_files())

    def _bag_files(self) -> list[Path]:
        files = sorted(self.path.iterdir()) if self.path.is_dir() else [self.path]
        return [file for file in files if file.suffix in BAG_KINDS or file.name == "metadata.yaml"]

    def _pictures(self) -> Iterator[RawMessage]:
        return self._bag.messages((self._topics.cam0, self._topics.cam1))

    def _picture(self, message: RawMessage) -> Any:
        try:
            return self._bag.decode(message)
        except ValueError as error:
            raise TornImageError(str(error)) from None

    def _pair(self, stamp_ns: int, messages: dict[int, RawMessage]) -> StereoFrame | RefusedFrame:
        images: list[UInt8] = []
        for camera, message in ((self.rig.cam0, messages[0]), (self.rig.cam1, messages[1])):
            try:
                images.append(gray_of(message.kind, self._picture(message), (camera.width, camera.height)))
            except TornImageError as error:
                return RefusedFrame(stamp_ns, f"{message.topic} at {message.stamp_ns} {error}")
        return StereoFrame(stamp_ns, images[0], images[1])

    def _decoded(self, message: RawMessage) -> Any:
        try:
            return self._bag.decode(message)
        except ValueError as error:
            raise InputError(
                self._bag.path, f"{message.topic} at {message.stamp_ns} {error}", "copy the bag again"
            ) from None

    def _expect_increasing(self, topic: str, stamps: Int64) -> None:
        bad = rows_not_later(stamps)
        if bad.size:
            what = "is there twice" if stamps[bad[0]] == stamps[bad[0] + 1] else "goes back in time"
            if stamps[bad[0]] == stamps[bad[0] + 1] == 0:
                what = "carries no time (header.stamp)"
            raise InputError(
                self._bag.path,
                f"{topic}: message {int(bad[0]) + 2} of stamp {int(stamps[bad[0] + 1])} {what} "
                f"({bad.size} such messages)",
                "record the sensor's own stamps and one publisher only",
            )

    def _finite(self, topic: str, width: int) -> Float64:
        table = self._scan[topic].table(width)
        bad = np.flatnonzero(~in_range(table).all(axis=1))
        if bad.size:
            raise InputError(
                self._bag.path,
                f"{topic}: value {int(bad[0]) + 1} is NaN, infinite or too large ({bad.size} such values)",
                "record again or take the sensor's dropouts out",
            )
        return table
