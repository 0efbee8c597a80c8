"""Read and write rigs in any format: Barsight's own, Kalibr's camchain, OpenCV's, or an EuRoC folder."""

from __future__ import annotations

from dataclasses import replace
from enum import StrEnum
from pathlib import Path

import numpy as np

from barsight.calibration.files.euroc import read_rig, write_rig
from barsight.calibration.files.kalibr import read_camchain, write_camchain
from barsight.calibration.files.kalibr_lens import rig_for_kalibr
from barsight.calibration.files.opencv import read_opencv_rig, write_opencv_rig
from barsight.calibration.files.rig_file import VERSION_KEY, read_own_rig, write_rig_file
from barsight.calibration.files.yaml_document import read_document
from barsight.calibration.geometry.rig import StereoRig
from barsight.core.errors import CalibrationError, Failed
from barsight.core.files import atomic_directory, atomic_path
from barsight.core.reading.bounded_reading import MAX_SETTINGS_BYTES, read_text

OPENCV_MARK = "!!opencv-matrix"
TOPICS = ("/cam0/image_raw", "/cam1/image_raw")
KNOWN = "a rig.yaml of barsight, Kalibr's camchain, OpenCV's YAML or XML, or an EuRoC folder"


class RigFormat(StrEnum):
    """Formats in which a rig can be written. EUROC is a folder, the others are files."""

    BARSIGHT = "barsight"
    KALIBR = "kalibr"
    OPENCV = "opencv"
    EUROC = "euroc"


def read_rig_file(path: Path) -> StereoRig:
    """Read the rig at `path` in any known format. Raises `CalibrationError`."""
    if path.is_dir():
        return read_rig(path / "mav0" if (path / "mav0").is_dir() else path)
    if path.suffix.lower() == ".xml" or _is_opencv(path):
        return read_opencv_rig(path)
    document = read_document(path)
    if VERSION_KEY in document.values:
        return read_own_rig(document)
    if "cam0" in document.values:
        return read_camchain(path).rig
    raise CalibrationError(path, "holds no stereo rig", f"give {KNOWN}")


def holds_own_rig(path: Path) -> bool:
    """Check for a rig file in Barsight's own format, the only one with a covariance."""
    if path.is_dir() or path.suffix.lower() == ".xml" or _is_opencv(path):
        return False
    return VERSION_KEY in read_document(path).values


def select_rig(path: Path | None, own: StereoRig) -> StereoRig:
    """Select the rig from a file that the user names, or else the recording's `own`.

    A calibration of the two cameras alone does not know the body, so cam0's mounting and the time shift are
    taken from `own`.
    """
    if path is None:
        return own
    rig = read_rig_file(path)
    if not body_is_cam0(rig):
        return rig
    return replace(
        rig, body_from_cam0=own.body_from_cam0, body_from_cam1=own.body_from_cam0 @ rig.cam0_from_cam1,
        timeshift_cam_imu_ns=own.timeshift_cam_imu_ns,
    )  # fmt: skip


def body_is_cam0(rig: StereoRig) -> bool:
    """Check whether the rig's body is its left camera, that is, no mounting on an IMU is known."""
    return bool(np.array_equal(rig.body_from_cam0.matrix, np.eye(4)))


def write_any_rig(path: Path, rig: StereoRig, form: RigFormat) -> float:
    """Write a rig completely or not at all. The suffix of an OpenCV file selects YAML or XML.

    Returns the maximum error of the written lenses in px: those of Kalibr take four coefficients only.
    Raises CalibrationError where a lens can't be expressed in the format.
    """
    off_px = 0.0
    if form is RigFormat.KALIBR:
        fitted = rig_for_kalibr(rig)
        if isinstance(fitted, Failed):
            raise CalibrationError(path, fitted.reason, "calibrate with --lens radtan4 or equidistant")
        rig, off_px = fitted
    if form is RigFormat.EUROC:
        with atomic_directory(path) as folder:
            write_rig(folder / "mav0", rig, 0.0)
        return off_px
    with atomic_path(path) as temporary:
        if form is RigFormat.KALIBR:
            write_camchain(temporary, rig, TOPICS)
        elif form is RigFormat.OPENCV:
            write_opencv_rig(temporary, rig, xml=path.suffix.lower() == ".xml")
        else:
            write_rig_file(temporary, rig)
    return off_px


def _is_opencv(path: Path) -> bool:
    return OPENCV_MARK in read_text(path, MAX_SETTINGS_BYTES, f"give {KNOWN}", CalibrationError)
