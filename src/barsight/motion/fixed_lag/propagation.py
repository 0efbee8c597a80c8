"""Propagate the last estimate by IMU and encoders: poses between pictures and after the last one.

An error-state Kalman filter [Solà 2017, section 5] that starts anew from each estimate of the window. Without
an IMU, or where it is silent, the attitude is held and the velocity follows a random walk.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from barsight.calibration.geometry.imu_noise import ImuNoise
from barsight.core.arrays import Float64, Int64
from barsight.core.errors import Failed
from barsight.core.pose import Pose, skew
from barsight.core.records.sensor_samples import CraneSamples
from barsight.core.records.trajectory import PosedFrame
from barsight.core.stamps import NS_PER_S, seconds_to_ns
from barsight.inertial.model import GRAVITY_MPS2, BodyState, ImuBias
from barsight.inertial.preintegration import MAX_GAP_S
from barsight.motion.crane.encoder_trajectory import fit_position, reestimate_noise

ACCELERATION_DENSITY = 0.3
"""Noise density of the crane's acceleration where no IMU measures it, m/s²/sqrt(Hz)."""
SWAY_DENSITY_RADPS = 6e-3
"""Noise density of the turn rate where no IMU measures it, rad/s/sqrt(Hz)."""
GATE_SIGMAS = 5.0
"""Gate, in sigma, beyond which an encoder reading isn't used: the encoder has jumped or frozen."""
REFERENCE_S = 0.25
"""Half-width, s, of the window of readings that give the encoders' position at the estimate's stamp."""
_SIZE = 15
_TURN, _PLACE, _SPEED, _ACCEL, _GYRO, _OFFSET = (slice(k, k + 3) for k in range(0, _SIZE + 3, 3))


@dataclass(frozen=True, eq=False)
class NavigationState:
    """State of the window's last node. stamp_ns: on the IMU's clock. target: its frame, `yard` or `world`.

    covariance: (15, 15) of rotation (rad, body axes), position (m) and velocity (m/s, both in the reference's
    axes), accelerometer's and gyro's bias.
    """

    stamp_ns: int
    target: str
    body: BodyState
    bias: ImuBias
    covariance: Float64

    @property
    def row(self) -> Float64:
        """Return all numbers of the state but its stamp as a row (`ROW_NUMBERS`,)."""
        body, bias = self.body, self.bias
        motion = (float(self.target == "yard"), body.rotation, body.position_m, body.velocity_mps)
        parts = (*motion, bias.accel_mps2, bias.gyro_radps, self.covariance)
        return np.concatenate([np.ravel(part) for part in parts])

    @classmethod
    def of(cls, stamp_ns: int, row: Float64) -> NavigationState:
        """Build from the numbers of `row`."""
        in_yard, turn, place, speed, accel, gyro, covariance = np.split(row, np.cumsum((1, 9, 3, 3, 3, 3)))
        body, target = BodyState(turn.reshape(3, 3), place, speed), "yard" if in_yard[0] else "world"
        return cls(stamp_ns, target, body, ImuBias(gyro, accel), covariance.reshape(_SIZE, _SIZE))


ROW_NUMBERS = 1 + 9 + 4 * 3 + _SIZE**2


