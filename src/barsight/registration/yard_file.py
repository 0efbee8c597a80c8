"""Read and write `yard.yaml`: a frame's pose in the yard, its covariance, and the rig and crane it holds
for.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from barsight.calibration.files.yaml_document import Document, canonical_pose, read_document, write_document
from barsight.core.arrays import Float64
from barsight.core.errors import CalibrationError
from barsight.core.pose import Pose, nearest_rotation
from barsight.core.reading.bounded_reading import MAX_DOCUMENT_BYTES, read_bytes
from barsight.registration.bending import BENDS, CraneBend
from barsight.registration.yard import YardCalibration

FRAMES = ("world", "encoders", "body")
REMEDY = "take the file that barsight calibrate yard wrote"
MAX_BENDS = (0.2, 0.02, 0.2)
"""Maximum absolute value of each bend; no crane in use bends more."""
MIN_SPAN_M, MAX_SPAN_M = 1.0, 1000.0
OWNERS = ("calibration_id", "mounting_id", "recording_id")


@dataclass(frozen=True, eq=False)
class YardFrame:
    """yard_from: the yard from one of `FRAMES`; covariance (6, 6) as in `Alignment`.

    yard_from_body: (3, 3) the rig's attitude, where crane moves showed it. calibration_id: of the rig,
    mounting_id: of its attitude according to the encoders, recording_id: of the inputs in whose frame the
    points were measured; None where the file doesn't say. doubts: of the calibration. digest: SHA-256 of the
    file. bend: the crane's bending, which no encoder measures; None where it is taken as stiff. targets_m:
    (N, 3) in the yard, from which the frame was found; None where the file doesn't say.
    """

    path: Path
    yard_from: Pose
    covariance: Float64
    yard_from_body: Float64 | None
    calibration_id: str | None
    mounting_id: str | None
    recording_id: str | None
    doubts: tuple[str, ...]
    digest: str
    bend: CraneBend | None = None
    targets_m: Float64 | None = None

    @property
    def attitude(self) -> Float64 | None:
        """Return the rig's attitude (3, 3), yard from body, where the file contains it."""
        return self.yard_from.rotation if self.yard_from.source == "body" else self.yard_from_body


def write_yard_file(
    path: Path, found: YardCalibration, hangs: Float64 | None, owners: dict[str, str | None],
    bend: CraneBend | None = None,
) -> None:  # fmt: skip
    """Write a calibration. hangs: (3, 3) yard from body, or None. owners: values of `OWNERS`. bend: of the
    crane, where it was fitted.
    """
    pose = found.alignment.target_from_source
    content: dict[str, Any] = {
        "barsight_yard": 1,
        f"yard_from_{pose.source}": pose.matrix.tolist(),
        "covariance": found.alignment.covariance.tolist(),
        "scale": found.alignment.scale,
        "scale_sigma": found.alignment.scale_sigma,
        "points": int((~found.checks).sum()),
        "rms_m": found.rms_m,
        "targets_m": found.yard_m[~found.checks].tolist(),
        "doubts": list(found.doubts),
        **{name: value for name, value in owners.items() if value is not None},
    }
    if hangs is not None:
        content["R_yard_body"] = hangs.tolist()
    if bend is not None:
        content["bend"] = {
            "girder_y_m": list(bend.girder_y_m),
            "rails_x_m": None if bend.rails_x_m is None else list(bend.rails_x_m),
            **dict(zip(BENDS, bend.values.tolist(), strict=True)),
            "covariance": bend.covariance.tolist(),
        }
    write_document(path, content)


def read_yard_file(path: Path) -> YardFrame:
    """Read a yard file. Raises CalibrationError naming the file and the invalid value."""
    document = read_document(path)
    if document.values.get("barsight_yard") != 1:
        raise CalibrationError(path, "is not a yard file (barsight_yard: 1 is missing)", REMEDY)
    frames = [name for name in FRAMES if f"yard_from_{name}" in document.values]
    if len(frames) != 1:
        raise CalibrationError(path, "must hold one of yard_from_world, _encoders, _body", REMEDY)
    pose = canonical_pose("yard", frames[0], _matrix(document, f"yard_from_{frames[0]}"))
    owners = {name: document.values.get(name) for name in OWNERS}
    for name, value in owners.items():
        if value is not None and not isinstance(value, str):
            raise document.error(name, "is not text", REMEDY)
    doubts = document.values.get("doubts")
    return YardFrame(
        path, pose, _covariance(document), _attitude(document), owners["calibration_id"],
        owners["mounting_id"], owners["recording_id"],
        tuple(str(one) for one in doubts) if isinstance(doubts, list) else (),
        hashlib.sha256(read_bytes(path, MAX_DOCUMENT_BYTES)).hexdigest(), _bend(document, frames[0]),
        _targets(document),
    )  # fmt: skip


def _matrix(document: Document, key: str) -> Float64:
    document.pose(key, "yard", "source")
    return document.matrix(key)


def _rows(document: Document, key: str, size: int) -> Float64:
    value = document.get(key)
    if not isinstance(value, list) or [len(r) if isinstance(r, list) else 0 for r in value] != [size] * size:
        raise document.error(key, f"is not a {size}x{size} matrix", REMEDY)
    numbers = document.numbers_in(key, [number for row in value for number in row])
    return np.array(numbers, np.float64).reshape(size, size)


def _targets(document: Document) -> Float64 | None:
    rows = document.values.get("targets_m")
    if rows is None:
        return None
    if not isinstance(rows, list) or any(not isinstance(row, list) or len(row) != 3 for row in rows):
        raise document.error("targets_m", "is not a list of x, y, z", REMEDY)
    numbers = document.numbers_in("targets_m", [number for row in rows for number in row])
    return np.array(numbers, np.float64).reshape(-1, 3)


def _bend(document: Document, frame: str) -> CraneBend | None:
    if document.values.get("bend") is None:
        return None
    section = document.section("bend")
    if frame != "encoders":
        raise document.error("bend", "stands with a frame that isn't the encoders'", REMEDY)
    has_rails = section.values.get("rails_x_m") is not None
    girder, rails = _ends(section, "girder_y_m"), _ends(section, "rails_x_m") if has_rails else None
    values = np.array([section.number(name) for name in BENDS])
    for name, value, most in zip(BENDS, values, MAX_BENDS, strict=True):
        if abs(value) > most:
            raise section.error(name, f"can't be {value:g}", REMEDY)
    return CraneBend(girder, rails, values, _covariance(section, 9))


def _ends(section: Document, key: str) -> tuple[float, float]:
    low, high = section.numbers(key, 2)
    if not MIN_SPAN_M <= high - low <= MAX_SPAN_M:
        raise section.error(key, f"can't be {low:g} to {high:g} m", REMEDY)
    return low, high


def _covariance(document: Document, size: int = 6) -> Float64:
    covariance = _rows(document, "covariance", size)
    whole = (covariance + covariance.T) / 2
    off = np.abs(covariance - covariance.T).max()
    if off > 1e-6 * np.abs(whole).max() or np.linalg.eigvalsh(whole).min() < -1e-9 * np.abs(whole).max():
        raise document.error("covariance", "can't be one (not symmetric or negative)", REMEDY)
    return whole


def _attitude(document: Document) -> Float64 | None:
    if document.values.get("R_yard_body") is None:
        return None
    matrix = _rows(document, "R_yard_body", 3)
    if np.abs(matrix @ matrix.T - np.eye(3)).max() > 1e-4 or np.linalg.det(matrix) < 0:
        raise document.error("R_yard_body", "is not a rotation", REMEDY)
    return nearest_rotation(matrix)
