"""Estimate by how much the encoders' stamps are late, from the IMU's motion alone.

The estimate has the latency as an unknown, but follows it only as far as its readings' parabolas hold, and a
delay of 0.1 s of a crane that oscillates looks like jumps. So a long delay is taken off beforehand: the one
with which the readings of a few seconds differ least from the travel by the IMU, up to the cubic that gravity
and biases leave open.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from barsight.core.arrays import Float64
from barsight.core.records.sensor_samples import CraneSamples, ImuSamples
from barsight.core.stamps import NS_PER_S, seconds_to_ns
from barsight.motion.crane.known_motion import KnownMotion

LATE_S: Float64 = np.array(np.arange(-30, 31) * 0.02, np.float64)
"""Delays that are tried, s."""
PART_S, MAX_PARTS = 4.0, 15
"""Duration, s, of a part of the readings, and the maximum number of parts."""
MIN_READINGS = 15
MIN_LATE_S = 0.07
"""Delays below this one are left to the estimate."""
MAX_LATE_S = 0.25
"""Delays above this one are a wrong clock, by which whatever else the crane tells is off too."""
WILD_M = 0.02
"""Distance from which a reading counts as wild, and no more than this."""
CLEARLY_WORSE, MAX_LEFT_M = 1.3, 0.005
"""Minimum ratio of the mean square of the readings as stamped to that after the delay, and maximum RMS after
it: no more is left of 1000 parts of drawn cranes, with jumps and freezes, that aren't late (1.21).
"""
MAX_SCATTER_M, MAX_SCATTER_SIGMAS = 0.0075, 1.5
"""Maximum RMS, m and in sigma of a reading, that the best delay leaves in half of the parts or more. It
leaves 4.2 mm or less with sound cranes; from 8.5 mm on places are up to 40 mm off.
"""
INDEPENDENT_S = 0.1
"""Interval, s, from which what a delay leaves in the readings is independent."""


@dataclass(frozen=True)
class FittedDelay:
    """late_s: the delay that fits best; sigma_s: its sigma."""

    late_s: float
    sigma_s: float


def fit_delay(late_s: Float64, squares: Float64, count: int) -> FittedDelay | None:
    """Fit a parabola to the least of the mean squares (L,) of `count` residuals with evenly spaced delays
    (L,); None where the least is at an end.
    """
    best = int(squares.argmin())
    if not 0 < best < len(squares) - 1:
        return None
    before, least, after = squares[best - 1 : best + 2].tolist()
    bend, slope, step = before - 2 * least + after, (after - before) / 2, float(late_s[1] - late_s[0])
    if not bend > 0:
        return None
    least -= slope**2 / (2 * bend)
    sigma = step * (2 * max(least, 0.0) / (bend * count)) ** 0.5
    return FittedDelay(float(late_s[best]) - step * slope / bend, sigma)


class DelaySearch:
    """Mean squares of the readings against the IMU for each delay tried, and without it, over all parts so
    far.
    """

    def __init__(self) -> None:
        self._squares: Float64 = np.zeros(len(LATE_S))
        self._alone, self._count = 0.0, 0
        self._tried = self._scattered = 0

    def add(self, crane: CraneSamples, imu: ImuSamples, begin_ns: int) -> bool:
        """Add the readings of the part that begins at a stamp; return whether they told anything. Those that
        no delay explains, as they froze or jumped, don't.
        """
        spare, end_ns = seconds_to_ns(float(LATE_S[-1])), begin_ns + seconds_to_ns(PART_S)
        first, end = np.searchsorted(crane.stamp_ns, (begin_ns, end_ns))
        way = KnownMotion(None, imu).by_imu(crane, begin_ns - spare, end_ns + spare)
        if end - first < MIN_READINGS or way is None:
            return False
        stamps, place = crane.stamp_ns[first:end], crane.position_m[first:end]
        time = (stamps - begin_ns) / NS_PER_S / PART_S * 2 - 1
        basis, _ = np.linalg.qr(np.polynomial.polynomial.polyvander(time, 3))

        def mean_square(off: Float64) -> float:
            off = off - basis @ (basis.T @ off)
            return float((np.minimum(np.abs(off), WILD_M) ** 2).mean())

        ways = [way.place_at(stamps - seconds_to_ns(late_s)) for late_s in LATE_S.tolist()]
        squares = np.array([mean_square(place - way_m) for way_m in ways])
        max_left_m = max(MAX_SCATTER_M, MAX_SCATTER_SIGMAS * crane.position_std_m)
        self._tried, self._scattered = self._tried + 1, self._scattered + int(squares.min() > max_left_m**2)
        if squares.min() > MAX_LEFT_M**2:
            return False
        self._squares += squares
        self._alone += mean_square(place)
        self._count += 1
        return True

    @property
    def late_s(self) -> float:
        """Return the delay, s, if one explains the readings clearly better than none, and than no motion of
        the IMU at all, as where the crane stands; else 0.
        """
        if not self._count:
            return 0.0
        mean = self._squares / self._count
        best, late_s = int(mean.argmin()), float(LATE_S[mean.argmin()])
        others = min(float(mean[len(LATE_S) // 2]), self._alone / self._count)
        clear = 0 < best < len(LATE_S) - 1 and mean[best] < min(others / CLEARLY_WORSE, MAX_LEFT_M**2)
        return late_s if clear and abs(late_s) > MIN_LATE_S else 0.0

    @property
    def fitted(self) -> FittedDelay | None:
        """Return the delay that fits best, of any size; None where none is clearly better than no motion."""
        mean = self._squares / max(self._count, 1)
        if not self._count or mean.min() > self._alone / self._count / CLEARLY_WORSE:
            return None
        return fit_delay(LATE_S, mean, round(self._count * PART_S / INDEPENDENT_S))

    @property
    def doubts(self) -> tuple[str, ...]:
        """Describe a wrong clock, and readings that no constant delay explains, as where stamps are times of
        arrival.
        """
        late_s = self.late_s
        if abs(late_s) > MAX_LATE_S:
            off = f"{abs(late_s):.2f} s {'late' if late_s > 0 else 'early'}"
            told = f"the encoders' stamps are {off} against the IMU: a wrong clock (put sensors on one clock)"
            return (told,)
        if 2 * self._scattered <= self._tried:
            return ()
        return (
            "whatever their delay, the encoders' readings don't fit the IMU's motion in "
            f"{self._scattered} of {self._tried} parts of {PART_S:g} s: stamp them when they are taken, not "
            "when they arrive, and check the encoders",
        )


def find_delay(crane: CraneSamples | None, imu: ImuSamples | None) -> DelaySearch:
    """Search the readings for a delay; none is found without an IMU."""
    search = DelaySearch()
    if crane is None or imu is None or len(crane.stamp_ns) < MIN_READINGS:
        return search
    parts = np.arange(crane.stamp_ns[0], crane.stamp_ns[-1], seconds_to_ns(PART_S))
    for begin in parts[:: -(-len(parts) // MAX_PARTS)].tolist():
        search.add(crane, imu, begin)
    return search


def shifted_back(crane: CraneSamples, late_ns: int) -> CraneSamples:
    """Stamp the readings earlier by a delay."""
    return replace(crane, stamp_ns=crane.stamp_ns - late_ns, late_ns=late_ns) if late_ns else crane
