"""Define the protocol of all pose estimators, and run one over a finished recording."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from typing import ClassVar, Protocol

from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.errors import Failed
from barsight.core.parallel import prefetch
from barsight.core.records.pairs import NamedPoints, RectifiedPair, RefusedFrame
from barsight.core.records.trajectory import PosedFrame, Trajectory
from barsight.recording.base import Recording
from barsight.recording.formats.board_corners import CornerRecording
from barsight.recording.rectified_pairs import RectifiedPairs

FrameInput = RectifiedPair | NamedPoints | RefusedFrame
"""A frame as an estimator receives it: its pictures, its named points, or only its stamp."""

UNPLACED = "no sensor places it"
"""Reason given for a frame whose pictures aren't read and that nothing else places."""


class PoseEstimator(Protocol):
    """Protocol: estimate the body's pose frame by frame; estimators differ in when a pose is final.

    reads_pictures: whether `push` needs the pictures; else frames come as `UNPLACED`. delay_ns: how much
    later than the frame itself the last readings that it needs are; None where it needs all.
    """

    @property
    def reads_pictures(self) -> bool: ...

    @property
    def delay_ns(self) -> int | None: ...

    def push(self, seen: FrameInput) -> PosedFrame | RefusedFrame | None:
        """Process the next frame in order of time. Return its final pose or why it has none; None where only
        `finish` can tell.
        """
        ...

    def finish(self) -> Trajectory:
        """Return all frames' poses. Raises MeasurementError where nothing places the body."""
        ...


class ImmediatePoses(ABC):
    """`PoseEstimator` whose poses are final at once; a subclass places one frame at a time.

    placed, refused: the frames so far.
    """

    reads_pictures: bool = True
    delay_ns: int | None = 0

    def __init__(self) -> None:
        self.placed: list[PosedFrame] = []
        self.refused: list[RefusedFrame] = []

    @abstractmethod
    def place(self, seen: FrameInput) -> PosedFrame | RefusedFrame | Failed:
        """Estimate the next frame's pose, or say why it has none."""

    @abstractmethod
    def finish(self) -> Trajectory:
        """Return all frames' poses."""

    def push(self, seen: FrameInput) -> PosedFrame | RefusedFrame:
        """Place the next frame; see `PoseEstimator.push`."""
        frame = self.place(seen)
        if isinstance(frame, PosedFrame):
            self.placed.append(frame)
            return frame
        self.refused.append(RefusedFrame(seen.stamp_ns, frame.reason))
        return self.refused[-1]


def pictures_of(seen: FrameInput) -> RectifiedPair | Failed:
    """Return a frame's pictures; Failed `no-pictures` where it has none."""
    if isinstance(seen, RectifiedPair):
        return seen
    return Failed("no-pictures", seen.reason if isinstance(seen, RefusedFrame) else "points without pictures")


class TrajectoryEstimator(ABC):
    """Settings of an estimator; `begin` makes the estimator for a recording.

    begins_early: whether no pose depends on readings later than the estimator's `delay_ns`, so that a
    recording that is still growing ends with the same poses. delay_ns: see `PoseEstimator`.
    """

    begins_early: ClassVar[bool] = False
    delay_ns: ClassVar[int | None] = None

    @abstractmethod
    def begin(self, recording: Recording, rectifier: Rectifier) -> PoseEstimator:
        """Begin at the recording's first frame. The recording's sensor readings may still grow."""

    def __call__(
        self, recording: Recording, rectifier: Rectifier, advance: Callable[[], None],
        pairs: RectifiedPairs | None = None,
    ) -> Trajectory:  # fmt: skip
        """Estimate a finished recording; `advance` is called once per frame.

        pairs: the recording's pictures, if others read them too.
        """
        poses = self.begin(recording, rectifier)
        for seen in _frames(recording, pairs or RectifiedPairs(recording, rectifier), poses.reads_pictures):
            advance()
            poses.push(seen)
        return poses.finish()


def _frames(recording: Recording, pairs: RectifiedPairs, reads_pictures: bool) -> Iterator[FrameInput]:
    if not reads_pictures:
        yield from (RefusedFrame(stamp, UNPLACED) for stamp in recording.index.stamps_ns)
    elif isinstance(recording, CornerRecording):
        yield from recording.points()
    else:
        yield from prefetch(pairs())
