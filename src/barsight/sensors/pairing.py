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
    it changes are dropped, until `NEW_STEPS` in succession agree on another difference after a camera counted
    anew, missed an exposure that it didn't count, or counted one that it didn't take. Without these, a clock
    ran away from the other one by an interval, and the stamps are those of neighbours. lost: unpaired
    pictures of cam0 and cam1.
    contradicted: pictures whose stamps and numbers contradict each other. skew_ns: cam1's stamp minus cam0's
    in the last pair; max_skew_ns: its largest magnitude.
    """

    tolerance_ns: int
    lost: list[int] = field(default_factory=lambda: [0, 0])
    contradicted: int = 0
    skew_ns: int = 0
    max_skew_ns: int = 0
    _step: int | None = None
    _new_step: tuple[int, int] = (0, 0)
    _may_change: bool = False
    _last: list[tuple[int, int] | None] = field(default_factory=lambda: [None, None])
    _exposure_ns: list[float] = field(default_factory=lambda: [0.0, 0.0])
    _waiting: tuple[deque[LivePicture], deque[LivePicture]] = field(
        default_factory=lambda: (deque(), deque())
    )

    def push(self, picture: LivePicture) -> Iterator[tuple[StereoFrame, int]]:
        """Add the next picture in time order; yield pairs that are certain, each with its exposure
        (monotonic, ns).
        """
        self._count(picture)
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
        if self._step is not None and step != self._step:
            count = self._new_step[1] + 1 if self._new_step[0] == step else 1
            self._new_step = step, count
            if count < NEW_STEPS or not self._may_change:
                return False
        self._step, self._new_step, self._may_change = step, (0, 0), False
        return True

    def _count(self, picture: LivePicture) -> None:
        """Note whether a camera counted anew, took half an interval more than it has exposures, or whole ones
        less.
        """
        camera, last = picture.camera, self._last[picture.camera]
        if picture.trigger is None:
            return
        self._last[camera] = picture.trigger, picture.stamp_ns
        if last is None:
            return
        exposures, took_ns = picture.trigger - last[0], picture.stamp_ns - last[1]
        if exposures <= 0:
            self._may_change = True
            return
        exposure_ns = self._exposure_ns[camera]
        more_ns = took_ns - exposures * exposure_ns
        is_whole = abs(more_ns - round(more_ns / max(exposure_ns, 1)) * exposure_ns) < self.tolerance_ns
        self._may_change |= more_ns > exposure_ns / 2 or (more_ns < -exposure_ns / 2 and is_whole)
        self._exposure_ns[camera] = took_ns / exposures

    def _drop(self, camera: int) -> None:
        self._waiting[camera].popleft()
        self.lost[camera] += 1
