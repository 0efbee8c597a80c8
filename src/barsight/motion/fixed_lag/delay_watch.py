"""Watch the encoders' delay while the crane travels, to find a long one as soon as it shows."""

from __future__ import annotations

from barsight.core.stamps import NS_PER_S, seconds_to_ns
from barsight.motion.crane.encoder_delay import LATE_S, PART_S, DelaySearch
from barsight.motion.fixed_lag.sensor_buffer import SensorBuffer

STEP_S = 2.0
"""Interval, s, between the beginnings of the parts that are examined."""


class DelayWatch:
    """Delay of the encoders' stamps so far. late_ns: 0 until one is found, at `found_ns`; from then on it is
    taken off. search: what has been examined.
    """

    def __init__(self) -> None:
        self.late_ns = 0
        self.search = DelaySearch()
        self._next_ns, self.found_ns = 0, 0

    def check(self, now: SensorBuffer) -> bool:
        """Examine the readings that have come; return whether they show a delay that wasn't known before."""
        crane, imu = now.crane, now.imu
        if self.late_ns or not (crane and len(crane.stamp_ns) and imu and len(imu.stamp_ns)):
            return False
        spare, part = seconds_to_ns(float(LATE_S[-1])), seconds_to_ns(PART_S)
        last_ns = min(int(crane.stamp_ns[-1]), int(imu.stamp_ns[-1]) - spare)
        begin = max(self._next_ns, int(crane.stamp_ns[0]), int(imu.stamp_ns[0]) + spare)
        while begin + part <= last_ns:
            self.search.add(crane, imu, begin)
            begin = self._next_ns = begin + seconds_to_ns(STEP_S)
        self.late_ns = seconds_to_ns(self.search.late_s)
        self.found_ns = max(int(crane.stamp_ns[-1]), int(imu.stamp_ns[-1]))
        return self.late_ns != 0

    def sentences(self, begin_ns: int) -> tuple[str, ...]:
        """Describe the delay, with times in seconds since `begin_ns`."""
        if not self.late_ns:
            return self.search.doubts
        off_ms, found_s = round(1e3 * self.late_ns / NS_PER_S), (self.found_ns - begin_ns) / NS_PER_S
        off = f"{abs(off_ms)} ms {'late' if off_ms > 0 else 'early'}"
        return (
            f"the encoders are {off}, which showed at {found_s:.1f} s; it is taken off from then on, and "
            "poses before are off by it (correct the encoders' stamps)",
        )
