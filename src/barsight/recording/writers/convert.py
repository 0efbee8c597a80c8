"""Convert a recording to another format, without loss and with at most one picture in memory at a time.

Stored pictures are copied byte for byte, stamps as integers, the slow sensors' numbers as float64, and the
rig so that it reads back bit for bit; a round trip yields the same recording. Missing pictures and damaged
messages are left out and counted.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from barsight.core.errors import InputError, OutputError
from barsight.core.files import atomic_directory, lies_within
from barsight.core.records.pairs import RefusedFrame
from barsight.recording.stored_images import StoredPictures
from barsight.recording.writers.bag import BAG_FLAVOURS, write_bag
from barsight.recording.writers.euroc import write_euroc

REMEDY = "record gray, colour (rgb8, bgr8), Bayer or compressed pictures"
Target = Literal["euroc", "ros2-mcap", "ros2-sqlite3", "ros1"]


@dataclass(frozen=True)
class ConversionReport:
    """out: the folder written. images: pictures copied. left_out: pictures listed but missing or damaged."""

    out: Path
    images: int
    left_out: int


def convert(
    recording: StoredPictures,
    out: Path,
    target: Target,
    progress: Callable[[int, int], None] | None = None,
) -> ConversionReport:
    """Write `recording` into the folder `out` in another format, completely or not at all.

    progress: called with the number of pictures done and in total. Ground truth stored with the recording is
    copied, but never read. Raises `InputError` if something can't be read, `OutputError` if something can't
    be written or if `out` is inside the recording.
    """
    if lies_within(out, recording.path):
        raise OutputError(f"{out}: lies in the recording itself; name a folder elsewhere")
    pairs = recording.camera_stamps
    total = pairs.left_ns.size + pairs.right_ns.size
    report = progress or _silent
    with atomic_directory(out) as staging:
        if target == "euroc":
            written = write_euroc(recording, staging, lambda done: report(done, total))
        else:
            flavour = BAG_FLAVOURS[target]
            written = write_bag(recording, staging, out.name, flavour, lambda done: report(done, total))
        if written == 0:
            raise InputError(
                recording.path, f"none of its pictures can be read: {_reason(recording)}", REMEDY
            )
    return ConversionReport(out, written, total - written)


def _reason(recording: StoredPictures) -> str:
    first = next(iter(recording.frames()), None)
    return first.reason if isinstance(first, RefusedFrame) else "it has none"


def _silent(done: int, total: int) -> None:
    return None
