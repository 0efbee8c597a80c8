"""Paint the yard from above: for each survey the places that no later one saw, unknown places left blank."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from barsight.core.arrays import Bool, UInt8
from barsight.core.errors import InputError
from barsight.core.extras import extra
from barsight.core.reading.geotiff import open_geotiff
from barsight.report.map_images import hillshade
from barsight.store.promotion import counts
from barsight.store.tables import SURVEYS
from barsight.yard.inventory.coarse_map import unpack
from barsight.yard.map_lookup import nearest_cells
from barsight.yard.types import HeightMap

with extra("store"):
    from sqlalchemy import Connection, select

Kind = Literal["photo", "height"]
MAX_PIXELS = 4_000_000
_DARK, _LIGHT = 110.0, 225.0
_KEPT = 64


@dataclass(frozen=True, eq=False)
class SurveyLayer:
    """Places that one survey was last to see. shown: (rows, columns) of its coarse heights, from low y."""

    map_id: str
    seen_ns: int
    folder: Path
    heights: HeightMap
    shown: Bool

    def content(self) -> dict[str, Any]:
        """Describe its extent: outer edges in m."""
        return {"map_id": self.map_id, "seen_ns": self.seen_ns, "edges_m": edges(self.heights)}


def edges(heights: HeightMap) -> list[float]:
    """Compute the outer edges: smallest x, smallest y, largest x, largest y, in m."""
    rows, columns = heights.shape
    left, low = heights.x0_m - heights.cell_m / 2, heights.y0_m - heights.cell_m / 2
    return [left, low, left + columns * heights.cell_m, low + rows * heights.cell_m]


def find_layers(connection: Connection, at_ns: int | None = None) -> tuple[SurveyLayer, ...]:
    """Divide the yard at a time among its surveys, each place to the newest that saw it; oldest first."""
    query = select(SURVEYS.c.map_id, SURVEYS.c.captured_to_ns, SURVEYS.c.folder, SURVEYS.c.heights).where(
        counts()
    )
    if at_ns is not None:
        query = query.where(SURVEYS.c.captured_to_ns <= at_ns)
    rows = connection.execute(query.order_by(SURVEYS.c.captured_to_ns.desc(), SURVEYS.c.id.desc())).all()
    later: list[HeightMap] = []
    layers = []
    for row in rows:
        heights = unpack(row.heights)
        shown = np.isfinite(heights.z_m)
        for other in later:
            shown &= ~_known_at(other, heights)
        if shown.any():
            layers.append(SurveyLayer(row.map_id, row.captured_to_ns, Path(row.folder), heights, shown))
            later.append(heights)
    return tuple(reversed(layers))


def newest_at(layers: tuple[SurveyLayer, ...], at_m: tuple[float, float]) -> int | None:
    """Return when a place (x, y) was last seen, ns; None if no survey saw it."""
    for layer in reversed(layers):
        column, row, inside = nearest_cells(layer.heights, *np.array(at_m).reshape(2, 1))
        if inside[0] and layer.shown[row[0], column[0]]:
            return layer.seen_ns
    return None


def _known_at(other: HeightMap, heights: HeightMap) -> Bool:
    """Check for each cell of `heights` whether it is known to `other`."""
    columns = np.round((heights.x_m - other.x0_m) / other.cell_m).astype(int)
    rows = np.round((heights.y_m - other.y0_m) / other.cell_m).astype(int)
    inside = ((rows >= 0) & (rows < other.shape[0]))[:, None] & ((columns >= 0) & (columns < other.shape[1]))
    known = np.isfinite(other.z_m)[
        np.ix_(rows.clip(0, other.shape[0] - 1), columns.clip(0, other.shape[1] - 1))
    ]
    return np.asarray(inside & known)


def paint_layer(layer: SurveyLayer, kind: Kind) -> bytes:
    """Paint a layer as PNG, gray with alpha, row 0 at the highest y.

    The photo is the folder's ortho.tif, or the store's coarse heights if that no longer exists.
    """
    gray = _photo(layer) if kind == "photo" else None
    if gray is None:
        gray = _shaded(layer.heights)
    size = (gray.shape[1], gray.shape[0])
    shown = cv2.resize(layer.shown.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    alpha = np.where((shown > 0) & (gray > 0), 255, 0).astype(np.uint8)
    picture = np.dstack([gray, gray, gray, alpha])[::-1]
    return bytes(cv2.imencode(".png", picture, [cv2.IMWRITE_PNG_COMPRESSION, 3])[1].tobytes())


def _photo(layer: SurveyLayer) -> UInt8 | None:
    path = layer.folder / "ortho.tif"
    try:
        with open_geotiff(path) as file:
            rows, columns = file.size
            step = max(1, int(np.ceil(np.sqrt(rows * columns / MAX_PIXELS))))
            gray: UInt8 = file.rectangle(1, slice(0, rows), slice(0, columns))[0]
            left, low = file.left_m, file.top_m - rows * file.cell_m
            right = left + columns * file.cell_m
    except (InputError, OSError, ValueError):
        return None
    given = edges(layer.heights)
    # The coarse map consists of whole coarse cells: crop or pad the photo to its edges.
    per_m = columns / (right - left)
    wide, high = (round((given[k + 2] - given[k]) * per_m) for k in (0, 1))
    first_x, first_y = round((given[0] - left) * per_m), round((given[1] - low) * per_m)
    whole = np.zeros((high, wide), np.uint8)
    x0, y0 = max(0, -first_x), max(0, -first_y)
    part = gray[max(0, first_y) :, max(0, first_x) :][: high - y0, : wide - x0]
    whole[y0 : y0 + part.shape[0], x0 : x0 + part.shape[1]] = part
    return np.ascontiguousarray(whole[::step, ::step])


def _shaded(heights: HeightMap) -> UInt8:
    """Paint heights from dark to light, shaded from one side; 0 for unknown."""
    known = np.isfinite(heights.z_m)
    low, high = np.percentile(heights.z_m[known], (1, 99)) if known.any() else (0.0, 1.0)
    level = (heights.z_m - low) / max(float(high - low), 0.2)
    gray = (_DARK + (_LIGHT - _DARK) * level.clip(0, 1)) * (
        0.8 + 0.2 * hillshade(heights.z_m, heights.cell_m, heights.sigma_m)
    )
    return np.asarray(np.where(known, gray.clip(1, 255), 0)).astype(np.uint8)


class PaintedLayers:
    """Cache of the pictures painted last."""

    def __init__(self) -> None:
        self._kept: OrderedDict[tuple[str, Kind, bytes], bytes] = OrderedDict()

    def paint(self, layer: SurveyLayer, kind: Kind) -> bytes:
        """Paint a layer, or return it from the cache."""
        key = (layer.map_id, kind, np.packbits(layer.shown).tobytes())
        if key not in self._kept:
            self._kept[key] = paint_layer(layer, kind)
        self._kept.move_to_end(key)
        while len(self._kept) > _KEPT:
            self._kept.popitem(last=False)
        return self._kept[key]
