"""Hold the encoder and IMU readings up to now."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from barsight.calibration.geometry.imu_noise import ImuNoise
from barsight.core.records.sensor_samples import CraneSamples, ImuSamples
from barsight.inertial.model import without_saturation

SENSOR_DELAY_S = 0.06
"""Delay, s, after a frame's stamp until which readings are awaited before the frame is computed."""


@dataclass(frozen=True, eq=False)
class SensorBuffer:
    """Encoder and IMU readings up to now, and the IMU's noise."""

    crane: CraneSamples | None
    imu: ImuSamples | None
    noise: ImuNoise

    def between(self, first_ns: int, last_ns: int) -> SensorBuffer:
        """Select the readings between two stamps, without those at the limit of the IMU range."""
        crane, imu = self.crane, self.imu
        if crane is not None:
            part = slice(*np.searchsorted(crane.stamp_ns, (first_ns, last_ns)))
            crane = replace(crane, stamp_ns=crane.stamp_ns[part], position_m=crane.position_m[part])
        if imu is not None:
            part = slice(*np.searchsorted(imu.stamp_ns, (first_ns, last_ns)))
            near = ImuSamples(imu.stamp_ns[part], imu.gyro_radps[part], imu.accel_mps2[part])
            imu, _ = without_saturation(near)
        return SensorBuffer(crane, imu, self.noise)
