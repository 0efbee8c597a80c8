"""Read and write stereo rigs in OpenCV's YAML, XML or JSON (M1 D1 M2 D2 R T, as in its stereo sample).

R and T are cam1_from_cam0, with T in metres. OpenCV's own files lack the picture size, so `image_width` and
`image_height` must be added. The key `distortion_model: equidistant` marks fisheye lenses.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from barsight.calibration.files.euroc import DISTORTION_NAMES, build_rig
from barsight.calibration.files.yaml_document import canonical_pose
from barsight.calibration.geometry.camera import COEFFICIENT_COUNTS, Camera, Distortion
from barsight.calibration.geometry.rig import StereoRig
from barsight.core.arrays import Float64
from barsight.core.errors import CalibrationError
from barsight.core.pose import Pose
from barsight.core.reading.bounded_reading import MAX_DEPTH, MAX_SETTINGS_BYTES, in_range, read_text

KEYS = {
    "M1": ("M1", "K1", "cameraMatrix1", "camera_matrix_1"), "D1": ("D1", "distCoeffs1", "dist_coeffs_1"),
    "M2": ("M2", "K2", "cameraMatrix2", "camera_matrix_2"), "D2": ("D2", "distCoeffs2", "dist_coeffs_2"),
    "R": ("R",), "T": ("T",),
}  # fmt: skip
LONGEST_BASELINE_M = 20.0
BASE64 = re.compile(r"!!\s*binary|type_id\s*=\s*[\"']binary|\$base64\$")
ORIGINAL = "take the calibration's original file"


def read_opencv_rig(path: Path) -> StereoRig:
    """Read the rig from one OpenCV file, or from `intrinsics` and the `extrinsics` of the same suffix beside
    it.

    The body is cam0. Raises `CalibrationError` that names the missing or invalid key.
    """
    found = _matrices(path)
    beside = path.with_name(f"extrinsics{path.suffix}")
    if "R" not in found and path.stem == "intrinsics" and beside.is_file():
        found |= {key: value for key, value in _matrices(beside).items() if key in ("R", "T")}
    for key, names in KEYS.items():
        if key not in found:
            raise CalibrationError(
                path, f"{' or '.join(names[:3])} is missing", "add it, or convert from Kalibr"
            )
    width, height = found.get("width"), found.get("height")
    if width is None or height is None:
        raise CalibrationError(
            path, "doesn't say the pictures' size", "add image_width: and image_height: to the file"
        )
    size = int(width[0, 0]), int(height[0, 0])
    is_fisheye = "fisheye" in found
    cameras = [_camera(path, found[f"M{n}"], found[f"D{n}"], size, is_fisheye, n) for n in (1, 2)]
    if found["T"].size != 3 or found["R"].shape != (3, 3):
        raise CalibrationError(path, "R must be 3x3 and T have three numbers", ORIGINAL)
    length = float(np.linalg.norm(found["T"]))
    if length > LONGEST_BASELINE_M:
        raise CalibrationError(path, f"T is {length:.4g} m long, so it is probably in mm", "divide T by 1000")
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = found["R"], found["T"].ravel()
    try:
        right = canonical_pose("body", "cam1", matrix, inverted=True)
    except ValueError as error:
        raise CalibrationError(path, f"R: {error}", ORIGINAL) from None
    return build_rig(path, cameras[0], cameras[1], Pose.identity("body", "cam0"), right, 0)


def write_opencv_rig(path: Path, rig: StereoRig, *, xml: bool = False) -> None:
    """Write a file that `read_opencv_rig` reads; such files do not hold the rig's mounting on the body."""
    form = cv2.FILE_STORAGE_FORMAT_XML if xml else cv2.FILE_STORAGE_FORMAT_YAML
    # When it writes the file itself, OpenCV ignores the errors of a full disk.
    storage = cv2.FileStorage("", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY | form)
    pose = rig.cam0_from_cam1.inverse()
    storage.write("image_width", rig.cam0.width)
    storage.write("image_height", rig.cam0.height)
    storage.write("distortion_model", str(rig.cam0.distortion))
    for number, camera in enumerate((rig.cam0, rig.cam1), 1):
        storage.write(f"M{number}", camera.matrix)
        storage.write(f"D{number}", np.array([camera.coefficients or (0.0,) * 4], dtype=np.float64))
    storage.write("R", np.ascontiguousarray(pose.rotation))
    storage.write("T", np.array(pose.translation).reshape(3, 1))
    path.write_text(storage.releaseAndGetString(), encoding="utf-8")


