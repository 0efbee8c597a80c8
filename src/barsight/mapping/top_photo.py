"""Build the top photo: the pictures' mean gray level, projected at the height of the tops around each cell.

Whatever lies across the tops is as sharp there as in a single picture, because every view shows it at the
same place, even if it is too thin for matching to measure; whatever lies deeper is blurred, because each view
shows it elsewhere.
"""

from __future__ import annotations

from collections.abc import Callable, MutableMapping
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from barsight.core.arrays import Bool, Float32, Float64, UInt8, UInt16
from barsight.core.pose import Pose
from barsight.core.records.pairs import RectifiedPair
from barsight.mapping.free_space import NO_END, UNPROVEN, bound_heights
from barsight.mapping.observation import CellObservations
from barsight.mapping.spilled_tiles import TileKey
from barsight.mapping.tiles import TILE_CELLS, covering_tiles, tile_overlap, tile_places

COARSE_CELLS = 5
"""Side, in cells of the map, of the coarse cells in which the height of the tops is computed."""
SPAN_M = 0.35
"""Maximum width of the gaps that the tops' height bridges, as a bar laid across them would."""
OVER_TOPS_M = 0.01
"""Height added to the tops: about that of a thin bar's middle above what carries it."""
MAX_VIEWS = 250
"""Maximum number of views added up per cell, so that the sum of gray levels fits into 16 bits."""


@dataclass(eq=False)
class TopPhoto:
    """Sums of gray levels and the number of views in them, per cell of the map.

    cell_m: side of the cells. tiles: (2, TILE_CELLS, TILE_CELLS) each, sums and numbers of views; 1 MiB per
    5 m square at cells of 10 mm.
    """

    cell_m: float
    tiles: MutableMapping[TileKey, UInt16] = field(default_factory=dict)

    def add(self, cells: CellObservations, pair: RectifiedPair, reference_from_rect0: Pose) -> None:
        """Add both pictures of a view, projected at the height of the tops that the view itself has
        measured.
        """
        if cells.x.size == 0:
            return
        column, row = int(cells.x.min()), int(cells.y.min())
        tops, held = _tops(cells, column, row, self.cell_m)
        step = COARSE_CELLS * self.cell_m
        offset = (COARSE_CELLS - 1) / 2 * self.cell_m
        rows, columns = tops.shape
        x, y = np.meshgrid(
            column * self.cell_m + offset + step * np.arange(columns),
            row * self.cell_m + offset + step * np.arange(rows),
        )
        seen = reference_from_rect0.inverse().apply(np.stack([x, y, tops], axis=-1).reshape(-1, 3))
        camera, depth = pair.camera, np.maximum(seen[:, 2], 1e-3)
        left_x = camera.focal_px * seen[:, 0] / depth + camera.cx_px
        right_x = left_x - camera.focal_px * camera.baseline_m / depth + camera.doffs_px
        fine = tuple(COARSE_CELLS * n for n in reversed(tops.shape))
        at_y = _finer(camera.focal_px * seen[:, 1] / depth + camera.cy_px, tops, fine)
        total, count = np.zeros(fine[::-1], np.uint16), np.zeros(fine[::-1], np.uint8)
        for picture, valid, at in (
            (pair.left, pair.left_valid, left_x), (pair.right, pair.right_valid, right_x)
        ):  # fmt: skip
            places = _finer(at, tops, fine), at_y
            gray = cv2.remap(picture, *places, cv2.INTER_LINEAR, borderValue=0)
            inside = cv2.remap(valid.astype(np.uint8), *places, cv2.INTER_NEAREST, borderValue=0) > 0
            inside &= held
            total += np.where(inside, gray, 0).astype(np.uint16)
            count += inside.astype(np.uint8)
        for key in covering_tiles(column, row, count.shape):
            self._merge(key, column, row, total, count)

    def window(self, column: int, row: int, columns: int, rows: int) -> UInt8:
        """Return mean gray levels (rows, columns) from 1, 0 where no view saw the cell, starting at cell
        (column, row).
        """
        out = np.zeros((rows, columns), np.uint8)
        for key in covering_tiles(column, row, out.shape):
            if key in self.tiles:
                ours, theirs = tile_overlap(key, column, row, out.shape)
                total, count = (part[ours] for part in self.tiles[key])
                mean = np.rint(total / np.maximum(count, 1)).clip(1, 255)
                out[theirs] = np.where(count > 0, mean, 0).astype(np.uint8)
        return out

    def give_way(self, later: TopPhoto) -> None:
        """Discard the pictures where a pass of a later time has its own: what was laid across since would
        pale among those from before.
        """
        for key, (_, seen) in later.tiles.items():
            if key in self.tiles:
                self.tiles[key][:, seen > 0] = 0

    def join(self, newer: TopPhoto, forgotten: Callable[[NDArray[Any], NDArray[Any]], Bool]) -> None:
        """Add a newer pass's pictures. forgotten: see `FreeSpace.join`."""
        for key, (sums, views) in self.tiles.items():
            gone = forgotten(*tile_places(key, self.cell_m))
            sums[gone], views[gone] = 0, 0
        for key, added in newer.tiles.items():
            if key not in self.tiles:
                self.tiles[key] = added.copy()
                continue
            ours = self.tiles[key]
            ours[:, ours[1] + added[1] > MAX_VIEWS] = 0
            ours += added

    def _merge(self, key: TileKey, column: int, row: int, total: UInt16, count: UInt8) -> None:
        ours, theirs = tile_overlap(key, column, row, count.shape)
        if not count[theirs].any():
            return
        sums, views = self.tiles.setdefault(key, np.zeros((2, TILE_CELLS, TILE_CELLS), np.uint16))
        open_ = views[ours] < MAX_VIEWS
        sums[ours] += np.where(open_, total[theirs], np.uint16(0))
        views[ours] += np.where(open_, count[theirs], np.uint8(0))