class Propagator:
    """Propagates a `NavigationState` by the readings that come after it.

    crane: the readings around the state, None without encoders. has_imu: whether there are IMU readings.
    """

    def __init__(
        self, state: NavigationState, noise: ImuNoise, crane: CraneSamples | None, *, has_imu: bool
    ) -> None:
        self.stamp_ns, self._target, self._bias = state.stamp_ns, state.target, state.bias
        body = state.body
        self._rotation = body.rotation.copy()
        self._position, self._velocity = body.position_m.copy(), body.velocity_mps.copy()
        self._covariance = np.zeros((_SIZE + 3, _SIZE + 3))
        self._covariance[:_SIZE, :_SIZE] = state.covariance
        self._noise, self._has_imu = noise, has_imu
        self._force, self._rate = body.rotation.T @ np.array([0.0, 0.0, GRAVITY_MPS2]), np.zeros(3)
        self._is_measured, self._imu_ns = False, state.stamp_ns
        self._encoders: tuple[Float64, float] | None = None
        if crane is not None:
            crane = reestimate_noise(crane)
            found = fit_position(crane, state.stamp_ns, seconds_to_ns(REFERENCE_S))
            if not isinstance(found, Failed):
                self._encoders = body.position_m - found.position_m, crane.position_std_m
                # The offset has the errors of the state's position and of the encoders' at that stamp.
                self._covariance[_OFFSET, :_SIZE] = state.covariance[_PLACE]
                self._covariance[:_SIZE, _OFFSET] = state.covariance[:, _PLACE]
                self._covariance[_OFFSET, _OFFSET] = state.covariance[_PLACE, _PLACE] + found.covariance

    def take(self, imu_ns: Int64, imu: Float64, crane_ns: Int64, places_m: Float64) -> None:
        """Process the readings that came since the last call, in the order of their stamps.

        imu: (N, 6) turn rate and specific force. places_m: (M, 3).
        """
        order = np.argsort(np.concatenate([imu_ns, crane_ns]), kind="stable")
        for k in order.tolist():
            if k < len(imu_ns):
                self._measure(int(imu_ns[k]), imu[k])
            else:
                self._correct(int(crane_ns[k - len(imu_ns)]), places_m[k - len(imu_ns)])

    def at(self, stamp_ns: int) -> PosedFrame:
        """Predict the pose at a stamp (IMU's clock) after the last reading; the filter's state stays as it
        is.
        """
        rotation, position, _, covariance = self._moved(max(stamp_ns, self.stamp_ns))
        by_state = np.zeros((6, _SIZE + 3))
        by_state[:3, _TURN], by_state[3:, _PLACE] = rotation, np.eye(3)
        pose = Pose(self._target, "body", rotation, position)
        return PosedFrame(stamp_ns, pose, by_state @ covariance @ by_state.T)

    def _measure(self, stamp_ns: int, reading: Float64) -> None:
        """Move to the stamp of an IMU reading, by its mean with the reading before."""
        rate, force = reading[:3] - self._bias.gyro_radps, reading[3:] - self._bias.accel_mps2
        if self._is_measured and stamp_ns > self.stamp_ns:
            self._rate, self._force = (self._rate + rate) / 2, (self._force + force) / 2
        else:
            self._rate, self._force = rate, force
        self._move(stamp_ns)
        self._rate, self._force, self._is_measured = rate, force, True
        self._imu_ns = max(stamp_ns, self._imu_ns)

    def _correct(self, stamp_ns: int, place_m: Float64) -> None:
        """Update by an encoder reading, relative to the encoders' position at the initial state."""
        if self._encoders is None:
            return
        self._move(stamp_ns)
        late_s = min(stamp_ns - self.stamp_ns, 0) / NS_PER_S
        offset, sigma = self._encoders
        residual = place_m + offset - (self._position + late_s * self._velocity)
        design = np.zeros((3, _SIZE + 3))
        design[:, _PLACE], design[:, _SPEED], design[:, _OFFSET] = np.eye(3), late_s * np.eye(3), -np.eye(3)
        noise = np.eye(3) * sigma**2
        spread = design @ self._covariance @ design.T + noise
        if residual @ np.linalg.solve(spread, residual) > GATE_SIGMAS**2:
            return
        gain = np.linalg.solve(spread, design @ self._covariance).T
        self._apply(gain @ residual)
        left = np.eye(_SIZE + 3) - gain @ design
        self._covariance = left @ self._covariance @ left.T + gain @ noise @ gain.T

    def _apply(self, step: Float64) -> None:
        self._rotation = self._rotation @ Rotation.from_rotvec(step[_TURN]).as_matrix()
        self._position, self._velocity = self._position + step[_PLACE], self._velocity + step[_SPEED]
        self._bias = ImuBias(self._bias.gyro_radps + step[_GYRO], self._bias.accel_mps2 + step[_ACCEL])
        if self._encoders is not None:
            self._encoders = self._encoders[0] + step[_OFFSET], self._encoders[1]

    def _move(self, stamp_ns: int) -> None:
        """Move to a later stamp."""
        if stamp_ns > self.stamp_ns:
            self._rotation, self._position, self._velocity, self._covariance = self._moved(stamp_ns)
            self.stamp_ns = stamp_ns

    def _moved(self, stamp_ns: int) -> tuple[Float64, Float64, Float64, Float64]:
        """Return rotation, position, velocity and covariance at a later stamp, by the last rate and force
        unless the IMU is silent.
        """
        seconds, rate, force = (stamp_ns - self.stamp_ns) / NS_PER_S, self._rate, self._force
        gravity = np.array([0.0, 0.0, GRAVITY_MPS2])
        measured = self._has_imu and stamp_ns - self._imu_ns <= seconds_to_ns(MAX_GAP_S)
        if not measured:
            rate, force = np.zeros(3), self._rotation.T @ gravity
        half = Rotation.from_rotvec(rate * seconds / 2).as_matrix()
        acceleration = self._rotation @ half @ force - gravity
        place = self._position + seconds * self._velocity + seconds**2 / 2 * acceleration
        covariance = self._spread(seconds, rate, force, measured=measured)
        return self._rotation @ half @ half, place, self._velocity + seconds * acceleration, covariance

    def _spread(self, seconds: float, rate: Float64, force: Float64, *, measured: bool) -> Float64:
        """Propagate the covariance: `F P F^T + Q` [Solà 2017, Eq. 270]."""
        jacobian = np.eye(_SIZE + 3)
        jacobian[_TURN, _TURN] = Rotation.from_rotvec(-rate * seconds).as_matrix()
        jacobian[_PLACE, _SPEED] = seconds * np.eye(3)
        if measured:
            jacobian[_TURN, _GYRO] = -seconds * np.eye(3)
            jacobian[_SPEED, _TURN] = -seconds * self._rotation @ skew(force)
            jacobian[_SPEED, _ACCEL] = -seconds * self._rotation
        noise = self._noise
        turn = noise.gyro_density if measured else SWAY_DENSITY_RADPS
        accel = noise.accel_density if measured else ACCELERATION_DENSITY
        added = np.zeros(_SIZE + 3)
        added[_TURN], added[_SPEED] = turn**2 * seconds, accel**2 * seconds
        added[_PLACE] = accel**2 * seconds**3 / 3
        added[_GYRO], added[_ACCEL] = noise.gyro_walk**2 * seconds, noise.accel_walk**2 * seconds
        return jacobian @ self._covariance @ jacobian.T + np.diag(added)