def _matrices(path: Path) -> dict[str, Float64]:
    """Read the known entries as matrices; `fisheye` is among them where the lenses are fisheyes."""
    text = read_text(path, MAX_SETTINGS_BYTES, ORIGINAL, CalibrationError)
    if _depth(text) > MAX_DEPTH:
        raise CalibrationError(path, f"brackets nested over {MAX_DEPTH} deep", ORIGINAL)
    if BASE64.search(text):
        raise CalibrationError(path, "holds base64, whose reader may not end", "write its numbers as text")
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        root = storage.root()
        names = set(root.keys()) if storage.isOpened() else set()
    except (cv2.error, SystemError):
        names = set()
    if not names:
        raise CalibrationError(path, "is not a file that OpenCV reads", ORIGINAL)
    found: dict[str, Float64] = {}
    for key, spellings in KEYS.items():
        for name in spellings:
            matrix = _matrix(path, storage, name) if name in names else None
            if matrix is not None and key not in found:
                found[key] = np.asarray(matrix, dtype=np.float64)
                if not in_range(found[key]).all():
                    raise CalibrationError(path, f"{name} is not finite or out of range", ORIGINAL)
    for key in ("width", "height"):
        for name in (f"image_{key}", f"image{key.title()}", key):
            if name in names and storage.getNode(name).isReal() | storage.getNode(name).isInt():
                found.setdefault(key, np.array([[storage.getNode(name).real()]]))
    model = storage.getNode("distortion_model").string() if "distortion_model" in names else ""
    if DISTORTION_NAMES.get(model.lower()) is Distortion.EQUIDISTANT:
        found["fisheye"] = np.ones((1, 1))
    return found


def _depth(text: str) -> int:
    """Compute the maximum nesting depth of brackets, tags and inline lists. OpenCV's parser recurses into
    each level and would overflow its stack.
    """
    spoken = re.sub(r"#.*", "", text)
    depth, deepest = 0, max((run[0].count("-") for run in re.finditer(r"(?:-[ \t]*)+", spoken)), default=0)
    for sign in re.finditer(r"[\[{\]}]|</|/>|<\w", text):
        depth += -1 if sign[0] in ("]", "}", "</", "/>") else 1
        deepest = max(deepest, depth)
    return deepest


def _matrix(path: Path, storage: cv2.FileStorage, name: str) -> Any:
    try:
        return storage.getNode(name).mat()
    except (cv2.error, SystemError):
        raise CalibrationError(path, f"{name} is not a matrix", ORIGINAL) from None


def _camera(
    path: Path, matrix: Float64, coefficients: Float64, size: tuple[int, int], is_fisheye: bool, number: int
) -> Camera:
    if matrix.shape != (3, 3) or abs(matrix[0, 1]) > 1e-9:
        raise CalibrationError(path, f"M{number} is not a 3x3 matrix without skew", ORIGINAL)
    values = tuple(float(value) for value in coefficients.ravel())
    while len(values) > 8 and values[-1] == 0:
        values = values[:-1]
    kind = Distortion.EQUIDISTANT if is_fisheye else Distortion.RADTAN
    longer = [count for count in COEFFICIENT_COUNTS[kind] if count >= len(values)]
    if not longer:
        raise CalibrationError(
            path,
            f"D{number} has {len(values)} coefficients; at most 8 are supported",
            "calibrate with 4, 5 or 8",
        )
    values += (0.0,) * (longer[0] - len(values))
    try:
        fx, fy, cx, cy = matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]
        return Camera(*size, float(fx), float(fy), float(cx), float(cy), kind, values)
    except ValueError as error:
        raise CalibrationError(path, f"M{number}: {error}", ORIGINAL) from None
