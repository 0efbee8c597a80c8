"""Estimate the body's sway about its nominal attitude from the gyro.

A gantry keeps its attitude on average, so the sway is the integrated gyro less its mean and trend over some
seconds: the mean accounts for the unknown initial attitude, the trend for the gyro's bias.
"""

from __future__ import annotations

import numpy as np

from barsight.core.arrays import Float64, Int64
from barsight.core.errors import Failed
from barsight.core.records.sensor_samples import ImuSamples
from barsight.core.stamps import NS_PER_S, interpolate_at, seconds_to_ns

MIN_SPAN_S = 4.0
MAX_GAP_S = 0.2


def turned_angle(imu: ImuSamples) -> Float64:
    """Integrate the gyro to angles (N, 3) rad in body axes by the trapezium rule; valid for turns of a few
    degrees.
    """
    step_s = np.diff(imu.stamp_ns)[:, None] / NS_PER_S
    between = (imu.gyro_radps[1:] + imu.gyro_radps[:-1]) / 2 * step_s
    return np.vstack([np.zeros((1, 3)), np.cumsum(between, axis=0)])


def sway_at(imu: ImuSamples, stamp_ns: int, half_window_s: float) -> Float64 | Failed:
    """Compute the rotation vector (3,) `nominal body from body` at a stamp, rad.

    The trend is fitted over `half_window_s` before and after the stamp. Failed `no-imu` where the samples
    don't enclose the stamp, have a gap there or span less than 4 s.
    """
    window = seconds_to_ns(half_window_s)
    first, last = np.searchsorted(imu.stamp_ns, (stamp_ns - window, stamp_ns + window))
    stamps: Int64 = imu.stamp_ns[first:last]
    if stamps.size < 8 or stamps[0] > stamp_ns or stamps[-1] < stamp_ns:
        return Failed("no-imu", "the IMU doesn't cover the frame")
    if stamps[-1] - stamps[0] < seconds_to_ns(MIN_SPAN_S) or np.diff(stamps).max() > seconds_to_ns(MAX_GAP_S):
        return Failed("no-imu", "the IMU has a gap around the frame or is too short")
    time = (stamps - stamp_ns) / NS_PER_S
    design = np.column_stack([np.ones(time.size), time])
    angle = turned_angle(ImuSamples(stamps, imu.gyro_radps[first:last], imu.accel_mps2[first:last]))
    trend, *_ = np.linalg.lstsq(design, angle, rcond=None)
    current = interpolate_at(np.array([stamp_ns]), stamps, angle)[0]
    sway: Float64 = current - trend[0]
    return sway
