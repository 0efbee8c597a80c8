"""Read and write Barsight's rig file: versioned YAML with the calibration's covariance.

docs/reference/rig-file.md describes the keys. Each release reads every version up to its own.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from barsight.calibration.boards.board import Board
from barsight.calibration.boards.board_warp import apply_shape
from barsight.calibration.files.euroc import build_rig, read_camera
from barsight.calibration.files.yaml_document import Document, read_document, write_document
from barsight.calibration.geometry.camera import Camera
from barsight.calibration.geometry.rig import StereoRig
from barsight.core.arrays import Float64
from barsight.core.errors import CalibrationError
from barsight.core.pose import Pose
from barsight.core.stamps import NS_PER_S, seconds_to_ns

VERSION_KEY = "barsight_rig"
VERSION = 1


def write_rig_file(path: Path, rig: StereoRig, section: Mapping[str, object] | None = None) -> None:
    """Write a rig and the key `calibration`, which states its uncertainty; the rig reads back bit for bit."""
    values: dict[str, object] = {
        VERSION_KEY: VERSION,
        "cam0": _camera(rig.cam0, rig.body_from_cam0),
        "cam1": _camera(rig.cam1, rig.body_from_cam1),
        "timeshift_cam_imu_s": rig.timeshift_cam_imu_ns / NS_PER_S,
        "baseline_m": rig.baseline_m,
    }
    if section is not None:
        values["calibration"] = dict(section)
    write_document(path, values)


def read_own_rig(document: Document) -> StereoRig:
    """Read the rig from a document with the key `barsight_rig`. Raises `CalibrationError`."""
    version = document.number(VERSION_KEY)
    if not 1 <= version <= VERSION:
        raise document.error(
            VERSION_KEY, f"version {version:g} is not known", f"this release reads 1 to {VERSION}"
        )
    cameras, mounts = [], []
    for name in ("cam0", "cam1"):
        section = document.section(name)
        cameras.append(read_camera(section, "distortion_coefficients"))
        mounts.append(section.pose("body_from_cam", "body", name))
    shift = seconds_to_ns(document.number("timeshift_cam_imu_s", 0.0))
    return build_rig(document.path, cameras[0], cameras[1], mounts[0], mounts[1], shift)


def read_serials(path: Path) -> tuple[str | None, str | None]:
    """Read the serial numbers of cam0 and cam1 (key `serial`) from a file of any format; None where it has
    none.
    """
    if path.is_dir():
        return None, None
    values = read_document(path).values
    cam0, cam1 = (values.get(name) for name in ("cam0", "cam1"))
    return _serial(cam0), _serial(cam1)


def _serial(section: object) -> str | None:
    serial = section.get("serial") if isinstance(section, Mapping) else None
    return None if serial is None else str(serial)


def read_covariance(path: Path) -> tuple[tuple[str, ...], Float64] | None:
    """Read the parameter names (C,) and covariance (C, C) from a rig file; None where it has none."""
    document = read_document(path)
    if document.values.get("calibration") is None:
        return None
    section = document.section("calibration")
    names = tuple(str(name) for name in section.get("parameters"))
    rows = section.get("covariance")
    if not isinstance(rows, list) or len(rows) != len(names):
        raise section.error("covariance", f"is not {len(names)}x{len(names)}", "take the original file")
    matrix = np.array([section.numbers_in("covariance", row) for row in rows], dtype=np.float64)
    if matrix.shape != (len(names), len(names)):
        raise section.error("covariance", f"is not {len(names)}x{len(names)}", "take the original file")
    return names, matrix


def read_board(path: Path, board: Board) -> Board:
    """Apply the board shape that `calibrate stereo` estimated, if the rig file comes from the same board."""
    section = read_document(path).values.get("calibration")
    if not isinstance(section, dict) or section.get("board") != str(board):
        return board
    try:
        return apply_shape(
            board, {name: float(entry["value"]) for name, entry in section["board_shape"].items()}
        )
    except (KeyError, TypeError, ValueError, AttributeError):
        raise CalibrationError(path, "board_shape can't be read", "take the original file") from None


def _camera(camera: Camera, body_from_cam: Pose) -> dict[str, object]:
    return {
        "camera_model": "pinhole",
        "resolution": [camera.width, camera.height],
        "intrinsics": [camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px],
        "distortion_model": str(camera.distortion),
        "distortion_coefficients": list(camera.coefficients),
        "body_from_cam": [[float(value) for value in row] for row in body_from_cam.matrix],
    }
