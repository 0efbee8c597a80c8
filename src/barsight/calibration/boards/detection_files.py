"""Read corners that were detected elsewhere, from `cam0_detections.npz` and `cam1_detections.npz`.

Each file holds `detections`, a structured array of stamp_ns, tag, corner, u, v (px) and x, y, z (m, on the
board).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from barsight.calibration.boards.board import Board
from barsight.calibration.boards.board_views import BoardView, Corners
from barsight.core.errors import CalibrationError
from barsight.core.reading.bounded_reading import read_arrays

NAMES = ("cam0_detections.npz", "cam1_detections.npz")
FIELDS = ("stamp_ns", "u", "v", "x", "y")
SAME_POINT = 0.02


def has_detections(folder: Path) -> bool:
    """Check whether `folder` holds the detections of both cameras."""
    return all((folder / name).is_file() for name in NAMES)


def read_detections(folder: Path, board: Board) -> list[BoardView]:
    """Read one view for each stamp of either camera. Raises CalibrationError where the files don't fit the
    board.
    """
    cameras = [_read(folder / name, board) for name in NAMES]
    stamps = sorted({*cameras[0], *cameras[1]})
    return [BoardView(str(stamp), cameras[0].get(stamp), cameras[1].get(stamp)) for stamp in stamps]


def read_rows(path: Path, fields: tuple[str, ...] = FIELDS) -> Any:
    """Read one camera's structured array.

    Raises CalibrationError where a field is missing or not finite.
    """
    rows = read_arrays(path, kind=CalibrationError).get("detections")
    if rows is None or rows.ndim != 1:
        raise CalibrationError(path, "holds no list of detections", "take the original file")
    missing = [field for field in fields if field not in (rows.dtype.names or ())]
    if missing:
        raise CalibrationError(
            path, f"lacks {', '.join(missing)}", "write every field of docs/reference/recordings.md"
        )
    finite = np.isfinite(rows["u"]) & np.isfinite(rows["v"])
    if not finite.all():
        count = int((~finite).sum())
        raise CalibrationError(
            path, f"{count} corners' pixels are NaN or infinite", "leave those corners out"
        )
    return rows


def _read(path: Path, board: Board) -> dict[int, Corners]:
    rows = read_rows(path)
    points = board.points_m
    place = np.column_stack([rows["x"], rows["y"]]).astype(np.float64)
    ids = np.asarray(KDTree(points[:, :2]).query(place)[1], dtype=np.int64)
    far = np.linalg.norm(points[ids, :2] - place, axis=1) > SAME_POINT * board.size_m
    if far.any():
        raise CalibrationError(
            path,
            f"{int(far.sum())} of {far.size} corners lie where {board} has none",
            "give the board these corners were detected on",
        )
    pixels = np.column_stack([rows["u"], rows["v"]]).astype(np.float64)
    views = {}
    for stamp in np.unique(rows["stamp_ns"]):
        chosen = np.flatnonzero(rows["stamp_ns"] == stamp)
        unique, first = np.unique(ids[chosen], return_index=True)
        views[int(stamp)] = Corners(unique.astype(np.int64), pixels[chosen[first]])
    return views
