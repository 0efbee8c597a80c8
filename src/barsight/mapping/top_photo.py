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
from barsight.core.records.pairs import RectifiedCamera, RectifiedPair
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
BESIDE_M = 0.5
"""Distance within which a top that a picture's border cuts off hides lower things beyond the border."""
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
        camera, rect0_from_reference = pair.camera, reference_from_rect0.inverse()
        at = _pixels(camera, rect0_from_reference, x, y, tops)
        # A top beside the border that the picture cuts off hides what seems to be seen beneath it.
        under = _pixels(camera, rect0_from_reference, x, y, _highest_beside(tops, step))
        fine = tuple(COARSE_CELLS * n for n in reversed(tops.shape))
        at_y = _finer(at[2], fine)
        total, count = np.zeros(fine[::-1], np.uint16), np.zeros(fine[::-1], np.uint8)
        for picture, valid, at_x, under_x in (
            (pair.left, pair.left_valid, at[0], under[0]), (pair.right, pair.right_valid, at[1], under[1])
        ):  # fmt: skip
            places, known = (_finer(at_x, fine), at_y), valid.astype(np.uint8)
            gray = cv2.remap(picture, *places, cv2.INTER_LINEAR, borderValue=0)
            inside = cv2.remap(known, *places, cv2.INTER_NEAREST, borderValue=0) > 0
            whole = cv2.remap(known, under_x, under[2], cv2.INTER_NEAREST, borderValue=0)
            inside &= held & (cv2.resize(whole, fine, interpolation=cv2.INTER_NEAREST) > 0)
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
    coarse = shape[0], COARSE_CELLS, shape[1], COARSE_CELLS
    # The median keeps a single wrong match from raising the tops.
    smooth = cv2.medianBlur(heights, 3).reshape(coarse).max(axis=(1, 3))
    span = np.ones((round(SPAN_M / (COARSE_CELLS * cell_m)) | 1,) * 2, np.uint8)
    tops = cv2.morphologyEx(smooth, cv2.MORPH_CLOSE, span)
    # Beyond the border of what was seen there is no height that may lower the tops beside it.
    enough = (2 * seen.reshape(coarse).sum(axis=(1, 3)) >= COARSE_CELLS**2).astype(np.uint8)
    known = cv2.morphologyEx(enough, cv2.MORPH_CLOSE, span).astype(np.float32)
    weight = cv2.blur(known, (3, 3))
    around = cv2.blur(tops * known, (3, 3)) / np.maximum(weight, np.float32(1e-6))
    tops = np.where(weight > 0, around, tops)
    wide = round(SPAN_M / cell_m) | 1
    held = cv2.morphologyEx(seen, cv2.MORPH_CLOSE, np.ones((wide, wide), np.uint8)) > 0
    return np.asarray(tops + np.float32(OVER_TOPS_M), np.float32), held


def _highest_beside(tops: Float32, step_m: float) -> Float32:
    """Return the highest of the tops (R, C) within BESIDE_M, in coarse cells of step_m."""
    return np.asarray(cv2.dilate(tops, np.ones((2 * round(BESIDE_M / step_m) + 1,) * 2, np.uint8)))


def _pixels(
    camera: RectifiedCamera, rect0_from_reference: Pose, x: Float64, y: Float64, z: Float32
) -> tuple[Float32, Float32, Float32]:
    """Project places, by x, y and z (R, C) each, to columns in the left and the right picture, and rows."""
    seen = rect0_from_reference.apply(np.stack([x, y, z], axis=-1).reshape(-1, 3)).reshape(*z.shape, 3)
    depth = np.maximum(seen[..., 2], 1e-3)
    left = camera.focal_px * seen[..., 0] / depth + camera.cx_px
    right = left - camera.focal_px * camera.baseline_m / depth + camera.doffs_px
    down = camera.focal_px * seen[..., 1] / depth + camera.cy_px
    return left.astype(np.float32), right.astype(np.float32), down.astype(np.float32)


def _finer(at: Float32, size: tuple[int, ...]) -> Float32:
    """Interpolate pixel coordinates of coarse cells to the map's own cells, size = (width, height)."""
    return np.asarray(cv2.resize(at, size, interpolation=cv2.INTER_LINEAR), np.float32)
