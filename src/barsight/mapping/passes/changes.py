"""Detect changes between passes: places where a newer pass sees another height than the earlier ones."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from barsight.core.arrays import Bool, Float32, Float64

PLACE_M = 0.05
"""Approximate side of the places in which heights are compared, each by the median of its cells."""
MIN_CHANGE_M, CHANGE_SIGMAS = 0.04, 3.0
"""Minimum height difference that counts as a change, absolute and in sigmas of both heights combined."""
MIN_AREA_M2 = 0.04
"""Minimum area of a change; smaller patches are matching errors."""
OPENING_PLACES = 3
"""Side, in places, of the square that must fit into a change: at an edge, two views differ over a narrower
strip.
"""
AXIS_PLACES = 50
"""Number of places along a bundle's axis at which earlier changes are looked up."""
MARGIN_M = 0.15
"""Margin around a change within which what was seen before is discarded."""


@dataclass(frozen=True)
class HeightChange:
    """A change of height. pass_index: pass that first saw it (of passes recorded at the same time, the
    first), from 0. low_m, high_m: corners of its bounding rectangle, x and y. area_m2: area of the places
    that changed. rise_m: median change of height, negative where something was removed.
    """

    pass_index: int
    low_m: tuple[float, float]
    high_m: tuple[float, float]
    area_m2: float
    rise_m: float


@dataclass(frozen=True, eq=False)
class BundleMove:
    """A bundle found at the same height as before that was exchanged or moved along its axis.

    pass_index: as in `HeightChange`. ends_m: (2, 3) ends of its axis in the joined map, the low-y end first.
    along_m: distance moved towards its high-y end, None if it is another bundle.
    """

    pass_index: int
    ends_m: Float64
    width_m: float
    along_m: float | None


