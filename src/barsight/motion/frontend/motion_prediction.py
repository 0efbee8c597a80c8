"""Predict the left camera's motion between two frames from encoders and gyro, for the front end."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from barsight.calibration.geometry.rectification import Rectifier
from barsight.core.arrays import Float64
from barsight.core.errors import Failed
from barsight.core.pose import Pose, skew
from barsight.core.records.sensor_samples import CraneSamples, ImuSamples
from barsight.core.stamps import interpolate_at, seconds_to_ns
from barsight.features.guided_matching import PredictedMotion
from barsight.inertial.model import GRAVITY_MPS2, BodyState, ImuBias
from barsight.motion.crane.encoder_trajectory import fit_position
from barsight.motion.crane.sway import turned_angle

if TYPE_CHECKING:
    from barsight.inertial.preintegration import Preintegrated

WINDOW_S = 0.3
SWAY_RAD = float(np.deg2rad(0.15))
GYRO_BIAS_SIGMA_RADPS = 5e-4
SLEW_SIGMA_S = 0.03
"""Uncertainty of the encoders' latency, s (1 sigma); it matters only while the speed changes."""
JUMP_SIGMA_M = 0.005
"""Standard deviation of the error that remains after a jump has been subtracted."""
SPARE_SIGMAS = 1.5
"""Factor on the sigmas of a prediction from the estimate's own covariance, to allow for its optimism."""


class CranePredictor:
    """A `Predictor` from the encoders' travel and the gyro's turn, starting from the nominal attitude.

    gyro_bias_radps: (3,), from standing still. shift_ns: `timeshift_cam_imu`.
    """

    def __init__(
        self, crane: CraneSamples, imu: ImuSamples | None, gyro_bias_radps: Float64, rectifier: Rectifier,
        shift_ns: int,
    ) -> None:  # fmt: skip
        self._crane, self._imu, self._bias, self._shift_ns = crane, imu, gyro_bias_radps, shift_ns
        self._angle = np.empty((0, 3)) if imu is None else turned_angle(imu)
        self._body_from_rect0 = rectifier.body_from_rect0

    def __call__(self, old_ns: int, new_ns: int) -> PredictedMotion | None:
        """Predict the motion; None where the encoders don't cover both frames."""
        window = seconds_to_ns(WINDOW_S)
        old = fit_position(self._crane, old_ns + self._shift_ns, window)
        new = fit_position(self._crane, new_ns + self._shift_ns, window)
        if isinstance(old, Failed) or isinstance(new, Failed):
            return None
        turn, turn_sigma = self._turn(old_ns, new_ns)
        nominal = self._crane.yard_from_body_nominal
        yard_from_old = Pose("yard", "body", nominal, old.position_m) @ self._body_from_rect0
        attitude = nominal @ Rotation.from_rotvec(turn).as_matrix()
        yard_from_new = Pose("yard", "body", attitude, new.position_m) @ self._body_from_rect0
        motion = yard_from_new.inverse() @ yard_from_old
        travel = float(np.linalg.norm(new.position_m - old.position_m))
        slew = float(np.linalg.norm(new.velocity_mps - old.velocity_mps)) * SLEW_SIGMA_S
        stamps = np.array([old_ns, new_ns]) + self._shift_ns
        jumped = sum(float(np.ptp(jump.share(stamps))) for jump in self._crane.jumps) * JUMP_SIGMA_M
        covariance = np.eye(6) * turn_sigma**2
        spread = (SWAY_RAD * travel) ** 2 + (2e-3) ** 2 + slew**2 + jumped**2
        covariance[3:, 3:] = (
            motion.rotation @ (old.covariance + new.covariance) @ motion.rotation.T + np.eye(3) * spread
        )
        return PredictedMotion(motion.rotation, motion.translation, covariance)

    def _turn(self, old_ns: int, new_ns: int) -> tuple[Float64, float]:
        """Integrate the rotation vector (3,) old body from new body; also return its sigma (rad)."""
        seconds = (new_ns - old_ns) / 1e9
        if self._imu is not None:
            stamps = np.array([old_ns, new_ns]) + self._shift_ns
            angle = interpolate_at(stamps, self._imu.stamp_ns, self._angle)
            if np.isfinite(angle).all():
                sigma = GYRO_BIAS_SIGMA_RADPS * seconds + 2e-4
                return angle[1] - angle[0] - self._bias * seconds, sigma
        return np.zeros(3), SWAY_RAD * 2**0.5


def predict_by_imu(
    old: Pose, state: BodyState, part: Preintegrated, bias: ImuBias, covariance: Float64,
    body_from_rect0: Pose,
) -> PredictedMotion:  # fmt: skip
    """Predict the motion of `rect0` from an old body pose to the one that the IMU leads to from `state`.

    covariance: (15, 15) of the state in GTSAM's order: pose in body axes, velocity, biases. The result's
    sigmas are widened by `SPARE_SIGMAS`.
    """
    end, dt = part.predict(state, bias), part.seconds
    new = Pose(old.target, "body", end.rotation, end.position_m)
    motion = (new @ body_from_rect0).inverse() @ (old @ body_from_rect0)
    # An attitude error turns the whole way except the part that the IMU itself measured.
    way = state.velocity_mps * dt + np.array([0.0, 0.0, -GRAVITY_MPS2]) * dt**2 / 2
    by_state = np.zeros((6, 15))
    by_state[3:, :3] = skew(state.rotation.T @ way)
    by_state[3:, 6:9] = state.rotation.T * dt
    by_state[3:, 9:12] = -np.eye(3) * dt**2 / 2
    by_state[:3, 12:] = -np.eye(3) * dt
    own = by_state @ covariance @ by_state.T + part.covariance[:6, :6]
    to_rect0 = np.kron(np.eye(2), body_from_rect0.rotation.T)
    to_rect0[3:, :3] = -body_from_rect0.rotation.T @ skew(body_from_rect0.translation)
    spread = SPARE_SIGMAS**2 * (to_rect0 @ own @ to_rect0.T)
    return PredictedMotion(motion.rotation, motion.translation, spread)