def _tops(cells: CellObservations, column: int, row: int, cell_m: float) -> tuple[Float32, Bool]:
    """Compute the height of the tops in coarse cells (R, C) starting at cell (column, row), and a mask, in
    the map's own cells, of those that were seen or lie between seen ones.
    """
    shape = tuple(-(-(int(at.max()) + 1 - first) // COARSE_CELLS)
                  for at, first in ((cells.y, row), (cells.x, column)))  # fmt: skip
    size = tuple(COARSE_CELLS * n for n in shape)
    highest, lowest = np.full(size, NO_END), np.full(size, UNPROVEN)
    bound_heights(cells.x, cells.y, cells.z_m, (column, row), highest, lowest)
    seen = (highest > NO_END).astype(np.uint8)
    heights = np.maximum(highest, cells.z_m.min())
    # The median keeps a single wrong match from raising the tops.
    smooth = cv2.medianBlur(heights, 3).reshape(shape[0], COARSE_CELLS, shape[1], COARSE_CELLS)
    span = round(SPAN_M / (COARSE_CELLS * cell_m)) | 1
    tops = cv2.morphologyEx(smooth.max(axis=1).max(axis=2), cv2.MORPH_CLOSE, np.ones((span, span), np.uint8))
    wide = round(SPAN_M / cell_m) | 1
    held = cv2.morphologyEx(seen, cv2.MORPH_CLOSE, np.ones((wide, wide), np.uint8)) > 0
    return np.asarray(cv2.blur(tops, (3, 3)) + np.float32(OVER_TOPS_M), np.float32), held


def _finer(at: Float64, coarse: Float32, size: tuple[int, ...]) -> Float32:
    """Interpolate pixel coordinates of coarse cells to the map's own cells, size = (width, height)."""
    return np.asarray(
        cv2.resize(at.reshape(coarse.shape).astype(np.float32), size, interpolation=cv2.INTER_LINEAR),
        np.float32,
    )
