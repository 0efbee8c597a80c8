"""Map a device's stamps to the host's monotonic clock by their arrival times, without querying the device."""

from __future__ import annotations

from collections import deque

import numpy as np

from barsight.core.stamps import NS_PER_S

BUCKET_NS = NS_PER_S
BUCKETS = 120
SETTLE_NS, SETTLE_COUNT = NS_PER_S, 3
DRIFT_AFTER_NS = 10 * NS_PER_S
"""Time span of stamps from which drift is estimated; over less, delays of a busy host would look like
drift.
"""
MAX_DRIFT = 2e-4
"""Largest drift. Quartz clocks agree within 1e-4: a steeper line results from a few late stamps."""
WILD_AFTER_NS = 60 * NS_PER_S
"""Time span of stamps over which a steeper line is the clock's own, not that of a few late stamps; and time
within which a clock that fell behind twice wasn't set, but drifts.
"""
EARLY_NS = 50_000_000
"""A clock has jumped if a stamp seems to arrive this much (ns) before it was made."""
LATE_NS, LATE_COUNT = NS_PER_S, 5
"""A clock has also jumped if this many successive stamps arrive this late (ns)."""
BEHIND_NS = 3 * NS_PER_S
"""A clock has also jumped if all stamps arrive `EARLY_NS` late for this long (ns): no host is busy that
long.
"""
OLDER_COUNT = 2
"""A clock has also jumped if this many successive stamps are older than the newest: one alone may be late.
`Sequence` leaves out readings that were overtaken, so that more come only of a driver that doesn't keep the
order. A false alarm costs about a second of readings, and the drift for ten.
"""
RECENT = 300


class DeviceClock:
    """Estimates offset and drift of a device's clock relative to the host's.

    A stamp s arrives at a = s + offset + drift s + delay with delay >= 0. The smallest delays hardly vary, so
    the line below all points (s, a - s) and closest to them in their middle gives offset and drift: it is an
    edge of the lower convex hull [Zhang, Liu, Xia 2002]. The smallest delay itself stays in the offset: it is
    constant, and the calibration of the camera against the IMU includes it.

    is_wild: whether it drifts by over `MAX_DRIFT`, as a clock does while it is slewed: stamps are wrong then.
    One that is so slow that it counts as jumped stays wild until that is over.
    """

    def __init__(self) -> None:
        self.jumps, self.is_wild = 0, False
        self._fell_behind_ns: int | None = None
        self.begin_anew()

    def begin_anew(self) -> None:
        """Forget all stamps so far: the device may have restarted."""
        self._minima: deque[tuple[int, int]] = deque(maxlen=BUCKETS)
        self._delays: deque[int] = deque(maxlen=RECENT)
        self._origin: tuple[int, int] | None = None
        self._count, self._late, self._bucket = 0, 0, -1
        self._behind, self._behind_ns = 0, 0
        self._newest_ns, self._older = 0, 0
        self._offset_ns, self._drift, self._steep = 0.0, 0.0, False

    def add(self, device_ns: int, arrival_ns: int) -> bool:
        """Add a stamp and its arrival time (monotonic); return whether the clock is settled."""
        if self._origin is not None and self._has_jumped(device_ns, arrival_ns):
            if self._behind >= LATE_COUNT:  # all stamps were late, as those of a clock that is slow are
                again = self._fell_behind_ns is not None and arrival_ns - self._fell_behind_ns < WILD_AFTER_NS
                self.is_wild |= self._steep or again
                self._fell_behind_ns = arrival_ns
            self.jumps += 1
            self.begin_anew()
        elif self._late:
            return True
        if self._origin is None:
            self._origin, self._newest_ns = (device_ns, arrival_ns - device_ns), device_ns
        since, apart = device_ns - self._origin[0], arrival_ns - device_ns - self._origin[1]
        self._count += 1
        bucket = since // BUCKET_NS
        if bucket != self._bucket or not self._minima:
            self._bucket = bucket
            self._minima.append((since, apart))
        elif apart >= self._minima[-1][1]:
            self._delays.append(arrival_ns - self.host_ns(device_ns))
            return self.is_settled
        else:
            self._minima[-1] = since, apart
        self._fit()
        self._delays.append(arrival_ns - self.host_ns(device_ns))
        return self.is_settled

    def _has_jumped(self, device_ns: int, arrival_ns: int) -> bool:
        """Add a stamp; return whether the clock has jumped since the stamps before."""
        # A stamp that comes again is neither older nor newer.
        self._older = 0 if device_ns > self._newest_ns else self._older + (device_ns < self._newest_ns)
        self._newest_ns = max(self._newest_ns, device_ns)
        if self._older >= OLDER_COUNT or not self.is_settled:
            return self._older >= OLDER_COUNT
        delay = arrival_ns - self.host_ns(device_ns)
        self._late = self._late + 1 if delay > LATE_NS else 0
        return delay < -EARLY_NS or self._late >= LATE_COUNT or self._is_behind(delay, arrival_ns)

    def _is_behind(self, delay_ns: int, arrival_ns: int) -> bool:
        """Add a stamp's delay; return whether all recent stamps were late."""
        self._behind = self._behind + 1 if delay_ns > EARLY_NS else 0
        if self._behind <= 1:
            self._behind_ns = arrival_ns
        return self._behind >= LATE_COUNT and arrival_ns - self._behind_ns > BEHIND_NS

    @property
    def is_settled(self) -> bool:
        """Check whether enough stamps have arrived since the beginning or the last jump."""
        if self._origin is None or not self._minima:
            return False
        return self._count >= SETTLE_COUNT and self._bucket * BUCKET_NS >= SETTLE_NS

    def host_ns(self, device_ns: int) -> int:
        """Convert a device's stamp to the host's monotonic clock."""
        assert self._origin is not None
        since = device_ns - self._origin[0]
        return device_ns + self._origin[1] + round(self._offset_ns + self._drift * since)

    @property
    def drift_ppb(self) -> int:
        """Return by how much the device's clock runs slower than the host's, in 1e-9."""
        return round(self._drift * 1e9)

    @property
    def jitter_ns(self) -> int:
        """Return the 99th percentile of the latest stamps' delays beyond the smallest one."""
        return round(float(np.percentile(self._delays, 99))) if self._delays else 0

    def _fit(self) -> None:
        """Fit the line below the smallest delays."""
        points = list(self._minima)
        if points[-1][0] - points[0][0] < DRIFT_AFTER_NS:
            self._drift, self._offset_ns = 0.0, float(min(apart for _, apart in points))
            return
        hull: list[tuple[int, int]] = []
        for point in points:
            while len(hull) > 1 and _turns_down(hull[-2], hull[-1], point):
                hull.pop()
            hull.append(point)
        middle = sum(since for since, _ in points) / len(points)
        right = next(k for k in range(1, len(hull)) if hull[k][0] >= middle or k == len(hull) - 1)
        (x0, y0), (x1, y1) = hull[right - 1], hull[right]
        slope = (y1 - y0) / (x1 - x0)
        self._steep = abs(slope) > MAX_DRIFT
        if points[-1][0] - points[0][0] >= WILD_AFTER_NS:
            self.is_wild = self._steep
        self._drift = float(np.clip(slope, -MAX_DRIFT, MAX_DRIFT))
        self._offset_ns = min(apart - self._drift * since for since, apart in points)


def _turns_down(a: tuple[int, int], b: tuple[int, int], c: tuple[int, int]) -> bool:
    """Check whether b lies on or above the line from a to c."""
    return (b[1] - a[1]) * (c[0] - a[0]) >= (c[1] - a[1]) * (b[0] - a[0])
