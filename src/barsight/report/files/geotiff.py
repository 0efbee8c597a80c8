"""Write GeoTIFFs on the grid of a surface."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import tifffile

import barsight
from barsight.core.files import atomic_path
from barsight.mapping.surface.surface import Surface

TILE = 256
"""Side of a raster's tiles, in cells."""
Tag = tuple[int, str, int, Any, bool]
"""A tag as tifffile takes it: code, type, count, value, whether only the first page has it."""


def write_geotiff(
    surface: Surface, data: Any, target: Path, frame_id: str, no_data: str, tags: tuple[Tag, ...] = (),
    **options: Any,
) -> None:  # fmt: skip
    """Write a compressed GeoTIFF in tiles, row 0 at the highest y, completely or not at all.

    data: the raster, or its tiles in order, for which `options` of tifffile must state shape and dtype.
    no_data: the value that cells without any hold.
    """
    with atomic_path(target) as path:
        tifffile.imwrite(
            path, data, photometric="minisblack", tile=(TILE, TILE), compression="zlib", metadata=None,
            software=f"barsight {barsight.__version__}",
            extratags=[*_georeference(surface, frame_id), *tags, (42113, "s", 0, no_data, True)], **options,
        )  # fmt: skip


def _georeference(surface: Surface, frame_id: str) -> list[Tag]:
    """Make the georeferencing tags of a raster: a user-defined projected system (32767) that cites the frame,
    pixels as areas, m.
    """
    cell, citation = surface.cell_m, f"{frame_id}|"
    left, top = (surface.columns[0] - 0.5) * cell, (surface.rows[1] - 0.5) * cell
    cited = (1026, 34737, len(citation), 0)
    keys = (1, 1, 0, 5, 1024, 0, 1, 1, 1025, 0, 1, 1, *cited, 3072, 0, 1, 32767, 3076, 0, 1, 9001)
    return [
        (33550, "d", 3, (cell, cell, 0.0), True),
        (33922, "d", 6, (0.0, 0.0, 0.0, left, top, 0.0), True),
        (34735, "H", len(keys), keys, True),
        (34737, "s", 0, citation, True),
    ]
