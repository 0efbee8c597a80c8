"""Describe an IMU's noise: white noise and bias random walk of gyro and accelerometer."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ImuNoise:
    """IMU noise model in Kalibr's units.

    gyro_density: rad/s/sqrt(Hz). gyro_walk: rad/s^2/sqrt(Hz). accel_density: m/s^2/sqrt(Hz).
    accel_walk: m/s^3/sqrt(Hz). rate_hz: sampling rate as stated in the file.
    """

    gyro_density: float
    gyro_walk: float
    accel_density: float
    accel_walk: float
    rate_hz: float
