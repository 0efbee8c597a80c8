"""Preintegrate IMU samples on the manifold [Forster 2017] with GTSAM, also between arbitrary stamps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from barsight.calibration.geometry.imu_noise import ImuNoise
from barsight.core.arrays import Float64
from barsight.core.errors import Failed
from barsight.core.records.sensor_samples import ImuSamples
from barsight.core.stamps import NS_PER_S, interpolate_at, seconds_to_ns
from barsight.inertial.model import GRAVITY_MPS2, BodyState, ImuBias

MAX_GAP_S = 0.1
INTEGRATION_SIGMA = 1e-5
"""Standard deviation of the discretisation error, m/sqrt(s)."""


@dataclass(frozen=True, eq=False)
class Preintegrated:
    """Relative motion between two stamps by the IMU alone, independent of the state at the first.

    rotation (3, 3), velocity_mps (3,), position_m (3,): in the body at `start_ns`, without gravity.
    covariance: (9, 9) of rotation, position, velocity (GTSAM's order, body axes at the end).
    measurements: GTSAM's own record, from which a factor is made.
    """

    start_ns: int
    end_ns: int
    bias: ImuBias
    measurements: Any

    @property
    def seconds(self) -> float:
        """Return the duration."""
        return (self.end_ns - self.start_ns) / NS_PER_S

    @property
    def rotation(self) -> Float64:
        """Return start_from_end (3, 3)."""
        return np.asarray(self.measurements.deltaRij().matrix())

    @property
    def covariance(self) -> Float64:
        """Return the covariance (9, 9) of rotation, position and velocity, without the part due to the
        biases.
        """
        return np.asarray(self.measurements.preintMeasCov())[:9, :9]

    def predict(self, state: BodyState, bias: ImuBias | None = None) -> BodyState:
        """Predict the state at `end_ns`; another bias is applied to first order."""
        pose = gtsam.Pose3(gtsam.Rot3(state.rotation), state.position_m)
        start = gtsam.NavState(pose, state.velocity_mps)
        end = self.measurements.predict(start, _gtsam_bias(bias or self.bias))
        return BodyState(end.attitude().matrix(), np.asarray(end.position()), np.asarray(end.velocity()))


class Preintegrator:
    """Integrates one recording's IMU between any two stamps of its clock."""

    def __init__(self, imu: ImuSamples, noise: ImuNoise, gravity_mps2: float = GRAVITY_MPS2) -> None:
        self._imu = imu
        parameters = gtsam.PreintegrationCombinedParams.MakeSharedU(gravity_mps2)
        parameters.setGyroscopeCovariance(np.eye(3) * noise.gyro_density**2)
        parameters.setAccelerometerCovariance(np.eye(3) * noise.accel_density**2)
        parameters.setBiasOmegaCovariance(np.eye(3) * noise.gyro_walk**2)
        parameters.setBiasAccCovariance(np.eye(3) * noise.accel_walk**2)
        parameters.setIntegrationCovariance(np.eye(3) * INTEGRATION_SIGMA**2)
        self._parameters = parameters

    def between(self, start_ns: int, end_ns: int, bias: ImuBias) -> Preintegrated | Failed:
        """Preintegrate between two stamps.

        Failed `imu-gap` where the samples don't enclose both stamps or leave a gap of more than 0.1 s.
        """
        stamps = self._imu.stamp_ns
        inside = stamps[(stamps > start_ns) & (stamps < end_ns)]
        edges = np.concatenate([[start_ns], inside, [end_ns]]).astype(np.int64)
        rate = interpolate_at(edges, stamps, self._imu.gyro_radps)
        force = interpolate_at(edges, stamps, self._imu.accel_mps2)
        most = np.diff(edges).max(initial=0)
        if np.isnan(rate).any() or end_ns <= start_ns or most > seconds_to_ns(MAX_GAP_S):
            return Failed("imu-gap", f"the IMU leaves a gap of {most / NS_PER_S:.2f} s, or ends too early")
        measurements = gtsam.PreintegratedCombinedMeasurements(self._parameters, _gtsam_bias(bias))
        mean_rate, mean_force = (rate[1:] + rate[:-1]) / 2, (force[1:] + force[:-1]) / 2
        step_s = np.diff(edges) / NS_PER_S
        # GTSAM takes the force in the axes of the step's start; the mean force belongs to its middle.
        half_turn = Rotation.from_rotvec(mean_rate * step_s[:, None] / 2)
        for a, w, dt in zip(half_turn.apply(mean_force), mean_rate, step_s, strict=True):
            measurements.integrateMeasurement(a, w, dt)
        return Preintegrated(start_ns, end_ns, bias, measurements)


def _gtsam_bias(bias: ImuBias) -> Any:
    return gtsam.imuBias.ConstantBias(bias.accel_mps2, bias.gyro_radps)
