"""Define the stereo rig: two cameras on a body, and the clock offset between cameras and IMU."""

from __future__ import annotations

from dataclasses import dataclass

from barsight.calibration.geometry.camera import Camera
from barsight.core.pose import Pose


@dataclass(frozen=True, eq=False)
class StereoRig:
    """A stereo rig. cam0 is the left and cam1 the right camera, seen in the viewing direction.

    body_from_cam0, body_from_cam1: mounting on the body (the IMU, or cam0 itself where there is none).
    timeshift_cam_imu_ns: as in Kalibr, t_imu = t_cam + timeshift.
    Raises ValueError where cam1 isn't to the right of cam0 or the viewing directions diverge too far.
    """

    cam0: Camera
    cam1: Camera
    body_from_cam0: Pose
    body_from_cam1: Pose
    timeshift_cam_imu_ns: int = 0

    def __post_init__(self) -> None:
        place = self.cam0_from_cam1
        x, y, z = place.translation
        if self.baseline_m < 1e-4:
            raise ValueError("both cameras have the same place: the baseline is zero")
        if x < 0 and abs(x) > max(abs(y), abs(z)):
            raise ValueError(
                f"cam1 lies {-x:.3f} m to the left of cam0: left and right are swapped in the calibration"
            )
        if abs(x) < max(abs(y), abs(z)):
            raise ValueError(f"the baseline ({x:.3f}, {y:.3f}, {z:.3f}) m does not run along cam0's rows")
        if place.rotation[2, 2] < 0.5:
            raise ValueError("the cameras look more than 60 degrees apart")

    @property
    def cam0_from_cam1(self) -> Pose:
        """Return the stereo extrinsics."""
        return self.body_from_cam0.inverse() @ self.body_from_cam1

    @property
    def baseline_m(self) -> float:
        """Return the distance between the cameras' centres."""
        translation = self.cam0_from_cam1.translation
        return float((translation @ translation) ** 0.5)
