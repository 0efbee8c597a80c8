"""Define the records of what IMU, encoders and laser have measured."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from barsight.core.arrays import Float64, Int64

AXES = ("bridge", "trolley", "hoist")
"""Names of the encoders, in the order of their readings."""


@dataclass(frozen=True, eq=False)
class ImuSamples:
    """stamp_ns: (N,) int64 increasing. gyro_radps, accel_mps2: (N, 3) in `body`."""

    stamp_ns: Int64
    gyro_radps: Float64
    accel_mps2: Float64


@dataclass(frozen=True)
class EncoderJump:
    """A jump in one encoder's readings, from `stamp_ns` on. axis: 0 bridge, 1 trolley, 2 hoist.

    size_m: the estimated jump. sigma_m: its sigma where it is estimated anew, from readings on both sides of
    it; found_sigma_m: its sigma as found. kind: certain, possible, or suspected because the readings stood
    still before.
    """

    stamp_ns: int
    axis: int
    size_m: float
    sigma_m: float
    kind: Literal["sure", "maybe", "freeze"] = "sure"
    found_sigma_m: float = float("inf")

    @property
    def known_sigma_m(self) -> float:
        """Return the jump's sigma where it is estimated no more."""
        return min(self.sigma_m, self.found_sigma_m)

    def share(self, stamp_ns: Int64) -> Float64:
        """Return (N,) the factor of the jump's size in readings at these stamps: 0 before it, 1 from it
        on.
        """
        return np.where(stamp_ns >= self.stamp_ns, 1.0, 0.0)


READINGS_PER_SIDE, MAX_REACH_NS = 3.1, 800_000_000
"""Minimum half-width of a window for a fit, in intervals of the readings, and its maximum, ns: over longer
ones a crane's travel is no parabola. So at least four readings a second are needed.
"""

MIN_CHANGES, SAME_M, MULTIPLE_RATIO = 5, 1e-6, 0.006
"""Minimum number of changes of an encoder's readings that show its resolution; the largest change that is
rounding; and how far a change may be from a multiple of it.
"""


@dataclass(frozen=True, eq=False)
class CraneSamples:
    """Positions of the crane's reference point by the encoders.

    stamp_ns: (N,) int64 increasing. position_m: (N, 3) in `yard`: bridge x, trolley y, hoist z.
    crane_to_body_m: (3,) the body's origin minus the crane point, yard axes.
    yard_from_body_nominal: (3, 3) attitude of the body as mounted. position_std_m: sigma of one reading.
    jumps: found in the readings and subtracted from them, in order of time; no fit may span one.
    late_ns: delay that was taken off the stamps.
    """

    stamp_ns: Int64
    position_m: Float64
    crane_to_body_m: Float64
    yard_from_body_nominal: Float64
    position_std_m: float
    jumps: tuple[EncoderJump, ...] = ()
    late_ns: int = 0

    @cached_property
    def interval_ns(self) -> int:
        """Return the median interval of the readings, 0 where there are fewer than two."""
        return int(np.median(np.diff(self.stamp_ns))) if len(self.stamp_ns) > 1 else 0

    @cached_property
    def resolution_m(self) -> float:
        """Return the coarsest step of which all an encoder's changes are multiples; 0 where readings are too
        few or too fine to show it. (Readings at one speed change by one step, too, but none of them is equal
        to the last.)
        """
        coarsest = 0.0
        for axis in self.position_m.T:
            steps = np.abs(np.diff(axis))
            changed = np.flatnonzero(steps > SAME_M)
            if len(changed) < MIN_CHANGES:
                continue
            finest = float(steps[changed].min())
            multiple = steps[changed] / finest
            others = np.count_nonzero(multiple > 1.5) + np.diff(changed).sum() - len(changed) + 1
            if np.abs(multiple - multiple.round()).max() < MULTIPLE_RATIO and 2 * others >= len(changed):
                coarsest = max(coarsest, finest)
        return coarsest

    def reach_ns(self, half_ns: int) -> int:
        """Return the half-width of a window that is wide enough for slow encoders too, if any is."""
        wide_ns = round(READINGS_PER_SIDE * self.interval_ns)
        return max(half_ns, wide_ns) if wide_ns <= MAX_REACH_NS else half_ns


@dataclass(frozen=True, eq=False)
class LaserProfile:
    """A reference contour along X. x_m, y_m, z_m: (N,) in `yard`, x increasing. range_std_m: its sigma."""

    profile: int
    x_m: Float64
    y_m: Float64
    z_m: Float64
    range_std_m: float
