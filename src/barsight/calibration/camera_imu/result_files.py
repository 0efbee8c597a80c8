"""Write a camera-IMU calibration as Barsight's rig file and Kalibr's camchain-imucam."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.linalg import block_diag

from barsight.calibration.camera_imu.calibration import CameraImuCalibration
from barsight.calibration.camera_imu.problem import MOUNT
from barsight.calibration.files.kalibr import write_camchain
from barsight.calibration.files.rig_file import write_rig_file
from barsight.calibration.files.rig_formats import TOPICS
from barsight.core.arrays import Float64
from barsight.core.pose import skew

PAIR_NAMES = tuple(
    f"cam1_from_cam0.{part}" for part in ("rx_rad", "ry_rad", "rz_rad", "tx_m", "ty_m", "tz_m")
)


def write_camera_imu(calibration: CameraImuCalibration, rig_path: Path, camchain_path: Path) -> None:
    """Write both files, each either completely or not at all."""
    names, covariance = joint_covariance(calibration)
    section: dict[str, object] = {
        "board": str(calibration.board),
        "corner_sigma_px": calibration.corner_px,
        "baseline_sigma_m": calibration.baseline_sigma_m,
        "timeshift_cam1_s": float(calibration.solution.state.mounts[1].shift_s),
        "parameters": list(names),
        "sigmas": [float(value) for value in np.sqrt(np.diag(covariance))],
        "covariance": [[float(value) for value in row] for row in covariance],
    }
    write_rig_file(rig_path, calibration.rig, section=section)
    write_camchain(camchain_path, calibration.rig, TOPICS)


def joint_covariance(calibration: CameraImuCalibration) -> tuple[tuple[str, ...], Float64]:
    """Compute names and joint covariance of the lenses (where known), mountings, time shifts and the
    resulting cam1_from_cam0. Lens errors are propagated to the mountings, which absorb them as far as they
    can.

    Rotations are small, from the left: of body_from_cam in body axes, of cam1_from_cam0 in cam1's.
    """
    names, whole = _by_mounts(calibration)
    known, mounts = calibration.uncertainty, slice(2 * MOUNT)
    if calibration.lenses is None:
        return names, whole @ known.covariance[mounts, mounts] @ whole.T
    lenses = len(known.lens_names)
    carry = np.zeros((lenses + len(names), lenses + 2 * MOUNT))
    carry[:lenses, :lenses] = np.eye(lenses)
    carry[lenses:] = whole @ np.hstack([known.by_lens[mounts], np.eye(2 * MOUNT)])
    apart = block_diag(calibration.lenses, known.covariance[mounts, mounts])
    return (*known.lens_names, *names), carry @ apart @ carry.T


def _by_mounts(calibration: CameraImuCalibration) -> tuple[tuple[str, ...], Float64]:
    """Differentiate mountings, time shifts and cam1_from_cam0 with respect to the mountings and time shifts:
    names (20,) and Jacobian (20, 14).
    """
    names = calibration.problem.parameter_names[: 2 * MOUNT]
    first, second = calibration.solution.state.mounts
    back = second.rotation.T
    pair = np.zeros((6, 2 * MOUNT))
    pair[:3, :3], pair[:3, MOUNT : MOUNT + 3] = back, -back
    pair[3:, 3:6], pair[3:, MOUNT + 3 : MOUNT + 6] = back, -back
    pair[3:, MOUNT : MOUNT + 3] = back @ skew(first.place_m - second.place_m)
    return (*names, *PAIR_NAMES), np.vstack([np.eye(2 * MOUNT), pair])
