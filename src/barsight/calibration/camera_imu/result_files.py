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


def write_camera_imu(
    calibration: CameraImuCalibration, rig_path: Path, camchain_path: Path,
    lenses: tuple[tuple[str, ...], Float64] | None,
) -> None:  # fmt: skip
    """Write both files, each either completely or not at all.

    lenses: names and covariance of the lens parameters from the stereo calibration. They were held fixed
    here, so their errors carry over to the mountings.
    """
    names, covariance = joint_covariance(calibration, lenses)
    section: dict[str, object] = {
        "board": str(calibration.board),
        "corner_sigma_px": calibration.corner_px,
        "baseline_sigma_m": _baseline_sigma_m(calibration, covariance),
        "timeshift_cam1_s": float(calibration.solution.state.mounts[1].shift_s),
        "parameters": list(names),
        "sigmas": [float(value) for value in np.sqrt(np.diag(covariance))],
        "covariance": [[float(value) for value in row] for row in covariance],
    }
    write_rig_file(rig_path, calibration.rig, section=section)
    write_camchain(camchain_path, calibration.rig, TOPICS)


def joint_covariance(
    calibration: CameraImuCalibration, lenses: tuple[tuple[str, ...], Float64] | None
) -> tuple[tuple[str, ...], Float64]:
    """Compute names and joint covariance of the lenses (where known), mountings, time shifts and the
    resulting cam1_from_cam0. Lens errors are propagated to the mountings, which absorb them as far as they
    can.

    Rotations are small, from the left: of body_from_cam in body axes, of cam1_from_cam0 in cam1's.
    """
    names, whole = _by_mounts(calibration)
    known, mounts = calibration.uncertainty, slice(2 * MOUNT)
    kept = [n for n, name in enumerate(lenses[0]) if name in known.lens_names] if lenses else []
    if lenses is None or len(kept) < len(known.lens_names):
        return names, whole @ known.covariance[mounts, mounts] @ whole.T
    lens_names = tuple(lenses[0][n] for n in kept)
    by_lens = known.by_lens[mounts, [known.lens_names.index(name) for name in lens_names]]
    carry = np.zeros((len(kept) + len(names), len(kept) + 2 * MOUNT))
    carry[: len(kept), : len(kept)] = np.eye(len(kept))
    carry[len(kept) :] = whole @ np.hstack([by_lens, np.eye(2 * MOUNT)])
    apart = block_diag(lenses[1][np.ix_(kept, kept)], known.covariance[mounts, mounts])
    return (*lens_names, *names), carry @ apart @ carry.T


def _baseline_sigma_m(calibration: CameraImuCalibration, covariance: Float64) -> float:
    """Compute the standard deviation of the distance between the cameras from the last three rows of the
    covariance, the translation of cam1_from_cam0.
    """
    first, second = calibration.solution.state.mounts
    place = second.rotation.T @ (first.place_m - second.place_m)
    direction = place / np.linalg.norm(place)
    return float(np.sqrt(direction @ covariance[-3:, -3:] @ direction))


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
