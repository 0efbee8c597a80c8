"""Align the first frame with gravity, for recordings without a crane."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from barsight.core.arrays import Float64
from barsight.core.pose import Pose
from barsight.core.stamps import NS_PER_S
from barsight.recording.base import Recording


@dataclass(frozen=True)
class GravityAlignment:
    """world_from_body: the first frame's pose, at the origin, Z up. from_imu: whether gravity was
    measured.
    """

    world_from_body: Pose
    from_imu: bool
    warnings: tuple[str, ...]


def align_with_gravity(recording: Recording) -> GravityAlignment:
    """Average gravity from the IMU, from 0.5 s before to 1 s after the first frame; else take cam0's rows as
    level.

    At rest the accelerometer measures the reaction to gravity: its mean points up. World's X is cam0's
    viewing direction, or its x axis where the camera looks straight down, made level.
    """
    rig = recording.rig
    imu = recording.imu()
    body_from_cam0 = rig.body_from_cam0.rotation
    up_in_body = body_from_cam0 @ np.array([0.0, -1.0, 0.0])
    warnings: tuple[str, ...] = ()
    from_imu = False
    if imu is not None and recording.index.stamps_ns:
        start = recording.index.stamps_ns[0] + rig.timeshift_cam_imu_ns
        first, last = np.searchsorted(imu.stamp_ns, (start - NS_PER_S // 2, start + NS_PER_S))
        mean = imu.accel_mps2[first:last].mean(axis=0) if last > first else np.zeros(3)
        strength = float(np.linalg.norm(mean))
        from_imu = 8.0 < strength < 12.0
        if from_imu:
            up_in_body = mean / strength
        else:
            warnings = (f"the accelerometer shows {strength:.1f} m/s^2 at the start: gravity is not known",)
    if not from_imu:
        warnings += ("no gravity: the first picture's rows are taken as level",)
    forward = body_from_cam0[:, 2]
    if abs(forward @ up_in_body) > 0.9:
        forward = body_from_cam0[:, 0]
    return GravityAlignment(
        Pose("world", "body", _levelled(up_in_body, forward), np.zeros(3)), from_imu, warnings
    )


def _levelled(up: Float64, forward: Float64) -> Float64:
    """Build world_from_body (3, 3) with world's Z along `up` and its X nearest to `forward`, both given in
    `body`.
    """
    x = forward - (forward @ up) * up
    x /= np.linalg.norm(x)
    rotation = np.vstack([x, np.cross(up, x), up])
    return np.asarray(Rotation.from_matrix(rotation).as_matrix())
