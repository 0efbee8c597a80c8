"""Write a recording as a ROS bag with Kalibr's files; `rosbags` writes it, no ROS is needed."""

from __future__ import annotations

import heapq
import sqlite3
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_typestore

from barsight.calibration.files.kalibr import write_camchain, write_imu_file
from barsight.calibration.files.yaml_document import write_document
from barsight.core.arrays import Int64, UInt8
from barsight.core.errors import InputError, OutputError
from barsight.core.records.sensor_samples import CraneSamples, ImuSamples, LaserProfile
from barsight.core.stamps import NS_PER_S
from barsight.recording.base import Recording
from barsight.recording.formats.bag_file import (
    CLOUD_TYPE,
    COMPRESSED_TYPE,
    IMAGE_TYPE,
    IMU_TYPE,
    POINT_TYPE,
)
from barsight.recording.formats.bag_laser import NAMES
from barsight.recording.formats.bag_setup import CRANE_TOPIC, LASER_TOPIC
from barsight.recording.stored_images import StoredPictures
from barsight.recording.writers.euroc import (
    copy_truth,
    laser_table,
    write_crane_description,
    write_laser_description,
)

CAMERA_TOPICS = ("/cam0/image_raw", "/cam1/image_raw")
IMU_TOPIC = "/imu0"
FLOAT64 = 8
MAX_NS = 2**31 * NS_PER_S


@dataclass(frozen=True)
class BagFlavour:
    """A kind of bag. storage: None for ROS 1."""

    storage: StoragePlugin | None


BAG_FLAVOURS = {
    "ros2-mcap": BagFlavour(StoragePlugin.MCAP),
    "ros2-sqlite3": BagFlavour(StoragePlugin.SQLITE3),
    "ros1": BagFlavour(None),
}

Item = tuple[int, int, str, str, Any]
"""Stamp, rank among equal stamps, topic, message type, message."""


def write_bag(
    recording: StoredPictures, folder: Path, name: str, flavour: BagFlavour, progress: Callable[[int], None]
) -> int:
    """Write the bag `name` and its calibration into `folder`; return the number of pictures written.

    Messages are in time order, so that a reader need not hold more than a chunk.
    Raises `InputError` for stamps that ROS can't represent.
    """
    messages = BagMessages(ros1=flavour.storage is None)
    imu, crane, laser = recording.imu(), recording.crane(), recording.laser()
    cameras = recording.camera_stamps
    for stamps in (cameras.left_ns, cameras.right_ns, *(s.stamp_ns for s in (imu, crane) if s is not None)):
        _expect_ros_times(recording.path, stamps)
    streams = [messages.images(recording)]
    if imu is not None:
        streams.append(messages.imu(imu))
    if crane is not None:
        streams.append(messages.crane(crane))
    if laser:
        streams.append(messages.laser(int(recording.camera_stamps.left_ns[0]), laser))
    try:
        written = _write(folder, name, flavour, messages, heapq.merge(*streams, key=_order), progress)
    except sqlite3.Error as error:
        raise OutputError(f"{folder.parent / name}: can't be written ({error}); free some space") from error
    write_descriptions(recording, folder)
    copy_truth(recording, folder)
    return written


def _expect_ros_times(path: Path, stamps: Int64) -> None:
    """Refuse stamps (N,) that ROS can't represent: unsigned, increasing, seconds below 2^31."""
    for stamp in (int(stamps[0]), int(stamps[-1])):
        if not 0 <= stamp < MAX_NS:
            raise InputError(
                path, f"the stamp {stamp} ns can't be held by a ROS bag", "shift all stamps to after 1970"
            )


def write_descriptions(recording: Recording, folder: Path) -> None:
    """Write the calibration and the other descriptions beside a bag's messages."""
    write_camchain(folder / "camchain-imucam.yaml", recording.rig, CAMERA_TOPICS)
    if (noise := recording.imu_noise()) is not None:
        write_imu_file(folder / "imu.yaml", noise, IMU_TOPIC)
    write_document(folder / "body.yaml", {"comment": "body", "is_simulated": recording.is_simulated})
    if (crane := recording.crane()) is not None:
        write_crane_description(folder / "crane0.yaml", crane)
    if laser := recording.laser():
        write_laser_description(folder / "laser0.yaml", laser)


def _order(item: Item) -> tuple[int, int]:
    return item[0], item[1]


