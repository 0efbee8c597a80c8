"""Divide long yards into stretches, so that the part of a map kept in memory doesn't grow with its length."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np

from barsight.core.arrays import Float64
from barsight.mapping.free_space import FreeSpace
from barsight.mapping.passes.changes import PlaceHistory
from barsight.mapping.surface.surface import Surface, gray_levels
from barsight.mapping.top_photo import TopPhoto
from barsight.yard.types import HeightMap, YardMap

WHOLE_M = 60.0
"""Maximum length (m) of a map that is one stretch."""
OWN_M, MARGIN_M = 44.0, 8.0
"""Maximum length (m) of a stretch's own part, and how much of its neighbours it includes on either side: a
bundle whose middle is in its own part is included whole if it is no longer than 13 m, with a metre to see its
ends. Of a bundle beyond, an end may be included alone; it counts as a neighbour.
"""


class PartedMap:
    """A `YardMap` whose parts are read on demand; the last one read is kept, and smaller ones are cut from
    it.

    read: returns the part of these rows and columns.
    """

    def __init__(
        self, x0_m: float, y0_m: float, cell_m: float, shape: tuple[int, int],
        read: Callable[[slice, slice], HeightMap],
    ) -> None:  # fmt: skip
        self.x0_m, self.y0_m, self.cell_m, self.shape = x0_m, y0_m, cell_m, shape
        self._read = read
        self._last: tuple[slice, slice, HeightMap] | None = None

    def part(self, rows: slice, columns: slice) -> HeightMap:
        """Read a rectangle of the map, by cells from start to stop."""
        held = self._last
        if held is None or not all(
            have.start <= want.start and want.stop <= have.stop
            for have, want in zip(held[:2], (rows, columns), strict=True)
        ):
            held = self._last = None
            held = self._last = rows, columns, self._read(rows, columns)
        below, left = held[0].start, held[1].start
        return held[2].part(
            slice(rows.start - below, rows.stop - below), slice(columns.start - left, columns.stop - left)
        )

    def whole(self) -> HeightMap:
        """Read the whole map."""
        return self.part(slice(0, self.shape[0]), slice(0, self.shape[1]))


def surface_map(
    surface: Surface, free: FreeSpace | None = None, tops: TopPhoto | None = None,
    history: PlaceHistory | None = None,
) -> PartedMap:  # fmt: skip
    """Return everything that a surface knows, read from its tiles. free: what lines of sight prove free;
    tops: the pictures at the height of the tops; history: which of several passes saw each place.
    """
    cell_m = surface.cell_m

    def read(rows: slice, columns: slice) -> HeightMap:
        column, row = surface.columns[0] + columns.start, surface.rows[0] + rows.start
        layers = surface.window(column, row, columns.stop - columns.start, rows.stop - rows.start)
        gray = gray_levels(layers.intensity)
        size = layers.z_m.shape[1], layers.z_m.shape[0]
        bounds = None if free is None else free.window(column, row, *size)
        photo = None if tops is None else tops.window(column, row, *size)
        x_m, y_m = (
            cell_m * (first + np.arange(cells)) for first, cells in zip((column, row), size, strict=True)
        )
        newest = None if history is None else history.newest_pass(x_m, y_m)
        return HeightMap(
            column * cell_m, row * cell_m, cell_m,
            layers.z_m, layers.sigma_m, layers.views, layers.source, gray, bounds, photo, newest,
        )  # fmt: skip

    return PartedMap(surface.columns[0] * cell_m, surface.rows[0] * cell_m, cell_m, surface.shape, read)


@dataclass(frozen=True)
class MapStretch:
    """A part of a map, by rows and columns, that is processed as if it were the whole map. The rectangle from
    low_m to high_m (x and y, infinite where the map ends) is its own, the rest its neighbours'.
    """

    rows: slice
    columns: slice
    low_m: tuple[float, float]
    high_m: tuple[float, float]

    def owns(self, place_m: Float64, slack_m: float = 0.0) -> bool:
        """Check whether a place (2 or more values, x and y first) is its own, or within slack_m of that."""
        return all(
            low - slack_m <= at < high + slack_m
            for low, at, high in zip(self.low_m, place_m[:2], self.high_m, strict=True)
        )

    def reaches(self, *places_m: Float64) -> bool:
        """Check whether one of these places lies in its own part or in its margin."""
        return any(self.owns(place_m, MARGIN_M) for place_m in places_m)


def split_map(yard: YardMap) -> list[MapStretch]:
    """Divide a map into stretches; only one for a map of up to WHOLE_M."""
    rows, columns = (_cuts(cells, yard.cell_m) for cells in yard.shape)
    return [
        MapStretch(
            held_rows, held_columns,
            (yard.x0_m + first_x, yard.y0_m + first_y), (yard.x0_m + last_x, yard.y0_m + last_y),
        )
        for (held_rows, first_y, last_y), (held_columns, first_x, last_x) in product(rows, columns)
    ]  # fmt: skip


def _cuts(cells: int, cell_m: float) -> list[tuple[slice, float, float]]:
    """Divide one axis: each stretch's cells, and where its own part begins and ends, m from the first."""
    count = 1 if cells * cell_m <= WHOLE_M else int(np.ceil(cells * cell_m / OWN_M))
    edges = np.linspace(0, cells, count + 1).round().astype(int).tolist()
    margin = round(MARGIN_M / cell_m)
    borders = [-np.inf, *(cell_m * (edge - 0.5) for edge in edges[1:-1]), np.inf]
    return [
        (slice(max(edges[k] - margin, 0), min(edges[k + 1] + margin, cells)), borders[k], borders[k + 1])
        for k in range(count)
    ]


def patches(yard: YardMap, cells: int) -> Iterator[tuple[slice, slice]]:
    """Divide a map into squares of this many cells, as rows and columns; smaller at its far ends."""
    for first, other in product(*(range(0, size, cells) for size in yard.shape)):
        yield (
            slice(first, min(first + cells, yard.shape[0])),
            slice(other, min(other + cells, yard.shape[1])),
        )


def part_about(yard: YardMap, x_m: Float64, y_m: Float64) -> HeightMap:
    """Read the part that contains these places, or the nearest cells where they lie beyond the map."""
    cuts = []
    for at, first, size in ((y_m, yard.y0_m, yard.shape[0]), (x_m, yard.x0_m, yard.shape[1])):
        cell = (np.array([at.min(), at.max()]) - first) / yard.cell_m
        low, high = np.clip([np.floor(cell[0]), np.ceil(cell[1])], 0, size - 1).astype(int).tolist()
        cuts.append(slice(low, high + 1))
    return yard.part(cuts[0], cuts[1])