class PlaceHistory:
    """Record of when each place of the yard was seen and changed, as pass after pass is added.

    low_m: (x, y), the corner of the first place. shape: (rows, columns). place_m: side of a place. Memory: 10
    bytes per place. seen_by: number of the newest pass that saw the place, -1 for none; changed_by:
    pass_index of its last change, -1 for none. changes, moves: all that were found.
    """

    def __init__(self, low_m: tuple[float, float], shape: tuple[int, int], place_m: float) -> None:
        self.low_m, self.shape, self.place_m = low_m, shape, place_m
        self._z_m, self._sigma_m = (np.full(shape, np.nan, np.float32) for _ in range(2))
        self.seen_by, self.changed_by = (np.full(shape, -1, np.int8) for _ in range(2))
        self.changes: list[HeightChange] = []
        self.moves: list[BundleMove] = []

    def add(self, number: int, z_m: Float32, sigma_m: Float32, since: int) -> None:
        """Add the heights (rows, columns) of the next pass with their sigma, NaN where it saw none.

        since: number of the first pass recorded at the same time: what those passes saw is no older, so
        nothing changed between them.
        """
        rise = np.where(self.seen_by < since, z_m - self._z_m, np.float32(np.nan))
        bound = np.maximum(MIN_CHANGE_M, CHANGE_SIGMAS * np.hypot(sigma_m, self._sigma_m))
        changed = np.zeros(self.shape, np.bool_)
        for way in (1, -1):
            opened = ndimage.binary_opening(way * rise > bound, np.ones((OPENING_PLACES,) * 2, np.bool_))
            labels, _ = ndimage.label(opened, np.ones((3, 3)))
            for label, (rows, columns) in enumerate(ndimage.find_objects(labels), start=1):
                box = rows, columns
                inside = labels[box] == label
                if inside.sum() * self.place_m**2 >= MIN_AREA_M2:
                    changed[box] |= inside
                    self.changes.append(self._change(since, box, inside, rise[box][inside]))
        if changed.any():
            away_m = ndimage.distance_transform_edt(~changed) * self.place_m
            self.changed_by[away_m <= MARGIN_M] = since
        seen = np.isfinite(z_m)
        self.seen_by[seen] = number
        self._z_m[seen], self._sigma_m[seen] = z_m[seen], sigma_m[seen]

    def note(self, move: BundleMove) -> None:
        """Mark a bundle's place, before and after its move, as changed; do nothing for an exchange that
        the heights have already shown.
        """
        x_m, y_m = np.linspace(move.ends_m[0, :2], move.ends_m[1, :2], AXIS_PLACES).T
        if move.along_m is None and (self._look_up(self.changed_by, x_m, y_m) >= move.pass_index).any():
            return
        self.moves.append(move)
        ends = move.ends_m[:, :2]
        length_m = float(np.hypot(*(ends[1] - ends[0])))
        along = (ends[1] - ends[0]) / length_m
        rows, columns = self.shape
        x, y = np.meshgrid(*(self.place_m * (np.arange(size) + 0.5) for size in (columns, rows)))
        away = np.stack([x + self.low_m[0], y + self.low_m[1]], axis=-1) - ends.mean(axis=0)
        reach_m = length_m / 2 + abs(move.along_m or 0.0) + MARGIN_M
        inside = np.abs(away @ along) <= reach_m
        inside &= np.abs(away @ np.array([along[1], -along[0]])) <= move.width_m / 2 + MARGIN_M
        self.changed_by[inside] = np.maximum(self.changed_by[inside], move.pass_index)

    def _change(self, number: int, box: tuple[slice, slice], inside: Bool, rise: Float32) -> HeightChange:
        (left, bottom), (right, top) = (
            tuple(
                round(low + self.place_m * at, 3)
                for low, at in zip(self.low_m, (column, row), strict=True)
            )
            for row, column in ((box[0].start, box[1].start), (box[0].stop, box[1].stop))
        )  # fmt: skip
        area_m2 = round(float(inside.sum()) * self.place_m**2, 4)
        return HeightChange(number, (left, bottom), (right, top), area_m2, round(float(np.median(rise)), 4))

    def last_change(self, x_m: NDArray[Any], y_m: NDArray[Any]) -> NDArray[np.int8]:
        """Look up `changed_by` on a grid of columns x (X,) and rows y (Y,), (Y, X); -1 outside the yard."""
        x, y = np.meshgrid(x_m, y_m)
        return self._look_up(self.changed_by, x, y)

    def newest_pass(self, x_m: NDArray[Any], y_m: NDArray[Any]) -> NDArray[np.uint8]:
        """Look up the last pass that saw each cell of such a grid, counted from 1; 0 where none did."""
        x, y = np.meshgrid(x_m, y_m)
        return (self._look_up(self.seen_by, x, y) + 1).astype(np.uint8)

    def seen_about(self, margin_m: float) -> Callable[[NDArray[Any], NDArray[Any]], NDArray[np.int8]]:
        """Build a look-up, on such a grid, of the newest pass that saw anything within about margin_m of a
        cell, from 0; -1 for none.
        """
        about = ndimage.maximum_filter(self.seen_by, 2 * math.ceil(margin_m / self.place_m) + 1)
        return lambda x_m, y_m: self._look_up(about, *np.meshgrid(x_m, y_m))

    def is_stale(
        self, centre_m: Float64, yaw_rad: float, length_m: float, width_m: float, reach_m: float
    ) -> bool:
        """Check whether the yard changed within reach_m of a rectangle of which some part, or of the strips
        just beyond its ends, hasn't been seen since.

        centre_m: (2 or more,) x and y first; yaw_rad: of its length, from +Y; length_m: along it.
        """
        along = np.array([-np.sin(yaw_rad), np.cos(yaw_rad)])
        across = np.array([np.cos(yaw_rad), np.sin(yaw_rad)])

        def places(length: float, width: float) -> tuple[Float64, Float64]:
            step = self.place_m / 2
            v, u = (np.arange(-size / 2, size / 2 + step, step) for size in (length, width))
            at = centre_m[:2] + v[:, None, None] * along + u[None, :, None] * across
            return at[..., 0], at[..., 1]

        last = int(
            self._look_up(self.changed_by, *places(length_m + 2 * reach_m, width_m + 2 * reach_m)).max()
        )
        if last < 0:
            return False
        seen = self._look_up(self.seen_by, *places(length_m + 2 * reach_m, width_m))
        return bool(((seen >= 0) & (seen < last)).any())

    def _look_up(self, raster: NDArray[np.int8], x_m: Float64, y_m: Float64) -> NDArray[np.int8]:
        column, row = (
            np.floor((at - low) / self.place_m).astype(np.int64)
            for at, low in zip((x_m, y_m), self.low_m, strict=True)
        )
        inside = (row >= 0) & (row < self.shape[0]) & (column >= 0) & (column < self.shape[1])
        found = raster[row.clip(0, self.shape[0] - 1), column.clip(0, self.shape[1] - 1)]
        return np.where(inside, found, np.int8(-1))
