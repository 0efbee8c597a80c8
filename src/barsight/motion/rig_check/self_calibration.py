"""Apply a rig's drift: a warning where it matters, a corrected rig where that is requested, and the
disparity error that remains.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from barsight.calibration.geometry.rectification import Rectifier, right_from_rectified
from barsight.calibration.geometry.rig import StereoRig
from barsight.core.arrays import Float64
from barsight.core.pose import Pose
from barsight.core.records.trajectory import RigDrift

SIGNIFICANT_SIGMAS = 3.0
WORTH_MM = 3.0
AGREEING_SIGMAS = 1.96
"""Distance, in sigma, up to which the travel's yaw and scale agree with the calibration. For rigs that are
off as far as they admit, 95 % of the heights then lie inside (tests/test_motion_rig_drift.py).
"""


@dataclass(frozen=True)
class SelfCalibration:
    """Rectifier to measure with, messages about the drift, and the disparity error (px, one sigma) common to
    all points that the rig may still cause.
    """

    rectifier: Rectifier
    warnings: tuple[str, ...]
    sigma_px: float


def residual_covariance(prior: Float64, drift: RigDrift | None, *, corrected: bool) -> Float64:
    """Update a calibration's covariance of yaw, baseline and focal length (3, 3) by what the travel shows.

    The drift found counts as error, for nothing corrects it except the yaw where that is `corrected`. Then,
    or where the travel contradicts the calibration, the travel alone is believed. Only encoders show yaw and
    scale. The drift's prior isn't counted as shown by the travel: where that shows nothing, the calibration's
    covariance stays.
    """
    if drift is None or not drift.by_encoders:
        return prior
    rows, seen, variance = drift.by_travel()
    rows = rows * [1, -1]  # a baseline that is longer makes depths too small
    joint = rows @ prior[:2, :2] @ rows.T + np.diag(variance)
    if corrected or seen @ np.linalg.solve(joint, seen) > AGREEING_SIGMAS**2:
        left = np.array([drift.yaw_rad, -drift.scale]) * [not corrected, True]
        updated = prior.copy()
        updated[:2, :] = updated[:, :2] = 0.0
        updated[:2, :2] = drift.covariance * [[1, -1], [-1, 1]] + np.outer(left, left)
        return updated
    gain = prior[:, :2] @ rows.T @ np.linalg.inv(joint)
    mean = gain @ seen
    posterior: Float64 = prior - gain @ rows @ prior[:2] + np.outer(mean, mean)
    return posterior


def self_calibrate(
    rig: StereoRig, rectifier: Rectifier, drift: RigDrift | None, calibration_px: float, *, correct: bool
) -> SelfCalibration:
    """Turn the rig by the drift's yaw if `correct`, else leave it; the drift counts only with encoders.

    calibration_px: the disparity error (1 sigma) that the calibration itself admits.
    """
    if drift is None or not drift.by_encoders:
        reason = "nothing is self-calibrated: the yaw shows only with encoders in the fused estimate"
        return SelfCalibration(rectifier, (reason,) if correct else (), calibration_px)
    seen, sigma_px = (
        describe_drift(drift),
        residual_sigma_px(drift, rectifier.camera.focal_px, calibration_px, correct),
    )
    if correct:
        corrected = turn_right_camera(rig, np.array([0.0, drift.yaw_rad, 0.0]))
        return SelfCalibration(Rectifier(corrected), (f"the rig is self-calibrated: {seen}",), sigma_px)
    warnings = (f"{seen}; calibrate anew, if both cameras expose at once",) if is_drifted(drift) else ()
    return SelfCalibration(rectifier, warnings, sigma_px)


def residual_sigma_px(drift: RigDrift, focal_px: float, calibration_px: float, corrected: bool) -> float:
    """Compute the disparity error (1 sigma) left by yaw and scale straight ahead at the points' median depth.

    Where the travel agrees with the calibration, both are believed; the calibration's yaw no longer counts
    once it is `corrected`. Where they contradict, the travel alone is believed, and the drift that it found
    counts as error, the yaw unless it is `corrected`.
    """
    found, covariance = np.array([drift.yaw_rad, drift.scale]), drift.covariance
    by = np.array([focal_px, focal_px * drift.baseline_m / drift.range_m])
    off = 0.0
    if found @ np.linalg.solve(covariance, found) > AGREEING_SIGMAS**2:
        off = float(by @ (found * [not corrected, True]))
    elif not corrected:
        gain = covariance[0] / (covariance[0, 0] + (calibration_px / focal_px) ** 2)
        covariance = covariance - np.outer(gain, covariance[0])
    return float(np.sqrt(by @ covariance @ by + off**2))


def is_drifted(drift: RigDrift) -> bool:
    """Check whether the yaw is beyond 3 sigma and costs more than a few millimetres."""
    significant = abs(drift.yaw_rad) > SIGNIFICANT_SIGMAS * drift.yaw_sigma_rad
    return significant and abs(1e3 * drift.depth_error_m(drift.range_m)) > WORTH_MM


def describe_drift(drift: RigDrift) -> str:
    """Describe the yaw and the depth error that it causes in a sentence."""
    yaw, sigma = np.degrees([drift.yaw_rad, drift.yaw_sigma_rad])
    cost = 1e3 * drift.depth_error_m(drift.range_m)
    return (
        f"the right camera has turned by {yaw:.4f} ± {sigma:.4f} degrees, "
        f"which moves depths at {drift.range_m:.1f} m by {cost:+.1f} mm"
    )


def turn_right_camera(rig: StereoRig, turn_rad: np.ndarray) -> StereoRig:
    """Turn the rig's right camera by a rotation vector (3,) in its rectified axes."""
    cam1_from_rect1 = right_from_rectified(rig)
    rotation = cam1_from_rect1 @ Rotation.from_rotvec(turn_rad).as_matrix() @ cam1_from_rect1.T
    return replace(rig, body_from_cam1=rig.body_from_cam1 @ Pose("cam1", "cam1", rotation, np.zeros(3)))
