"""What follows from a rig's drift: a warning where it matters, and a rig turned back where that is asked."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from barsight.calibration.rectification import Rectifier, right_from_rectified
from barsight.calibration.rig import StereoRig
from barsight.core.pose import Pose
from barsight.core.types import RigDrift

SIGNIFICANT_SIGMAS = 3.0
WORTH_MM = 3.0


@dataclass(frozen=True)
class SelfCalibrated:
    """The rectifier to measure with, and sentences where the drift needs any."""

    rectifier: Rectifier
    warnings: tuple[str, ...]


def self_calibrated(
    rig: StereoRig, rectifier: Rectifier, drift: RigDrift | None, *, correct: bool
) -> SelfCalibrated:
    """The rig turned by the drift's yaw if `correct`, else as it is; encoders must have shown the drift."""
    if drift is None or not drift.by_encoders:
        reason = "nothing is self-calibrated: the yaw shows only with encoders in the fused estimate"
        return SelfCalibrated(rectifier, (reason,) if correct else ())
    seen = describe(drift)
    if correct:
        turned = turned_right(rig, np.array([0.0, drift.yaw_rad, 0.0]))
        return SelfCalibrated(Rectifier(turned), (f"the rig is self-calibrated: {seen}",))
    return SelfCalibrated(rectifier, (f"{seen}; calibrate anew",) if is_drifted(drift) else ())


def is_drifted(drift: RigDrift) -> bool:
    """Whether the yaw is beyond 3 sigma and costs more than a few millimetres."""
    significant = abs(drift.yaw_rad) > SIGNIFICANT_SIGMAS * drift.yaw_sigma_rad
    return significant and abs(1e3 * drift.depth_error_m(drift.range_m)) > WORTH_MM


def describe(drift: RigDrift) -> str:
    """The yaw and its cost as a sentence."""
    yaw, sigma = np.degrees([drift.yaw_rad, drift.yaw_sigma_rad])
    cost = 1e3 * drift.depth_error_m(drift.range_m)
    return (
        f"the right camera has turned by {yaw:.4f} ± {sigma:.4f} degrees, "
        f"which moves depths at {drift.range_m:.1f} m by {cost:+.1f} mm"
    )


def turned_right(rig: StereoRig, turn_rad: np.ndarray) -> StereoRig:
    """The rig whose right camera has turned by a rotation vector (3,) in its rectified axes."""
    cam1_from_rect1 = right_from_rectified(rig)
    rotation = cam1_from_rect1 @ Rotation.from_rotvec(turn_rad).as_matrix() @ cam1_from_rect1.T
    return replace(rig, body_from_cam1=rig.body_from_cam1 @ Pose("cam1", "cam1", rotation, np.zeros(3)))
