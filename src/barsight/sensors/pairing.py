"""Form pairs of pictures as they arrive, by stamp and, if the cameras count it, by trigger."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field

from barsight.core.records.pairs import StereoFrame
from barsight.sensors.source import LivePicture

NEW_STEPS = 3


@dataclass(eq=False)
class PairFormer:
    """Pairs each picture with the other camera's picture nearest in time, at most `tolerance_ns` apart.

    If both carry a trigger number, the difference of the two numbers must stay constant: pictures for which
    it changes are dropped, until `NEW_STEPS` in succession agree on another difference. lost: unpaired
    pictures of cam0 and cam1. contradicted: pictures whose stamps and numbers contradict each other. skew_ns:
    cam1's stamp minus cam0's in the last pair; max_skew_ns: its largest magnitude.
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
        """Add the next picture in time order; yield pairs that are certain, each with its exposure
        (monotonic, ns).
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
        """Count the pictures still waiting as lost."""
        for camera in (0, 1):
            while self._waiting[camera]:
                self._drop(camera)

    def _triggers_agree(self, left: LivePicture, right: LivePicture) -> bool:
        """Check whether the difference of the trigger numbers is unchanged."""
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
