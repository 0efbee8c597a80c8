"""Form pairs of pictures as they come, by stamp and, where cameras count it, by trigger."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field

from barsight.core.records.pairs import StereoFrame
from barsight.sensors.source import LivePicture

NEW_STEPS = 3


@dataclass(eq=False)
class PairFormer:
    """Pairs each picture with the other camera's whose stamp is nearest, no further off than `tolerance_ns`.

    Where both carry a trigger's number, the difference of the two numbers must stay as it was: pictures of
    which it does not are dropped, until `NEW_STEPS` in turn agree on another difference. lost: pictures of
    cam0 and cam1 that found no partner. contradicted: pictures whose stamps and numbers contradict each
    other. skew_ns: cam1's stamp minus cam0's of the last pair; max_skew_ns: its largest size.
    """

    tolerance_ns: int
    lost: list[int] = field(default_factory=lambda: [0, 0])
    contradicted: int = 0
    skew_ns: int = 0
    max_skew_ns: int = 0
    _step: int | None = None
    _new_step: tuple[int, int] = (0, 0)
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
            if not self._triggers_agree(left, right):
                self.contradicted += 2
                continue
            self.skew_ns = -apart
            self.max_skew_ns = max(self.max_skew_ns, abs(apart))
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

    def _triggers_agree(self, left: LivePicture, right: LivePicture) -> bool:
        """Check whether the numbers of both triggers are as far apart as before."""
        if left.trigger is None or right.trigger is None:
            return True
        step = left.trigger - right.trigger
        if self._step is None or step == self._step:
            self._step, self._new_step = step, (0, 0)
            return True
        count = self._new_step[1] + 1 if self._new_step[0] == step else 1
        self._new_step = step, count
        if count < NEW_STEPS:
            return False
        self._step = step
        return True

    def _drop(self, camera: int) -> None:
        self._waiting[camera].popleft()
        self.lost[camera] += 1
