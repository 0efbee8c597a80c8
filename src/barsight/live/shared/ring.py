"""Pass pairs from one process to others through a ring in shared memory whose writer never waits."""

from __future__ import annotations

from dataclasses import dataclass
from multiprocessing.shared_memory import SharedMemory

import numpy as np

from barsight.core.arrays import Int64, UInt8
from barsight.core.records.pairs import StereoFrame

_VERSION, _STAMP, _EXPOSED = range(3)


@dataclass(frozen=True, eq=False)
class CapturedPair:
    """A pair from the ring. number: 1, 2, ... in the order of writing. exposed_ns: on the monotonic clock."""

    number: int
    exposed_ns: int
    frame: StereoFrame


class PairRing:
    """The last `slots` pairs of (height, width) pictures; one process writes, any may read.

    A slot's version is 2 number - 1 while pair `number` is being written and 2 number after it, so a reader
    sees whether its copy is complete, and a killed writer leaves nothing that looks complete.
    name: of an existing ring; without it a new one is made, whose maker unlinks it by `remove`.
    """

    def __init__(self, slots: int, height: int, width: int, name: str | None = None) -> None:
        heads, pixels = slots * 3 * 8, slots * 2 * height * width
        self._memory = SharedMemory(name, create=name is None, size=heads + pixels)
        self.name = self._memory.name
        self._heads: Int64 = np.ndarray((slots, 3), np.int64, self._memory.buf)
        self._pictures: UInt8 = np.ndarray((slots, 2, height, width), np.uint8, self._memory.buf, heads)
        if name is None:
            self._heads[:] = 0

    @property
    def newest(self) -> int:
        """Return the number of the newest complete pair, 0 before the first."""
        versions = self._heads[:, _VERSION].copy()
        return int(versions[versions % 2 == 0].max(initial=0)) // 2

    def write(self, frame: StereoFrame, exposed_ns: int) -> int:
        """Write a pair over the oldest and return its number."""
        number = int(self._heads[:, _VERSION].max() + 1) // 2 + 1
        head, picture = self._heads[number % len(self._heads)], self._pictures[number % len(self._heads)]
        head[_VERSION] = 2 * number - 1
        picture[0], picture[1] = frame.left, frame.right
        head[_STAMP], head[_EXPOSED] = frame.stamp_ns, exposed_ns
        head[_VERSION] = 2 * number
        return number

    def read(self, number: int) -> CapturedPair | None:
        """Copy a pair; None if it has been overwritten or is incomplete."""
        slot = number % len(self._heads)
        _, stamp_ns, exposed_ns = self._heads[slot].tolist()
        left, right = self._pictures[slot].copy()
        if self._heads[slot, _VERSION] != 2 * number:
            return None
        return CapturedPair(number, exposed_ns, StereoFrame(stamp_ns, left, right))

    def remove(self) -> None:
        """Unlink the memory; only its maker may call this."""
        self.close()
        self._memory.unlink()

    def close(self) -> None:
        """Detach from the memory."""
        self._heads, self._pictures = np.empty((0, 3), np.int64), np.empty((0, 2, 0, 0), np.uint8)
        self._memory.close()
