"""Read the rectified pairs of a recording, each picture decoded and rectified once."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterator
from dataclasses import dataclass
from pathlib import Path
from threading import Lock

import numpy as np

from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.errors import Failed
from barsight.core.files import atomic_path
from barsight.core.records.pairs import RectifiedPair, RefusedFrame, StereoFrame
from barsight.core.timing import Stopwatch
from barsight.recording.base import Recording

MAX_STORED_BYTES = 8 << 30
"""Capacity of the folder in bytes; pairs beyond it are decoded again when they are requested again."""


class RectifiedPairs:
    """Reads rectified pairs; `folder` stores their pixels, so that a second reader gets them from there.

    Without a folder a pair is decoded at each request. Several threads may read at once.
    """

    def __init__(
        self, recording: Recording, rectifier: Rectifier, folder: Path | None = None,
        watch: Stopwatch | None = None,
    ) -> None:  # fmt: skip
        self.recording, self.rectifier = recording, rectifier
        self._folder, self._watch, self._bytes = folder, watch or Stopwatch(), 0
        self._lock, self._turns = Lock(), dict[int, Lock]()

    def __call__(self, wanted: Container[int] | None = None) -> Iterator[RectifiedPair | RefusedFrame]:
        """Yield the pairs in time order; a frame that can't be decoded or rectified is refused.

        wanted: the stamps of those to read; all, if None.
        """
        fresh = self.recording.frames(_Missing(self, wanted))
        ahead: StereoFrame | RefusedFrame | None = None
        for stamp in self.recording.index.stamps_ns:
            if wanted is not None and stamp not in wanted:
                continue
            if ahead is None and not self.has(stamp):
                ahead = next(fresh, None)
            if ahead is None or ahead.stamp_ns != stamp:
                # Another reader was faster.
                yield self._read(stamp)
                continue
            frame, ahead = ahead, None
            yield frame if isinstance(frame, RefusedFrame) else self.rectify(frame)

    def reader(self) -> Callable[[int], RectifiedPair | RefusedFrame]:
        """Return a function that reads the pair of a stamp, later ones at each call; unlike a new iterator
        for each, it reads a bag once.
        """
        wanted = set[int]()
        fresh = self.recording.frames(wanted)

        def read(stamp_ns: int) -> RectifiedPair | RefusedFrame:
            if self.has(stamp_ns):
                return self._read(stamp_ns)
            wanted.clear()
            wanted.add(stamp_ns)
            frame = next(fresh, None)
            if frame is None or frame.stamp_ns != stamp_ns:
                return next(self({stamp_ns}))
            return frame if isinstance(frame, RefusedFrame) else self.rectify(frame)

        return read

    def rectify(self, frame: StereoFrame) -> RectifiedPair | RefusedFrame:
        """Rectify a frame once for all threads, and store it for later requests."""
        with self._turns.setdefault(frame.stamp_ns, Lock()):
            if self.has(frame.stamp_ns):
                return self._read(frame.stamp_ns)
            with self._watch("rectify", 1):
                pair = self.rectifier(frame)
            if isinstance(pair, Failed):
                return RefusedFrame(frame.stamp_ns, pair.reason)
            self.store(pair)
            return pair

    def store(self, pair: RectifiedPair) -> None:
        """Store a pair for later requests."""
        with self._lock:
            if self._folder is not None and self._bytes < MAX_STORED_BYTES:
                self._bytes += pair.left.nbytes + pair.right.nbytes
                with atomic_path(self._file(pair.stamp_ns)) as path, path.open("wb") as stream:
                    np.save(stream, np.stack([pair.left, pair.right]))

    def has(self, stamp_ns: int) -> bool:
        """Check whether a pair is in the folder."""
        return self._folder is not None and self._file(stamp_ns).is_file()

    def _read(self, stamp_ns: int) -> RectifiedPair:
        left, right = np.load(self._file(stamp_ns))
        return self.rectifier.pair(stamp_ns, left, right)

    def _file(self, stamp_ns: int) -> Path:
        assert self._folder is not None
        return self._folder / f"rectified_{stamp_ns}.npy"


@dataclass(frozen=True)
class _Missing:
    """The wanted stamps that aren't stored at the time of the query."""

    pairs: RectifiedPairs
    wanted: Container[int] | None

    def __contains__(self, stamp_ns: object) -> bool:
        return (self.wanted is None or stamp_ns in self.wanted) and not (
            isinstance(stamp_ns, int) and self.pairs.has(stamp_ns)
        )
