"""Stream a bag file of any kind as messages; `rosbags` reads it, no ROS is needed.

A damaged bag makes the underlying parsers raise all kinds of errors; each becomes an `InputError` here.
"""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rosbags.typesys import Stores, get_typestore

from barsight.calibration.files.yaml_document import read_document
from barsight.core.errors import InputError
from barsight.core.reading.bounded_reading import open_regular
from barsight.core.stamps import NS_PER_S
from barsight.recording.formats.bag_reader import BagReader
from barsight.recording.own_files import expect_inner_name, leads_outside

BAG_KINDS = {".bag": "ros1", ".mcap": "ros2-mcap", ".db3": "ros2-sqlite3"}
"""Formats of bag files by their suffix."""
IMAGE_TYPE = "sensor_msgs/msg/Image"
COMPRESSED_TYPE = "sensor_msgs/msg/CompressedImage"
IMU_TYPE = "sensor_msgs/msg/Imu"
POINT_TYPE = "geometry_msgs/msg/PointStamped"
CLOUD_TYPE = "sensor_msgs/msg/PointCloud2"


def ros2_types() -> Any:
    """Return the message types of ROS 2, for reading and writing messages."""
    return get_typestore(Stores.ROS2_HUMBLE)


@dataclass(frozen=True)
class Topic:
    """A topic of a bag, its message type and number of messages."""

    name: str
    kind: str
    count: int


_MAGIC = b"#ROSBAG V2.0\n"


@dataclass(frozen=True)
class RawMessage:
    """A message as stored. stamp_ns: its header's stamp."""

    topic: str
    kind: str
    stamp_ns: int
    data: bytes


class BagFile:
    """One bag. Every call of `messages` opens it again and reads it once from front to back.

    Raises `InputError` for a bag that is cut short, damaged or not indexed.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._is_ros1 = path.is_file() and path.suffix == ".bag"
        self._files = _files(path)
        _expect_own_files(path)
        _expect_whole_database(self._files)
        if self._is_ros1:
            self._expect_bag()
        with self._opened() as reader:
            self._typestore = reader.typestore
            counts: dict[tuple[str, str], int] = {}
            for connection in reader.all_connections:
                key = (self._text(connection.topic), self._text(connection.msgtype))
                counts[key] = counts.get(key, 0) + self._whole(connection.msgcount)
            self.duration_s = self._whole(reader.duration) / NS_PER_S if any(counts.values()) else 0.0
        self.topics = tuple(Topic(name, kind, count) for (name, kind), count in sorted(counts.items()))

    def _expect_bag(self) -> None:
        """Refuse a file without the signature of a bag; rosbags would read its first line, however long."""
        try:
            with self.path.open("rb") as file:
                begin = file.read(len(_MAGIC))
        except OSError as error:
            raise self._torn(error) from error
        if len(begin) == len(_MAGIC) and begin != _MAGIC:
            raise InputError(self.path, "is not a ROS 1 bag (#ROSBAG V2.0 is missing)", "copy it again")

    def messages(self, names: Collection[str]) -> Iterator[RawMessage]:
        """Yield the messages of these topics in the order of their receipt."""
        with self._opened() as reader:
            chosen = [connection for connection in reader.connections if connection.topic in names]
            stream = reader.messages(connections=chosen)
            while chosen:
                try:
                    connection, _, data = next(stream)
                    stamp = self._header_stamp(data)
                except StopIteration:
                    return
                except Exception as error:
                    raise self._torn(error) from error
                yield RawMessage(connection.topic, connection.msgtype, stamp, data)

    def decode(self, message: RawMessage) -> Any:
        """Decode the message to an object with the fields of its definition.

        Raises ValueError if it is damaged.
        """
        typestore = self._typestore
        read = typestore.deserialize_ros1 if self._is_ros1 else typestore.deserialize_cdr
        try:
            return read(message.data, message.kind)
        except Exception as error:
            raise ValueError(f"is a torn message ({_short(error)})") from error

    def _header_stamp(self, data: bytes) -> int:
        """Read the header's stamp, at byte 4 in ROS 1 (after `seq`) and in CDR (after four bytes of byte
        order).
        """
        if len(data) < 12:
            raise ValueError("a message is too short for a header")
        seconds, nanoseconds = struct.unpack_from("<II" if self._is_ros1 or data[1] & 1 else ">II", data, 4)
        return int(seconds) * NS_PER_S + int(nanoseconds)

    @contextlib.contextmanager
    def _opened(self) -> Iterator[BagReader]:
        try:
            reader = BagReader(self._files, ros2_types())
            reader.open()
        except Exception as error:
            raise self._torn(error) from error
        try:
            yield reader
        finally:
            reader.close()

    def _whole(self, number: Any) -> int:
        """Require a number of metadata.yaml to be whole, as rosbags uses it unchecked."""
        if not isinstance(number, int):
            raise self._torn(ValueError(f"{number!r} is no whole number"))
        return number

    def _text(self, text: Any) -> str:
        """Require a value of metadata.yaml to be text, as rosbags uses it unchecked."""
        if not isinstance(text, str):
            raise self._torn(ValueError(f"{text!r} is not text"))
        return text

    def _torn(self, error: Exception) -> InputError:
        remedy = "copy it again, or repair it with `ros2 bag reindex` or `mcap recover`"
        if self._is_ros1:
            remedy = "copy it again, or repair it with `rosbag reindex`"
        return InputError(self.path, f"can't be read, it may be cut short ({_short(error)})", remedy)


def _files(path: Path) -> list[Path]:
    """List the files for rosbags, which takes a ROS 2 folder whose name ends in `.bag` for a ROS 1 file."""
    if path.is_dir() and path.suffix == ".bag":
        return sorted(file for file in path.iterdir() if file.suffix in (".mcap", ".db3"))
    return [path]


def _expect_own_files(path: Path) -> None:
    """Refuse a metadata.yaml that names files outside its folder, and links that lead out of it."""
    described = path / "metadata.yaml"
    if not path.is_dir() or not described.exists():
        return
    about = read_document(described).values.get("rosbag2_bagfile_information")
    names = about.get("relative_file_paths") if isinstance(about, dict) else None
    for name in names if isinstance(names, list) else ():
        expect_inner_name(str(name), described, "relative_file_paths")
        if leads_outside(path / str(name), path):
            raise InputError(path / str(name), "is a link out of the bag", "copy the file into the folder")
        open_regular(path / str(name), "copy the bag again").close()


def _expect_whole_database(paths: list[Path]) -> None:
    """Refuse a truncated database: SQLite reads a file without its last pages silently until one is needed.

    Its header states the page size (byte 16) and the number of pages (byte 28) [SQLite file format 1.3].
    """
    files = [file for path in paths for file in (path.glob("*.db3") if path.is_dir() else [path])]
    for file in files:
        if file.suffix != ".db3":
            continue
        with open_regular(file) as stream:
            header = stream.read(100)
        if len(header) < 100:
            continue
        page, pages = (struct.unpack_from(kind, header, at)[0] for kind, at in ((">H", 16), (">I", 28)))
        if file.stat().st_size < (65536 if page == 1 else page) * pages:
            raise InputError(
                file, "can't be read, it is cut short", "copy it again, or repair it with `ros2 bag reindex`"
            )


def _short(error: Exception) -> str:
    text = " ".join(str(error).split()) or type(error).__name__
    return text.rstrip(".")[:160]
