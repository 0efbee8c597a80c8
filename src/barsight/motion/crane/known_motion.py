"""Gather what pictures and IMU show of the crane's travel, for comparison with encoder readings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.spatial.transform import Rotation

from barsight.core.arrays import Float64, Int64
from barsight.core.records.sensor_samples import CraneSamples, ImuSamples
from barsight.core.stamps import NS_PER_S, interpolate_at, seconds_to_ns
from barsight.inertial.model import GRAVITY_MPS2, ImuBias
from barsight.motion.crane.sway import MAX_GAP_S, turned_angle

TREND_S = 20.0
"""Duration, s, over which the gyro's mean and trend are removed."""
MIN_TREND_S = 3.0


@dataclass(frozen=True, eq=False)
class SeenSteps:
    """K steps between frames as the pictures show them. old_ns, new_ns: (K,) by the encoders' clock; turn:
    (K, 3) rotation vector old body from new body; way_m: (K, 3) in the old body's axes; sigma_m: (K,) of
    way_m on each axis.
    """

    old_ns: Int64
    new_ns: Int64
    turn: Float64
    way_m: Float64
    sigma_m: Float64

    def chosen(self, first_ns: int, last_ns: int) -> SeenSteps:
        """Select the steps that lie entirely between two stamps."""
        inside = (self.old_ns >= first_ns) & (self.new_ns <= last_ns)
        return SeenSteps(
            self.old_ns[inside], self.new_ns[inside], self.turn[inside], self.way_m[inside],
            self.sigma_m[inside],
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class KnownMotion:
    """Travel as pictures and IMU know it; either may be None, and the IMU may have no readings."""

    steps: SeenSteps | None = None
    imu: ImuSamples | None = None

    def span(self, middle_ns: int, half_ns: int) -> tuple[int, int]:
        """Return the first and last stamp of the interval `half_ns` to either side of one, limited to what
        the IMU covers.
        """
        first, end = middle_ns - half_ns, middle_ns + half_ns + 1
        stamps = np.empty(0, np.int64) if self.imu is None else self.imu.stamp_ns
        if len(stamps) and stamps[0] <= middle_ns <= stamps[-1]:
            return max(first, int(stamps[0])), min(end, int(stamps[-1]) + 1)
        return first, end

    def by_imu(self, crane: CraneSamples, first_ns: int, last_ns: int) -> ImuWay | None:
        """Integrate the IMU between two stamps; None where it doesn't cover them or has a gap there."""
        if self.imu is None or not len(self.imu.stamp_ns):
            return None
        stamps, trend = self.imu.stamp_ns, seconds_to_ns(TREND_S)
        middle = (first_ns + last_ns) // 2
        from_ns = max(min(middle - trend // 2, int(stamps[-1]) - trend), int(stamps[0]))
        part = slice(*np.searchsorted(stamps, (from_ns, from_ns + trend + 1)))
        imu = ImuSamples(stamps[part], self.imu.gyro_radps[part], self.imu.accel_mps2[part])
        stamps = imu.stamp_ns
        begin, end = np.searchsorted(stamps, (first_ns, last_ns))
        begin, end = max(0, int(begin) - 1), min(int(end) + 1, len(stamps))
        if end - begin < 8 or stamps[begin] > first_ns or stamps[end - 1] < last_ns:
            return None
        if stamps[-1] - stamps[0] < seconds_to_ns(MIN_TREND_S) or (
            np.diff(stamps).max() > seconds_to_ns(MAX_GAP_S)
        ):
            return None
        time = (stamps - middle) / NS_PER_S
        angle = turned_angle(imu)
        angle -= np.polynomial.polynomial.polyval(time, np.polynomial.polynomial.polyfit(time, angle, 1)).T
        rotations = crane.yard_from_body_nominal @ Rotation.from_rotvec(angle[begin:end]).as_matrix()
        force = np.einsum("nij,nj->ni", rotations, imu.accel_mps2[begin:end])
        force -= force.mean(axis=0)  # removes gravity and the biases, which the caller leaves open
        return ImuWay.integrate(stamps[begin:end], force, 2)


@dataclass(frozen=True, eq=False)
class ImuWay:
    """Travel by the IMU alone, known up to a polynomial of degree `open_degree`: a parabola where gravity and
    bias are unknown, a line where they are known. stamp_ns: (N,); acceleration_mps2, speed_mps, place_m:
    (N, 3) in the reference.
    """

    stamp_ns: Int64
    acceleration_mps2: Float64
    speed_mps: Float64
    place_m: Float64
    open_degree: int

    @classmethod
    def integrate(cls, stamp_ns: Int64, acceleration_mps2: Float64, open_degree: int) -> ImuWay:
        """Integrate accelerations (N, 3) twice, from a mean speed of zero."""
        time = (stamp_ns - stamp_ns[0]) / NS_PER_S
        speed = cumulative_trapezoid(acceleration_mps2, time, axis=0, initial=0)
        speed -= speed.mean(axis=0)
        place = cumulative_trapezoid(speed, time, axis=0, initial=0)
        return cls(stamp_ns, acceleration_mps2, speed, place, open_degree)

    def place_at(self, stamp_ns: Int64) -> Float64:
        """Interpolate the position (M, 3)."""
        return interpolate_at(stamp_ns, self.stamp_ns, self.place_m)

    def speed_at(self, stamp_ns: Int64) -> Float64:
        """Interpolate the speed (M, 3)."""
        return interpolate_at(stamp_ns, self.stamp_ns, self.speed_mps)

    def acceleration_at(self, stamp_ns: Int64) -> Float64:
        """Interpolate the acceleration (M, 3)."""
        return interpolate_at(stamp_ns, self.stamp_ns, self.acceleration_mps2)


def way_around(
    imu: ImuSamples, stamp_ns: int, half_ns: int, rotation: Float64, bias: ImuBias, open_degree: int
) -> ImuWay | None:
    """Integrate the IMU from `half_ns` before a stamp to `half_ns` after it; None where it doesn't cover
    that.

    rotation: (3, 3) reference_from_body at the stamp; open_degree: 1 where it and the bias are known, else 2.
    """
    first, end = np.searchsorted(imu.stamp_ns, (stamp_ns - half_ns, stamp_ns + half_ns))
    part = slice(max(0, int(first) - 1), int(end) + 1)
    stamps = imu.stamp_ns[part]
    if len(stamps) < 8 or stamps[0] > stamp_ns - half_ns or stamps[-1] < stamp_ns + half_ns:
        return None
    if np.diff(stamps).max() > seconds_to_ns(MAX_GAP_S):
        return None
    near = ImuSamples(stamps, imu.gyro_radps[part] - bias.gyro_radps, imu.accel_mps2[part] - bias.accel_mps2)
    angle = turned_angle(near)
    angle -= interpolate_at(np.array([stamp_ns]), stamps, angle)
    rotations = rotation @ Rotation.from_rotvec(angle).as_matrix()
    force = np.einsum("nij,nj->ni", rotations, near.accel_mps2)
    return ImuWay.integrate(stamps, force - [0.0, 0.0, GRAVITY_MPS2], open_degree)