class BagMessages:
    """Makes the messages for ROS 1 or ROS 2, stamped and in time order for each sensor."""

    def __init__(self, *, ros1: bool) -> None:
        self.typestore = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
        self.serialize = self.typestore.serialize_ros1 if ros1 else self.typestore.serialize_cdr
        self._types = self.typestore.types
        self._leading = (0,) if ros1 else ()

    def _header(self, stamp_ns: int, frame: str) -> Any:
        time = self._types["builtin_interfaces/msg/Time"](stamp_ns // NS_PER_S, stamp_ns % NS_PER_S)
        return self._types["std_msgs/msg/Header"](*self._leading, time, frame)

    def images(self, recording: StoredPictures) -> Iterator[Item]:
        make = self._types[COMPRESSED_TYPE]
        for image in recording.stored_images():
            kind = "jpeg" if image.kind in ("jpg", "jpeg") else image.kind
            data = np.frombuffer(image.data, dtype=np.uint8)
            message = make(self._header(image.stamp_ns, f"cam{image.camera}"), kind, data)
            topic = f"{CAMERA_TOPICS[image.camera]}/compressed"
            yield image.stamp_ns, image.camera, topic, COMPRESSED_TYPE, message

    def picture(self, camera: int, stamp_ns: int, image: UInt8) -> Item:
        """Make the message of a picture (H, W) unchanged."""
        height, width = image.shape
        make, header = self._types[IMAGE_TYPE], self._header(stamp_ns, f"cam{camera}")
        message = make(header, height, width, "mono8", 0, width, np.ascontiguousarray(image).reshape(-1))
        return stamp_ns, camera, CAMERA_TOPICS[camera], IMAGE_TYPE, message

    def imu(self, samples: ImuSamples) -> Iterator[Item]:
        vector = self._types["geometry_msgs/msg/Vector3"]
        no_attitude = self._types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
        unknown, absent = np.zeros(9), np.array([-1.0] + [0.0] * 8)
        make = self._types[IMU_TYPE]
        for stamp, gyro, accel in zip(
            samples.stamp_ns.tolist(), samples.gyro_radps, samples.accel_mps2, strict=True
        ):
            header = self._header(stamp, "imu0")
            rates, forces = vector(*gyro.tolist()), vector(*accel.tolist())
            yield (
                stamp,
                2,
                IMU_TOPIC,
                IMU_TYPE,
                make(header, no_attitude, absent, rates, unknown, forces, unknown),
            )

    def crane(self, samples: CraneSamples) -> Iterator[Item]:
        point = self._types["geometry_msgs/msg/Point"]
        make = self._types[POINT_TYPE]
        for stamp, place in zip(samples.stamp_ns.tolist(), samples.position_m.tolist(), strict=True):
            yield stamp, 3, CRANE_TOPIC, POINT_TYPE, make(self._header(stamp, "yard"), point(*place))

    def laser(self, stamp_ns: int, laser: tuple[LaserProfile, ...]) -> Iterator[Item]:
        """Make one cloud of all profiles, at the first picture's stamp, as the contract gives the laser no
        times.
        """
        profile, xyz = laser_table(laser)
        rows = np.column_stack([profile.astype("<f8"), xyz.astype("<f8")])
        make_field = self._types["sensor_msgs/msg/PointField"]
        fields = [make_field(name, 8 * k, FLOAT64, 1) for k, name in enumerate(NAMES)]
        data = np.frombuffer(rows.tobytes(), dtype=np.uint8)
        header = self._header(stamp_ns, "yard")
        cloud = self._types[CLOUD_TYPE](header, 1, len(rows), fields, False, 32, data.size, data, True)
        yield stamp_ns, 4, LASER_TOPIC, CLOUD_TYPE, cloud


def _write(
    folder: Path,
    name: str,
    flavour: BagFlavour,
    messages: BagMessages,
    items: Iterator[Item],
    progress: Callable[[int], None],
) -> int:
    """Write the bag itself.

    rosbags names the files of a ROS 2 bag after its folder, so it gets its own folder.
    """
    place = folder / name
    writer: Any
    if flavour.storage is None:
        writer = Ros1Writer(place.with_name(f"{name}.bag"))
    else:
        writer = Ros2Writer(place, version=9, storage_plugin=flavour.storage)
    images = 0
    with writer:
        connections: dict[str, Any] = {}
        for stamp, _, topic, kind, message in items:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=messages.typestore)
            writer.write(connections[topic], stamp, messages.serialize(message, kind))
            if kind == COMPRESSED_TYPE:
                images += 1
                progress(images)
    if flavour.storage is not None:
        for path in sorted(place.iterdir()):
            path.replace(folder / path.name)
        place.rmdir()
    return images
