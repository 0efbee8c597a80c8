"""Summarise the yard in coarse cells: the ground that loads are put down on and carried over."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np

from barsight.core.arrays import Bool, Float32, Float64, Int64
from barsight.yard.axes import axes_of
from barsight.yard.events import YardEvent
from barsight.yard.placement.load import Load
from barsight.yard.sections import patches
from barsight.yard.types import HeightMap, YardMap
from barsight.yard.unseen import wide_parts

COARSE_M = 0.05
"""Side (m) of a coarse cell."""
MIN_KNOWN = 0.5
"""Minimum share of a coarse cell that must have been seen."""
MAX_HOLE_CELLS = 2
"""Width, in coarse cells, of an unseen place from which on it may hide an obstacle."""
SHADOW_M = 0.3
"""Distance (m) around a load within which things were partly hidden by it, and may move when it goes."""
_PATCH_CELLS = 256
"""Side, in coarse cells, of the squares in which a map is read."""


@dataclass(frozen=True, eq=False)
class Ground:
    """Coarse cells [y, x] of a yard. Cell (0, 0) has its centre at (x0_m, y0_m).

    top_m: maximum height seen in the cell; where unknown, the upper bound by lines of sight, inf where none
    passed. unknown: unseen, and wide enough to hide an obstacle. barred: where nothing may be put down
    although the heights are known.
    """

    yard: YardMap
    x0_m: float
    y0_m: float
    cell_m: float
    top_m: Float32
    unknown: Bool
    barred: Bool

    @classmethod
    def of(cls, yard: YardMap) -> Ground:
        """Build the coarse cells of a map, patch by patch."""
        step = max(round(COARSE_M / yard.cell_m), 1)
        shape = tuple(n // step for n in yard.shape)
        top, share = np.empty((2, *shape), np.float32)
        for patch in patches(yard, _PATCH_CELLS * step):
            blocks = tuple(slice(cut.start // step, cut.stop // step) for cut in patch)
            top[blocks], share[blocks] = _coarse(yard.part(*patch), step)
        unseen = (share < MIN_KNOWN).astype(np.uint8)
        # Cells beyond the map are unseen too, so an unseen strip at its edge doesn't count as narrow.
        rim = MAX_HOLE_CELLS
        framed = cv2.copyMakeBorder(unseen, rim, rim, rim, rim, cv2.BORDER_CONSTANT, value=1)
        unknown = wide_parts(framed, MAX_HOLE_CELLS)[rim:-rim, rim:-rim] > 0
        narrow = (unseen > 0) & ~unknown
        around = cv2.dilate(np.where(unseen > 0, np.float32(-1e3), top), np.ones((3, 3), np.uint8))
        top = np.where(narrow, around, top).astype(np.float32)
        offset = (step - 1) / 2 * yard.cell_m
        nothing = np.zeros(shape, np.bool_)
        return cls(yard, yard.x0_m + offset, yard.y0_m + offset, step * yard.cell_m, top, unknown, nothing)

    def oldest_passes(self) -> Int64:
        """Return the oldest pass (rows, columns) that each cell shows, from 1; 1 where none is known."""
        step = max(round(self.cell_m / self.yard.cell_m), 1)
        found = np.ones(self.top_m.shape, np.int64)
        for patch in patches(self.yard, _PATCH_CELLS * step):
            passes = self.yard.part(*patch).passes
            if passes is None:
                continue
            blocks = tuple(slice(cut.start // step, cut.stop // step) for cut in patch)
            size = found[blocks].shape
            cells = passes[: size[0] * step, : size[1] * step].reshape(size[0], step, size[1], step)
            oldest = np.where(cells > 0, cells, np.uint8(255)).min(axis=(1, 3))
            found[blocks] = np.where(oldest < 255, oldest, 1)
        return found

    def about(self, x_m: float, y_m: float, reach_m: float) -> Ground:
        """Cut out the square within this distance of a place along X and Y."""
        low, high = (
            [
                round((at + side * reach_m - first) / self.cell_m)
                for at, first in ((y_m, self.y0_m), (x_m, self.x0_m))
            ]
            for side in (-1, 1)
        )
        top, left = max(low[0], 0), max(low[1], 0)
        cut = np.s_[top : max(high[0], top) + 1, left : max(high[1], left) + 1]
        return replace(
            self, x0_m=self.x0_m + left * self.cell_m, y0_m=self.y0_m + top * self.cell_m,
            top_m=self.top_m[cut], unknown=self.unknown[cut], barred=self.barred[cut],
        )  # fmt: skip

    def inside(self, size: Load | YardEvent, x_m: float, y_m: float, yaw_rad: float, margin_m: float) -> Bool:
        """Mark the cells under an outline of this size at a place, and those in a margin around it."""
        rows, columns = self.top_m.shape
        xx, yy = np.meshgrid(
            self.x0_m + self.cell_m * np.arange(columns) - x_m,
            self.y0_m + self.cell_m * np.arange(rows) - y_m,
        )
        across, along = axes_of(yaw_rad)
        to_side, to_end = (np.abs(xx * axis[0] + yy * axis[1]) for axis in (across, along))
        return np.asarray((to_side < size.width_m / 2 + margin_m) & (to_end < size.length_m / 2 + margin_m))

    def within(self, x_min: float, y_min: float, x_max: float, y_max: float) -> Bool:
        """Mark the cells that a rectangle along X and Y (m) touches."""
        rows, columns = self.top_m.shape
        x, y = self.x0_m + self.cell_m * np.arange(columns), self.y0_m + self.cell_m * np.arange(rows)
        half = self.cell_m / 2
        across = (x > x_min - half) & (x < x_max + half)
        return np.asarray(across & ((y > y_min - half) & (y < y_max + half))[:, None])

    def barring(self, cells: Bool) -> Ground:
        """Return a copy in which nothing may be put down on these cells."""
        return replace(self, barred=self.barred | cells)

    def apart_from(self, load: Load) -> Ground:
        """Return a copy in which nothing may be put down where a load lies and in its shadow."""
        return self.barring(self.inside(load, load.x_m, load.y_m, load.yaw_rad, SHADOW_M))

    def forgetting(self, cells: Bool) -> Ground:
        """Return a copy in which nothing is known of these cells."""
        top = np.where(cells, np.float32(np.inf), self.top_m)
        return replace(self, top_m=top, unknown=self.unknown | cells)

    def with_load(self, cells: Bool, top_m: float) -> Ground:
        """Return a copy with a load up to top_m on these cells."""
        top = np.where(cells, np.maximum(self.top_m, np.float32(top_m)), self.top_m)
        return replace(self, top_m=top, barred=self.barred | cells)

    def turned(self, yaw_rad: float) -> tuple[Float32, Bool, Float64]:
        """Rotate the cells into the axes across and along a heading. Returns (V, U) top and (V, U) whether a
        cell is unknown, barred or beyond the map, and (2,) the first cell's centre along those axes.
        """
        rows, columns = self.top_m.shape
        axes = axes_of(yaw_rad)
        size = np.array([columns - 1, rows - 1]) * self.cell_m
        corners = np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) * size + (self.x0_m, self.y0_m)
        low, high = (corners @ axes.T).min(axis=0), (corners @ axes.T).max(axis=0)
        across, along = (
            np.arange(a, b + self.cell_m / 2, self.cell_m) for a, b in zip(low, high, strict=True)
        )
        uu, vv = np.meshgrid(across, along)
        x, y = (uu * axes[0, k] + vv * axes[1, k] for k in (0, 1))
        column = np.rint((x - self.x0_m) / self.cell_m).astype(np.int64)
        row = np.rint((y - self.y0_m) / self.cell_m).astype(np.int64)
        held = (row >= 0) & (column >= 0) & (row < rows) & (column < columns)
        at = np.where(held, row, 0), np.where(held, column, 0)
        shut = ~held | (self.unknown | self.barred)[at]
        return np.where(shut, np.float32(0), self.top_m[at]).astype(np.float32), shut, low

    def highest_m(self, low: Float64, high: Float64, unseen_m: float = math.inf) -> float:
        """Find the maximum height that may occur in a rectangle from low to high (x, y); at least unseen_m
        where a part of it isn't known.
        """
        rows, columns = self.top_m.shape
        first = np.floor((low - (self.x0_m, self.y0_m)) / self.cell_m + 0.5).astype(int)
        last = np.floor((high - (self.x0_m, self.y0_m)) / self.cell_m + 0.5).astype(int)
        beyond = (first < 0).any() or last[0] >= columns or last[1] >= rows
        first = np.maximum(first, 0)
        held = self.top_m[first[1] : last[1] + 1, first[0] : last[0] + 1]
        known = np.where(np.isfinite(held), held, np.float32(unseen_m))
        return max(float(known.max(initial=-np.inf)), unseen_m if beyond else -math.inf)


def _coarse(heights: HeightMap, step: int) -> tuple[Float32, Float32]:
    """Compute the maximum height that may occur in each block of step x step, and the share that was seen."""
    rows, columns = (n // step for n in heights.z_m.shape)
    seen = heights.is_seen
    cut = np.s_[: rows * step, : columns * step]
    blocks = rows, step, columns, step
    share = seen[cut].reshape(blocks).mean(axis=(1, 3)).astype(np.float32)
    free = np.full(heights.z_m.shape, np.inf, np.float32) if heights.free_m is None else heights.free_m
    # A single wrong cell doesn't count as an obstacle.
    lowest = np.where(seen, heights.z_m, np.float32(-1e3))
    nearby = cv2.dilate(lowest, np.ones((3, 3), np.uint8))
    smooth = cv2.medianBlur(np.where(seen, heights.z_m, nearby).astype(np.float32), 3)
    highest = np.where(seen, smooth, -np.inf)[cut].reshape(blocks).max(axis=(1, 3))
    unseen = np.where(seen, -np.inf, free)[cut].reshape(blocks).max(axis=(1, 3))
    return np.where(share < MIN_KNOWN, np.maximum(highest, unseen), highest).astype(np.float32), share
