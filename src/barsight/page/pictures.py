"""Cut a bundle out of the orthophoto of a survey that saw it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from barsight.core.errors import InputError
from barsight.core.extras import extra
from barsight.core.reading.geotiff import open_geotiff
from barsight.store.tables import SIGHTINGS, SURVEYS

with extra("store"):
    from sqlalchemy import Connection, select

MARGIN_M, PIXEL_M = 0.3, 0.005
"""Margin shown around a bundle, and size of a pixel, m."""
MAX_LONG = 1600
"""Maximum picture length along a bundle in pixels."""


def paint_bundle(connection: Connection, number: int, map_id: str) -> bytes | None:
    """Paint the bundle as PNG, along the picture with its first end on the left.

    Returns None if the survey did not see it or its orthophoto is gone.
    """
    query = (
        select(SIGHTINGS.c.record, SURVEYS.c.folder)
        .join(SURVEYS)
        .where(SIGHTINGS.c.bundle_id == number, SURVEYS.c.map_id == map_id)
    )
    row = connection.execute(query).first()
    return None if row is None else _cut(Path(row.folder) / "ortho.tif", json.loads(row.record))


def _cut(path: Path, record: dict[str, Any]) -> bytes | None:
    ends = np.array(record["ends_m"], np.float64)[:, :2]
    along = (ends[1] - ends[0]) / max(float(np.hypot(*(ends[1] - ends[0]))), 1e-6)
    across = np.array([-along[1], along[0]])
    long_m = float((ends[1] - ends[0]) @ along) + 2 * MARGIN_M
    wide_m = float(record["width_m"]) + 2 * MARGIN_M
    pixel_m = max(PIXEL_M, long_m / MAX_LONG)
    size = round(long_m / pixel_m), round(wide_m / pixel_m)
    corner = ends[0] - MARGIN_M * along + wide_m / 2 * across
    box = np.array([corner + u * along - v * across for u in (0, long_m) for v in (0, wide_m)])
    try:
        with open_geotiff(path) as file:
            rows, columns = file.size
            low = np.array([file.left_m, file.top_m - rows * file.cell_m])
            first = np.maximum(np.floor((box.min(axis=0) - low) / file.cell_m), 0).astype(int)
            last = np.minimum(np.ceil((box.max(axis=0) - low) / file.cell_m), (columns, rows)).astype(int)
            if (last <= first).any():
                return None
            gray = file.rectangle(1, slice(first[1], last[1]), slice(first[0], last[0]))[0]
            cell_m = file.cell_m
    except (InputError, OSError, ValueError):
        return None
    at = (corner - low) / cell_m - first - 0.5
    step = pixel_m / cell_m
    taken = np.column_stack([along * step, -across * step, at])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return bytes(cv2.imencode(".png", cv2.warpAffine(gray, taken, size, flags=flags))[1].tobytes())
