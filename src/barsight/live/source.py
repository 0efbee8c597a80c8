"""Replay a recording at its own pace, as a `Source`."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from barsight.core.arrays import Float64, Int64
from barsight.core.records.gray_levels import TornImageError
from barsight.core.stamps import BEFORE_ALL_NS, NS_PER_S
from barsight.recording.pairing import decode_for
from barsight.recording.stored_images import StoredImage, StoredPictures
from barsight.sensors.source import LivePicture, LostPicture, Readings

BATCH_NS = 10_000_000
"""Time span in ns of a batch of readings."""
USUAL_PERCENT = 95
AHEAD_NS = NS_PER_S // 5
"""Lead in ns of readings over pictures at full speed: more than any pose waits for."""


@dataclass(frozen=True)
class ReplayClock:
    """Relates stamps to the monotonic clock.

    began_ns: monotonic time of the stamp `first_ns`. speed: recorded seconds per second; 0: as fast as
    possible, when a stamp is due as soon as it is requested.
    """

    began_ns: int
    first_ns: int
    speed: float

    def due_ns(self, stamp_ns: int) -> int:
        """Return the monotonic time at which a stamp is due."""
        if self.speed == 0:
            return time.monotonic_ns()
        return self.began_ns + round((stamp_ns - self.first_ns) / self.speed)

    def stamp_now_ns(self) -> int | None:
        """Return the stamp that is due now; None at full speed, where there is no such stamp."""
        if self.speed == 0:
            return None
        return self.first_ns + round((time.monotonic_ns() - self.began_ns) * self.speed)


class ReplaySource:
    """`Source` of a recording. It ends with the pictures: readings after them are delivered at once.

    may_go_on: called before each picture and while waiting; the source ends if it returns False. A restarted
    capture finds all readings, as a driver would have kept them, but the pictures due meanwhile are lost.
    """

    def __init__(self, recording: StoredPictures, clock: ReplayClock, may_go_on: Callable[[], bool]) -> None:
        self._recording, self._clock, self._may_go_on = recording, clock, may_go_on
        imu, crane = recording.imu(), recording.crane()
        self._readings: dict[str, tuple[Int64, Float64]] = {}
        if imu is not None:
            self._readings["imu"] = imu.stamp_ns, np.hstack([imu.gyro_radps, imu.accel_mps2])
        if crane is not None:
            self._readings["crane"] = crane.stamp_ns, crane.position_m
        self._shift_ns = recording.rig.timeshift_cam_imu_ns

    @property
    def interval_ns(self) -> int:
        """Return the 95th percentile of cam0's picture intervals, as a recording may have gaps."""
        stamps = self._recording.camera_stamps.left_ns
        return int(np.percentile(np.diff(stamps), USUAL_PERCENT)) if len(stamps) > 1 else 0

    def packets(self, after: dict[str, int]) -> Iterator[LivePicture | LostPicture | Readings]:
        """Yield packets when they are due; see `Source.packets`."""
        resumed_ns = self._clock.stamp_now_ns() if any(after.values()) else None
        after = {sensor: last_ns or BEFORE_ALL_NS for sensor, last_ns in after.items()}
        given = {
            sensor: int(np.searchsorted(stamps, after[sensor], side="right"))
            for sensor, (stamps, _) in self._readings.items()
        }
        for stored in self._recording.stored_images():
            if stored.stamp_ns <= after[f"cam{stored.camera}"]:
                continue
            if resumed_ns is not None and stored.stamp_ns < resumed_ns:
                yield LostPicture(stored.camera, stored.stamp_ns, "capture_down")
                continue
            found = self._decoded(stored)
            yield from self._until(stored.stamp_ns, given)
            if not self._may_go_on():
                return
            yield found
        yield from self._given(given, None)

    def _until(self, stamp_ns: int, given: dict[str, int]) -> Iterator[Readings]:
        """Yield the readings that are due before a picture, and wait for its time."""
        if self._clock.speed == 0:
            yield from self._given(given, stamp_ns + self._shift_ns + AHEAD_NS)
            return
        while self._may_go_on():
            now_ns = self._clock.stamp_now_ns()
            assert now_ns is not None
            yield from self._given(given, now_ns + self._shift_ns)
            if now_ns >= stamp_ns:
                return
            time.sleep(min(stamp_ns - now_ns, BATCH_NS * self._clock.speed) / self._clock.speed / NS_PER_S)

    def _given(self, given: dict[str, int], until_ns: int | None) -> Iterator[Readings]:
        for sensor, (stamps, values) in self._readings.items():
            first = given[sensor]
            end = len(stamps) if until_ns is None else int(np.searchsorted(stamps, until_ns, side="right"))
            if end > first:
                given[sensor] = end
                yield Readings(sensor, stamps[first:end], values[first:end])

    def _decoded(self, stored: StoredImage) -> LivePicture | LostPicture:
        rig = self._recording.rig
        try:
            image = decode_for((rig.cam0, rig.cam1)[stored.camera], stored.data)
        except TornImageError:
            return LostPicture(stored.camera, stored.stamp_ns, "torn")
        return LivePicture(stored.camera, stored.stamp_ns, self._clock.due_ns(stored.stamp_ns), image)
