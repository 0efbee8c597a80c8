"""Pack a survey's surface and the lines over it for the 3D screen: the viewer's points in one document."""

from __future__ import annotations

import functools
import json
import struct
from pathlib import Path

import numpy as np

from barsight.core.extras import extra
from barsight.page.access import AccessError
from barsight.page.survey_files import expect_map, survey_folder
from barsight.result_folder import read_heights
from barsight.viewer.cloud import colour_layer, surface_layer
from barsight.viewer.yard_lines import yard_lines

with extra("store"):
    from sqlalchemy import Connection

COLOURS = ("height", "sigma", "views", "source")
MAX_POINTS = 400_000
_KEPT = 4


def survey_model(connection: Connection, map_id: str, by: str) -> bytes:
    """Pack a survey's surface, coloured by one of COLOURS, with the bundles' boxes and axes and the poles.

    Format: four bytes with the length of a JSON head, the head, (N, 3) float32 points, (M, 2, 3) float32 ends
    of lines, (N, 3) uint8 colours. Raises AccessError if there is no such survey, InputError if its folder
    isn't as it was added.
    """
    if by not in COLOURS:
        raise AccessError(404, f"there is no survey {map_id} with {by}")
    return _packed(survey_folder(connection, map_id), map_id, by)


@functools.lru_cache(maxsize=_KEPT)
def _packed(folder: Path, map_id: str, by: str) -> bytes:
    expect_map(folder, map_id)
    layer = surface_layer(read_heights(folder), MAX_POINTS)
    if not layer.total:
        raise AccessError(404, f"no height of map {map_id} is known")
    coloured, lines = colour_layer(layer, by), yard_lines(folder)
    head = {
        "points": len(layer.xyz_m), "total": layer.total, "caption": coloured.caption,
        "ramp": coloured.ramp[::17].tolist(),
        "lines": [[name, len(segments)] for name, segments in lines.items()],
    }  # fmt: skip
    text = json.dumps(head).encode()
    text += b" " * (-len(text) % 4)
    segments = [np.ascontiguousarray(one, "<f4").tobytes() for one in lines.values()]
    places = np.ascontiguousarray(layer.xyz_m, "<f4").tobytes()
    return b"".join([struct.pack("<I", len(text)), text, places, *segments, coloured.rgb.tobytes()])
