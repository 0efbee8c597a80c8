"""Write the orthophoto: each cell's gray level, as a GeoTIFF on height.tif's grid and as a PNG."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from barsight.core.arrays import UInt8
from barsight.core.files import atomic_path
from barsight.mapping.passes.changes import PlaceHistory
from barsight.mapping.surface.surface import Surface, gray_levels
from barsight.mapping.top_photo import TopPhoto
from barsight.report.files.geotiff import write_geotiff

NO_DATA = 0
_COLUMNS = 1024
"""Number of the map's columns that are read at once."""


def orthophoto(surface: Surface) -> UInt8:
    """Render gray levels (rows, columns) from 1, NO_DATA if no view saw the cell; row 0 at the highest y."""
    rows, columns = surface.shape
    picture = np.empty((rows, columns), np.uint8)
    for column in range(0, columns, _COLUMNS):
        width = min(_COLUMNS, columns - column)
        part = surface.window(surface.columns[0] + column, surface.rows[0], width, rows)
        picture[:, column : column + width] = gray_levels(part.intensity)[::-1]
    return picture


def write_orthophoto(surface: Surface, folder: Path, frame_id: str) -> None:
    """Write ortho.tif and ortho.png, each completely or not at all."""
    picture = orthophoto(surface)
    _write_gray(surface, picture, folder / "ortho.tif", frame_id)
    with atomic_path(folder / "ortho.png") as path:
        path.write_bytes(cv2.imencode(".png", picture)[1].tobytes())


def write_top_photo(surface: Surface, tops: TopPhoto, target: Path, frame_id: str) -> None:
    """Write the pictures' mean gray level at the height of the tops, on height.tif's grid."""
    rows, columns = surface.shape
    photo = tops.window(surface.columns[0], surface.rows[0], columns, rows)[::-1]
    _write_gray(surface, photo, target, frame_id)


def write_passes(surface: Surface, history: PlaceHistory, target: Path, frame_id: str) -> None:
    """Write the number (from 1) of the pass that saw each cell last, on height.tif's grid."""
    x_m, y_m = (
        surface.cell_m * (first[0] + np.arange(count))
        for first, count in ((surface.columns, surface.shape[1]), (surface.rows, surface.shape[0]))
    )
    _write_gray(surface, history.newest_pass(x_m, y_m)[::-1], target, frame_id)


def _write_gray(surface: Surface, picture: UInt8, target: Path, frame_id: str) -> None:
    write_geotiff(surface, picture, target, frame_id, str(NO_DATA))
