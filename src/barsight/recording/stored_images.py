"""Define access to pictures as stored, for copying a recording without decoding."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, TypeVar, runtime_checkable

from barsight.recording.base import Recording
from barsight.recording.pairing import PairedStamps

T = TypeVar("T")


@dataclass(frozen=True)
class StoredImage:
    """One picture's bytes. camera: 0 or 1. kind: `png`, `jpg`, ..., as a file's suffix."""

    camera: int
    stamp_ns: int
    kind: str
    data: bytes


class StoredPictures(Recording, Protocol):
    """Protocol of a recording that provides its pictures undecoded: all of Barsight's readers."""

    @property
    def camera_stamps(self) -> PairedStamps:
        """Return all pictures' stamps, paired or not."""
        ...

    def stored_images(self) -> Iterator[StoredImage]:
        """Yield every picture's bytes as stored, both cameras in time order."""
        ...


@runtime_checkable
class NamedPictures(Protocol):
    """Protocol of a recording whose pictures are files that a list names."""

    def absent(self) -> tuple[Path, ...]:
        """List the named pictures that are not there, relative to the root; their pairs will be refused."""
        ...


def merge_cameras(pairs: PairedStamps, left: Sequence[T], right: Sequence[T]) -> Iterator[tuple[int, int, T]]:
    """Merge (camera, stamp, item) of both cameras in time order, cam0 first for equal stamps."""
    both = [(int(stamp), 0, k) for k, stamp in enumerate(pairs.left_ns)]
    both += [(int(stamp), 1, k) for k, stamp in enumerate(pairs.right_ns)]
    for stamp, camera, k in sorted(both):
        yield camera, stamp, (left if camera == 0 else right)[k]
