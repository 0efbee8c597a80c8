"""Read the MCAP segments that a live run records, up to the point where a kill cut off the last one.

A segment is an MCAP file without chunks: each record is independent, so everything before a torn one is
intact [MCAP 1.0].
"""

from __future__ import annotations

import os
import struct
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from barsight.core.errors import InputError
from barsight.core.stamps import NS_PER_S
from barsight.recording.formats.bag_file import RawMessage, Topic, ros2_types

SEGMENTS = "segments"
PATTERN = "segment_*.mcap"
MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, DATA_END = 0x01, 0x02, 0x03, 0x04, 0x05, 0x0F
HEAD = struct.Struct("<BQ")
MESSAGE_HEAD = struct.Struct("<HIQQ")
MAX_RECORD = 1 << 30


@dataclass(frozen=True)
class Record:
    """A record of a segment. end: file offset of its end."""

    kind: int
    data: bytes
    end: int


def segments_of(folder: Path) -> list[Path]:
    """List a folder's segments in the order of writing."""
    return sorted(folder.glob(PATTERN))


def records(path: Path, max_bytes: int = MAX_RECORD) -> Iterator[Record]:
    """Yield a segment's records up to the footer or the first damaged one. Raises InputError if not MCAP.

    max_bytes: maximum number of bytes read of each record's data.
    """
    with path.open("rb") as stream:
        length = os.fstat(stream.fileno()).st_size
        magic = stream.read(len(MAGIC))
        if magic != MAGIC[: len(magic)]:
            raise InputError(path, "is not an MCAP file", "give the folder as the live run left it")
        end = len(MAGIC)
        while len(head := stream.read(HEAD.size)) == HEAD.size:
            kind, size = HEAD.unpack(head)
            end += HEAD.size + size
            wanted = min(size, max_bytes)
            if size > MAX_RECORD or end > length or len(data := stream.read(wanted)) < wanted:
                return
            stream.seek(end)
            yield Record(kind, data, end)
            if kind == FOOTER:
                return


def text_at(data: bytes, place: int) -> tuple[str, int]:
    """Read a text of a record; return it and the position after it."""
    (size,) = struct.unpack_from("<I", data, place)
    return data[place + 4 : place + 4 + size].decode(), place + 4 + size


def channel_of(data: bytes, schemas: dict[int, str]) -> tuple[int, str, str]:
    """Read a channel: its number, topic and message type."""
    number, schema = struct.unpack_from("<HH", data)
    return number, text_at(data, 4)[0], schemas[schema]


class SegmentFile:
    """Streams the messages of a folder of segments, as `BagFile` does for a bag."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._typestore = ros2_types()
        counts: dict[tuple[str, str], int] = {}
        for topic, kind, _ in self._walk():
            counts[topic, kind] = counts.get((topic, kind), 0) + 1
        self.topics = tuple(Topic(name, kind, count) for (name, kind), count in sorted(counts.items()))

    def messages(self, names: Collection[str]) -> Iterator[RawMessage]:
        """Yield the messages of these topics in the order of writing."""
        for topic, kind, data in self._walk():
            if topic in names:
                seconds, rest = struct.unpack_from("<II", data, 4)
                yield RawMessage(topic, kind, seconds * NS_PER_S + rest, data)

    def decode(self, message: RawMessage) -> Any:
        """Decode the message. Raises ValueError if it is damaged."""
        try:
            return self._typestore.deserialize_cdr(message.data, message.kind)
        except MemoryError:
            raise
        except Exception as error:
            raise ValueError(f"is a torn message ({' '.join(str(error).split())[:160]})") from error

    def _walk(self) -> Iterator[tuple[str, str, bytes]]:
        for path in segments_of(self.path):
            schemas: dict[int, str] = {}
            channels: dict[int, tuple[str, str]] = {}
            try:
                for record in records(path):
                    if record.kind == SCHEMA:
                        schemas[struct.unpack_from("<H", record.data)[0]] = text_at(record.data, 2)[0]
                    elif record.kind == CHANNEL:
                        number, topic, kind = channel_of(record.data, schemas)
                        channels[number] = topic, kind
                    elif record.kind == MESSAGE:
                        topic, kind = channels[struct.unpack_from("<H", record.data)[0]]
                        yield topic, kind, record.data[MESSAGE_HEAD.size :]
            except (KeyError, struct.error, UnicodeDecodeError) as error:
                raise InputError(path, f"is damaged ({error})", "copy it again") from error
