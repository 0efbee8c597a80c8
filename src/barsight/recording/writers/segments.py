"""Write a live run's recording as MCAP segments that stay readable after a kill."""

from __future__ import annotations

import os
import struct
from pathlib import Path
from typing import BinaryIO

from barsight.core.arrays import UInt8
from barsight.core.records.sensor_samples import CraneSamples, ImuSamples
from barsight.recording.formats.bag_file import IMAGE_TYPE, IMU_TYPE, POINT_TYPE
from barsight.recording.formats.bag_setup import CRANE_TOPIC
from barsight.recording.formats.segments import (
    CHANNEL,
    DATA_END,
    FOOTER,
    HEAD,
    HEADER,
    MAGIC,
    MESSAGE,
    MESSAGE_HEAD,
    SCHEMA,
    records,
    segments_of,
)
from barsight.recording.writers.bag import CAMERA_TOPICS, IMU_TOPIC, BagMessages, Item

KINDS = {
    CAMERA_TOPICS[0]: IMAGE_TYPE,
    CAMERA_TOPICS[1]: IMAGE_TYPE,
    IMU_TOPIC: IMU_TYPE,
    CRANE_TOPIC: POINT_TYPE,
}
"""Topics of a segment with their types; a channel's number is its position here plus one."""
SEGMENT_BYTES = 256 << 20
END = struct.pack("<BQI", DATA_END, 4, 0) + struct.pack("<BQQQI", FOOTER, 20, 0, 0, 0) + MAGIC


class SegmentWriter:
    """Appends messages to the last segment of a folder, and begins a new one when that is full.

    Each message is passed to the system at once: a killed writer loses at most the message that it was
    writing, which the next writer cuts off. last_ns: the last stamp written for each topic, 0 for none.
    bytes: number written by this writer.
    """

    def __init__(self, folder: Path, segment_bytes: int = SEGMENT_BYTES) -> None:
        self._folder, self._limit = folder, segment_bytes
        self._messages = BagMessages(ros1=False)
        self._channels = {topic: number for number, topic in enumerate(KINDS, 1)}
        self.last_ns = dict.fromkeys(KINDS, 0)
        self._stream: BinaryIO | None = None
        self._number, self._log_ns, self.bytes = 0, 0, 0
        folder.mkdir(parents=True, exist_ok=True)
        for path in reversed(segments_of(folder)):
            self._number = max(self._number, int(path.stem.rpartition("_")[2]))
            self._take_up(path)
            if all(self.last_ns.values()):
                break

    @property
    def last_pair_ns(self) -> int:
        """Return the stamp of the last complete pair, 0 before the first."""
        return min(self.last_ns[topic] for topic in CAMERA_TOPICS)

    def pair(self, stamp_ns: int, left: UInt8, right: UInt8) -> None:
        """Append a pair of pictures (H, W) of one exposure."""
        for camera, image in enumerate((left, right)):
            if stamp_ns > self.last_ns[CAMERA_TOPICS[camera]]:
                self._write(self._messages.picture(camera, stamp_ns, image))

    def samples(self, samples: ImuSamples | CraneSamples) -> None:
        """Append readings, except those already written."""
        made = self._messages
        items = made.imu(samples) if isinstance(samples, ImuSamples) else made.crane(samples)
        for item in items:
            if item[0] > self.last_ns[item[2]]:
                self._write(item)

    def sync(self) -> None:
        """Wait until everything is on the disk."""
        if self._stream is not None:
            os.fsync(self._stream.fileno())

    def close(self) -> None:
        """End the segment as MCAP requires."""
        if self._stream is not None:
            _append(self._stream, END)
            self.sync()
            self._stream.close()
            self._stream = None

    def _write(self, item: Item) -> None:
        stamp_ns, _, topic, kind, message = item
        if self._stream is not None and self._stream.tell() >= self._limit:
            self.close()
        stream = self._stream or self._begin()
        data = self._messages.serialize(message, kind)
        self._log_ns = max(self._log_ns, stamp_ns)  # readers need log times that don't go back
        head = MESSAGE_HEAD.pack(self._channels[topic], 0, self._log_ns, stamp_ns)
        self.bytes += _append(stream, b"".join((HEAD.pack(MESSAGE, len(head) + len(data)), head, data)))
        self.last_ns[topic] = stamp_ns

    def _begin(self) -> BinaryIO:
        self._number += 1
        self._stream = (self._folder / f"segment_{self._number:06d}.mcap").open("wb", buffering=0)
        parts = [MAGIC, _record(HEADER, _text("ros2") + _text("barsight"))]
        for number, (topic, kind) in enumerate(KINDS.items(), 1):
            definition, _ = self._messages.typestore.generate_msgdef(kind, ros_version=2)
            schema = struct.pack("<H", number) + _text(kind) + _text("ros2msg") + _text(definition)
            channel = struct.pack("<HH", number, number) + _text(topic) + _text("cdr")
            about = _text("offered_qos_profiles") + _text("")
            parts.append(_record(SCHEMA, schema))
            parts.append(_record(CHANNEL, channel + struct.pack("<I", len(about)) + about))
        _append(self._stream, b"".join(parts))
        return self._stream

    def _take_up(self, path: Path) -> None:
        """Read an earlier writer's progress, and end a segment that it did not end.

        Only the messages' heads are read: a shift's tens of GB would take minutes.
        """
        topics, end, is_ended = list(KINDS), 0, False
        for record in records(path, MESSAGE_HEAD.size):
            if record.kind == MESSAGE:
                channel, _, log_ns, stamp_ns = MESSAGE_HEAD.unpack_from(record.data)
                topic = topics[channel - 1]
                self._log_ns = max(self._log_ns, log_ns)
                self.last_ns[topic] = max(self.last_ns[topic], stamp_ns)
            is_ended = record.kind == FOOTER
            if record.kind not in (FOOTER, DATA_END):
                end = record.end
        if end == 0:
            path.unlink()
        elif not is_ended:
            with path.open("r+b") as stream:
                stream.truncate(end)
                stream.seek(end)
                stream.write(END)


def _append(stream: BinaryIO, data: bytes) -> int:
    """Write all of it, or nothing and raise OSError: near a full disk the system takes a part and says so."""
    begin, left = stream.tell(), memoryview(data)
    try:
        while left:
            left = left[stream.write(left) :]
    except OSError:
        stream.seek(begin)
        stream.truncate()
        raise
    return len(data)


def _text(text: str) -> bytes:
    data = text.encode()
    return struct.pack("<I", len(data)) + data


def _record(kind: int, data: bytes) -> bytes:
    return HEAD.pack(kind, len(data)) + data
