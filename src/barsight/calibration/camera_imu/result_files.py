"""Write a camera-IMU calibration: our rig file and Kalibr's camchain-imucam."""

from __future__ import annotations

from pathlib import Path

import numpy as np

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
    """Write both files, each whole or not at all.

    lenses: names and covariance of the lenses' parameters from the stereo calibration; they were held fixed,
    so their rows are carried over as they are.
    """
    names, covariance = mounting_covariance(calibration)
    if lenses is not None:
        kept = [n for n, name in enumerate(lenses[0]) if "_from_" not in name]
        own = lenses[1][np.ix_(kept, kept)]
        size = len(kept) + len(names)
        joined = np.zeros((size, size))
        joined[: len(kept), : len(kept)], joined[len(kept) :, len(kept) :] = own, covariance
        names, covariance = (*(lenses[0][n] for n in kept), *names), joined
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


def mounting_covariance(calibration: CameraImuCalibration) -> tuple[tuple[str, ...], Float64]:
    """Compute names and covariance of both mountings, time shifts and the resulting cam1_from_cam0.

    Turns are small, from the left: of body_from_cam in body axes, of cam1_from_cam0 in cam1's.
    """
    names = calibration.problem.parameter_names[: 2 * MOUNT]
    own = calibration.uncertainty.covariance[: 2 * MOUNT, : 2 * MOUNT]
    first, second = calibration.solution.state.mounts
    back = second.rotation.T
    pair = np.zeros((6, 2 * MOUNT))
    pair[:3, :3], pair[:3, MOUNT : MOUNT + 3] = back, -back
    pair[3:, 3:6], pair[3:, MOUNT + 3 : MOUNT + 6] = back, -back
    pair[3:, MOUNT : MOUNT + 3] = back @ skew(first.place_m - second.place_m)
    whole = np.vstack([np.eye(2 * MOUNT), pair])
    return (*names, *PAIR_NAMES), whole @ own @ whole.T
