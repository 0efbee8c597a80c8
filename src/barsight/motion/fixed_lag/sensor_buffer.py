"""Hold the encoder and IMU readings up to now."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from barsight.calibration.geometry.imu_noise import ImuNoise
from barsight.core.records.sensor_samples import CraneSamples, ImuSamples
from barsight.core.stamps import seconds_to_ns
from barsight.inertial.model import without_saturation
from barsight.motion.crane.encoder_delay import shifted_back

SENSOR_DELAY_S = 0.06
"""Delay, s, after a frame's stamp until which readings are awaited before the frame is computed."""
SLOW_S, SLOW_RATIO, SLOW_DELAY_S = 0.055, 1.35, 0.27
"""Interval, s, from which encoders are slow; delay for them, in which one reads at least once, in intervals,
and its maximum, s.
"""
NEWEST = 100
"""Number of the newest readings that tell the encoders' interval."""


@dataclass(frozen=True, eq=False)
class SensorBuffer:
    """Encoder and IMU readings up to now, and the IMU's noise."""

    crane: CraneSamples | None
    imu: ImuSamples | None
    noise: ImuNoise

    @property
    def delay_ns(self) -> int:
        """Return the delay after a frame's stamp until which readings are awaited."""
        crane = self.crane
        if crane is None:
            return seconds_to_ns(SENSOR_DELAY_S)
        newest = replace(crane, stamp_ns=crane.stamp_ns[-NEWEST:], position_m=crane.position_m[-NEWEST:])
        if newest.interval_ns <= seconds_to_ns(SLOW_S):
            return seconds_to_ns(SENSOR_DELAY_S)
        return min(round(SLOW_RATIO * newest.interval_ns), seconds_to_ns(SLOW_DELAY_S))

    def between(self, first_ns: int, last_ns: int, late_ns: int = 0) -> SensorBuffer:
        """Select the readings between two stamps, without those at the limit of the IMU range.

        late_ns: delay of the encoders' stamps, which is taken off.
        """
        crane, imu = self.crane, self.imu
        if crane is not None:
            part = slice(*np.searchsorted(crane.stamp_ns, (first_ns + late_ns, last_ns + late_ns)))
            near = replace(crane, stamp_ns=crane.stamp_ns[part], position_m=crane.position_m[part])
            crane = shifted_back(near, late_ns)
        if imu is not None:
            part = slice(*np.searchsorted(imu.stamp_ns, (first_ns, last_ns)))
            imu = ImuSamples(imu.stamp_ns[part], imu.gyro_radps[part], imu.accel_mps2[part])
            imu, _ = without_saturation(imu)
        return SensorBuffer(crane, imu, self.noise)
