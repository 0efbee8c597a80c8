"""Predict the body's motion from frame to frame by the IMU's kinematics [paper Eq. 11], corrected by each
frame's pose from the pictures.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from barsight.core.arrays import Float64
from barsight.core.errors import Failed
from barsight.core.pose import Pose
from barsight.core.records.sensor_samples import ImuSamples
from barsight.core.stamps import NS_PER_S
from barsight.inertial.model import ORDINARY_NOISE, BodyState, ImuBias
from barsight.inertial.preintegration import Preintegrator
from barsight.inertial.standstill import estimate_at_rest
from barsight.motion.gravity import align_with_gravity
from barsight.recording.base import Recording


@dataclass(frozen=True, eq=False)
class TrendState:
    """State at a frame: its stamp (camera's clock), its pose by the pictures, and the IMU's rotation
    (levelled axes from body) with the velocity in those axes, NaN where it isn't known.
    """

    stamp_ns: int
    placed: Pose
    rotation: Float64
    velocity_mps: Float64


class MotionTrend:
    """R, V and P of [paper Eq. 11] from one frame to the next.

    Biases are those of the rest before the first frame: only they can be subtracted, noise can't. The
    rotation is the gyro's, levelled at the first frame. The velocity at a frame is the predicted one plus the
    error of the predicted position divided by the step's duration: so the pictures bound the accelerometer's
    drift, as in the paper's Figure 6.
    """

    def __init__(self, imu: ImuSamples, recording: Recording) -> None:
        noise = recording.imu_noise() or ORDINARY_NOISE
        self._integrator = Preintegrator(imu, noise)
        self._shift_ns = recording.rig.timeshift_cam_imu_ns
        first_ns = recording.index.stamps_ns[0] + self._shift_ns
        began_ns = max(int(imu.stamp_ns[0]) if imu.stamp_ns.size else first_ns, first_ns - 2 * NS_PER_S)
        rest = estimate_at_rest(imu, began_ns, first_ns, noise)
        self._level = align_with_gravity(recording).world_from_body.rotation
        self._velocity_mps, self._bias = np.full(3, np.nan), ImuBias.none()
        if not isinstance(rest, Failed):
            self._velocity_mps, self._bias = np.zeros(3), rest.bias
            upright = Rotation.align_vectors(np.array([[0.0, 0.0, 1.0]]), rest.up_in_body[None])[0]
            self._level = upright.as_matrix()
        self._state: TrendState | None = None
        self._free: tuple[int, BodyState] | None = None

    def predict(self, stamp_ns: int) -> Pose | None:
        """Predict old_from_new of `body` at a frame; None without a velocity or across a gap of the IMU."""
        self._free = None
        state = self._state
        if state is None:
            return None
        old_ns, new_ns = state.stamp_ns + self._shift_ns, stamp_ns + self._shift_ns
        motion = self._integrator.between(old_ns, new_ns, self._bias)
        if isinstance(motion, Failed):
            return None
        free = motion.predict(BodyState(state.rotation, np.zeros(3), np.zeros(3)))
        self._free = stamp_ns, free
        if not np.isfinite(state.velocity_mps).all():
            return None
        place = free.position_m + state.velocity_mps * ((stamp_ns - state.stamp_ns) / NS_PER_S)
        to_body = state.rotation.T
        return Pose("body", "body", to_body @ free.rotation, to_body @ place)

    def correct(self, stamp_ns: int, placed: Pose) -> None:
        """Correct the state by the frame's pose from the pictures; the next prediction starts from it."""
        state = self._state
        if state is None:
            self._state = TrendState(stamp_ns, placed, self._level, self._velocity_mps)
            return
        seconds = (stamp_ns - state.stamp_ns) / NS_PER_S
        in_body = state.placed.rotation.T @ (placed.translation - state.placed.translation)
        way = state.rotation @ in_body
        if self._free is None or self._free[0] != stamp_ns:
            turn = state.placed.rotation.T @ placed.rotation
            self._state = TrendState(stamp_ns, placed, state.rotation @ turn, way / seconds)
            return
        free = self._free[1]
        velocity = free.velocity_mps + (way - free.position_m) / seconds
        self._state = TrendState(stamp_ns, placed, free.rotation, velocity)
