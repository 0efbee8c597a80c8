"""Form pairs of pictures as they come, by stamp alone."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field

from barsight.core.types import StereoFrame
from barsight.live.source import LivePicture


@dataclass(eq=False)
class PairFormer:
    """Pairs each picture with the other camera's whose stamp is nearest, no further off than `tolerance_ns`.

    lost: pictures of cam0 and cam1 that found no partner.
    """

    tolerance_ns: int
    lost: list[int] = field(default_factory=lambda: [0, 0])
    _waiting: tuple[deque[LivePicture], deque[LivePicture]] = field(
        default_factory=lambda: (deque(), deque())
    )

    def push(self, picture: LivePicture) -> Iterator[tuple[StereoFrame, int]]:
        """Take the next picture in time's order; yield pairs that are certain, each with its exposure (ns,
        monotonic clock).
        """
        self._waiting[picture.camera].append(picture)
        lefts, rights = self._waiting
        while lefts and rights:
            left, right = lefts[0], rights[0]
            apart = left.stamp_ns - right.stamp_ns
            if abs(apart) > self.tolerance_ns:
                self._drop(1 if apart > 0 else 0)
                continue
            lefts.popleft()
            rights.popleft()
            exposed_ns = max(left.exposed_ns, right.exposed_ns)
            yield StereoFrame(left.stamp_ns, left.image, right.image), exposed_ns
        for camera in (0, 1):
            while (
                self._waiting[camera]
                and picture.stamp_ns - self._waiting[camera][0].stamp_ns > self.tolerance_ns
            ):
                self._drop(camera)

    def end(self) -> None:
        """Count what still waits as lost."""
        for camera in (0, 1):
            while self._waiting[camera]:
                self._drop(camera)

    def _drop(self, camera: int) -> None:
        self._waiting[camera].popleft()
        self.lost[camera] += 1
