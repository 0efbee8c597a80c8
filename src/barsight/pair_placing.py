"""Place pairs one after the other, each once for all runs that keep checkpoints in one folder."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np

from barsight.checkpoint import checkpointed, sensor_readings, trajectory_name
from barsight.core.types import PosedFrame, RectifiedPair, RefusedFrame, Trajectory
from barsight.motion.estimator import PoseEstimator, TrajectoryEstimator
from barsight.recording.rectified_pairs import RectifiedPairs


class PairPlacer:
    """Places pairs with an estimator whose poses are final at once.

    A pose lies in `checkpoints` by the frames and readings that it rests on. One that lies there needs no
    pictures, unless `reads` is False or a later one is missing: then those before it are followed again.
    poses: the estimator, as far as it came. Raises MeasurementError where nothing places the body.
    """

    def __init__(
        self, pairs: RectifiedPairs, estimator: TrajectoryEstimator, checkpoints: Path | None, *,
        reads: bool = True,
    ) -> None:  # fmt: skip
        self._pairs, self._checkpoints, self._reads = pairs, checkpoints, reads
        self.poses: PoseEstimator = estimator.begin(pairs.recording, pairs.rectifier)
        self._known: list[tuple[int, tuple[int, ...]]] = []
        self._unfollowed: list[int | RefusedFrame] = []
        self._key = hashlib.sha256()

    def push(self, pair: RectifiedPair | RefusedFrame) -> PosedFrame | RefusedFrame | None:
        """Return the next pair's pose, or why it has none; None where only the end can tell."""
        before = self._known[-1][1] if self._known else None
        now = self._counts(pair.stamp_ns)
        self._known.append((pair.stamp_ns, now))
        if self._checkpoints is None:
            return self.poses.push(pair)
        self._key.update(f"{pair.stamp_ns} {isinstance(pair, RefusedFrame)} {now}".encode())
        readings = sensor_readings(self._pairs.recording)
        for number, (values, count) in enumerate(zip(readings, now, strict=True)):
            first = 0 if before is None or len(before) != len(now) else before[number]
            for one in values:
                self._key.update(np.ascontiguousarray(one[first:count]).tobytes())
        name = f"placed_{pair.stamp_ns}_{self._key.hexdigest()[:32]}"
        if not self._reads:
            posed = self.poses.push(pair)
            return checkpointed(self._checkpoints, name, lambda: posed)
        self._unfollowed.append(pair if isinstance(pair, RefusedFrame) else pair.stamp_ns)
        return checkpointed(self._checkpoints, name, self._follow)

    def finish(self) -> Trajectory | None:
        """Return all poses, which then lie in the checkpoints; None where measuring the recording now would
        use other frames or readings than those that came in time.

        Raises InputError where the pictures contradict a sensor.
        """
        recording = self._pairs.recording
        stamps = [stamp_ns for stamp_ns, _ in self._known]
        if stamps != list(recording.index.stamps_ns):
            return None
        if any(self._counts(stamp_ns) != known for stamp_ns, known in self._known):
            return None

        def finish() -> Trajectory:
            self._follow()
            return self.poses.finish()

        return checkpointed(self._checkpoints, trajectory_name(recording, self.poses.delay_ns), finish)

    def _follow(self) -> PosedFrame | RefusedFrame | None:
        """Estimate the poses that weren't yet; return the last one."""
        posed = None
        for seen in self._unfollowed:
            (pair,) = (seen,) if isinstance(seen, RefusedFrame) else self._pairs(frozenset((seen,)))
            posed = self.poses.push(pair)
        self._unfollowed.clear()
        return posed

    def _counts(self, stamp_ns: int) -> tuple[int, ...]:
        """Count the readings of each sensor that have come of those that a frame needs."""
        due_ns = stamp_ns + self._pairs.recording.rig.timeshift_cam_imu_ns + (self.poses.delay_ns or 0)
        readings = sensor_readings(self._pairs.recording)
        return tuple(int(np.searchsorted(stamps, due_ns, side="right")) for stamps, *_ in readings)
