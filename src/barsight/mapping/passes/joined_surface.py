"""Join the surfaces of passes into one: shifted by their corrections, averaged where they agree, and the
newest where the yard changed.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from itertools import combinations
from pathlib import Path

import numpy as np

from barsight.core.arrays import Bool, Float32, Float64
from barsight.core.records.heights import HeightSource
from barsight.mapping.passes.changes import PLACE_M, PlaceHistory
from barsight.mapping.spilled_tiles import TileKey
from barsight.mapping.surface.surface import Layers, Surface, write_tile
from barsight.mapping.surface.tile_figures import TileFigures, gather_surface, tile_figures
from barsight.mapping.tiles import TILE_CELLS, covering_tiles, tile_places
from barsight.registration.block_shifts import BLOCK_CELLS, BlockShifts, MatchedMap, block_shifts
from barsight.registration.gross_shift import CoarsePair, find_gross_shift
from barsight.registration.pass_ties import PassCorrection

EDGE_M = 0.03
"""Maximum height difference from the nearest cell for a cell to be on the same surface and used in
interpolation.
"""
AGREE_SIGMAS, AGREE_M = 3.0, 0.03
"""Two passes' heights are averaged if they differ by no more than the larger of these: in sigmas of both
combined, and absolute.
"""
_STRIPE_CELLS = 32 * BLOCK_CELLS
"""Side, in cells along x and y, of the part of an overlap that is matched at once."""


@dataclass(frozen=True, eq=False)
class PassSurface:
    """The surface of a pass, and the correction that transforms it into the common map. since: number of the
    first pass recorded at the same time.
    """

    surface: Surface
    correction: PassCorrection
    since: int


@dataclass(frozen=True, eq=False)
class JoinedSurface:
    """The joined surface of all passes. history: the pass that last saw each place, and what changed."""

    surface: Surface
    history: PlaceHistory


def measure_overlaps(surfaces: Sequence[Surface]) -> dict[tuple[int, int], BlockShifts]:
    """Match all pairs of surfaces where both have heights, also where one lies grossly shifted; keys are
    (first, second).
    """
    found = {}
    for first, second in combinations(range(len(surfaces)), 2):
        blocks, cell_m = BlockShifts.none(), surfaces[first].cell_m
        parts = list(_shared(surfaces[first], surfaces[second]))
        coarse = []
        for part in parts:
            one, other = (_seen(surfaces[k].window(*part)) for k in (first, second))
            coarse.append(CoarsePair.of(one, other, cell_m))
        begin_m = find_gross_shift(coarse, cell_m)
        for part in parts:
            one, other = (_seen(surfaces[k].window(*part)) for k in (first, second))
            blocks += block_shifts(one, other, (part[0] * cell_m, part[1] * cell_m), cell_m, begin_m)
        if len(blocks.place_m):
            found[first, second] = blocks
    return found


def _seen(layers: Layers) -> MatchedMap:
    """Keep only measured cells of a window; filled ones become NaN."""
    seen = layers.source == HeightSource.VISION
    z_m, sigma_m = (np.where(seen, part, np.float32(np.nan)) for part in (layers.z_m, layers.sigma_m))
    return MatchedMap(z_m, sigma_m, layers.intensity)


def _shared(first: Surface, second: Surface) -> Iterator[tuple[int, int, int, int]]:
    """Divide the rectangle that both surfaces cover into parts: first column and row, columns and rows."""
    (x0, x1), (y0, y1) = (
        (max(a[0], b[0]), min(a[1], b[1]))
        for a, b in ((first.columns, second.columns), (first.rows, second.rows))
    )
    for column in range(x0, x1 - BLOCK_CELLS, _STRIPE_CELLS):
        for row in range(y0, y1 - BLOCK_CELLS, _STRIPE_CELLS):
            yield column, row, min(_STRIPE_CELLS, x1 - column), min(_STRIPE_CELLS, y1 - row)


def join_surfaces(passes: Sequence[PassSurface], folder: Path) -> JoinedSurface:
    """Join passes, the oldest first, into an empty folder.

    A cell's height is the mean, weighted by sigma, over the passes that saw it since its last change, where
    they agree. Its sigma isn't reduced by averaging, because the calibration's part is common to all passes.
    """
    cell_m = passes[0].surface.cell_m
    keys = sorted(set().union(*(one.surface.tiles for one in passes)))
    cells = max(1, round(PLACE_M / cell_m))
    low = np.array(keys).min(axis=0) * TILE_CELLS - cells
    high = (np.array(keys).max(axis=0) + 1) * TILE_CELLS + cells
    columns, rows = (-(-(high - low) // cells)).tolist()
    corner = (low - 0.5) * cell_m
    history = PlaceHistory((float(corner[0]), float(corner[1])), (rows, columns), cells * cell_m)
    for number, one in enumerate(passes):
        history.add(number, *_coarse(one, low, (rows, columns), cells), one.since)
    figures = {key: _join_tile(passes, key, history, folder) for key in keys}
    return JoinedSurface(gather_surface(folder, cell_m, figures), history)


def _join_tile(
    passes: Sequence[PassSurface], key: TileKey, history: PlaceHistory, folder: Path
) -> TileFigures:
    last = history.last_change(*tile_places(key, passes[0].surface.cell_m))
    layers, parts = Layers.unknown(TILE_CELLS, TILE_CELLS), []
    times = np.full(last.shape, -1)
    for number, one in enumerate(passes):
        if key not in one.surface.tiles:
            continue
        new = moved_window(one, key[0] * TILE_CELLS, key[1] * TILE_CELLS, TILE_CELLS, TILE_CELLS)
        layers = _averaged(layers, new, last <= number, times < one.since)
        times[(new.source == HeightSource.VISION) & (last <= number)] = one.since
        part = one.surface.cloud_of(key)
        xyz = part.xyz_m + one.correction.shift_at(part.xyz_m.astype(np.float64)).astype(np.float32)
        kept = last.ravel()[part.cell] <= number
        moved = replace(part, xyz_m=xyz)
        parts.append(replace(moved, **{f.name: getattr(moved, f.name)[kept] for f in fields(part)}))
    write_tile(folder, key, layers)
    whole = {f.name: np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(parts[0])}
    type(parts[0])(**whole).write(folder, key)
    return tile_figures(key, layers)


def moved_window(one: PassSurface, column: int, row: int, columns: int, rows: int) -> Layers:
    """Read a rectangle of the corrected surface: heights and sigma bilinear between cells of one surface,
    the rest from the nearest cell; unknown where the nearest cell is.
    """
    cell_m, correction = one.surface.cell_m, one.correction
    x, y = np.meshgrid(cell_m * (column + np.arange(columns)), cell_m * (row + np.arange(rows)))
    points = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    shift = correction.shift_at(points).reshape(rows, columns, 3)
    margin = int(np.ceil(np.abs(shift[..., :2]).max() / cell_m)) + 1
    old = one.surface.window(column - margin, row - margin, columns + 2 * margin, rows + 2 * margin)
    at_x = margin + np.arange(columns) - shift[..., 0] / cell_m
    at_y = margin + np.arange(rows)[:, None] - shift[..., 1] / cell_m
    near_x, near_y = np.rint(at_x).astype(np.int64), np.rint(at_y).astype(np.int64)
    nearest = old.z_m[near_y, near_x]
    total, z, sigma = (np.zeros((rows, columns)) for _ in range(3))
    left, below = np.floor(at_x).astype(np.int64), np.floor(at_y).astype(np.int64)
    for dx in (0, 1):
        for dy in (0, 1):
            i, j = (below + dy).clip(0, old.z_m.shape[0] - 1), (left + dx).clip(0, old.z_m.shape[1] - 1)
            weight = (1 - np.abs(at_x - left - dx)) * (1 - np.abs(at_y - below - dy))
            weight *= np.abs(old.z_m[i, j] - nearest) <= EDGE_M
            total += weight
            z += weight * np.nan_to_num(old.z_m[i, j])
            sigma += weight * np.nan_to_num(old.sigma_m[i, j])
    known = np.isfinite(nearest) & (total > 0)
    share = np.where(known, 1 / np.maximum(total, 1e-9), np.nan)
    return Layers(
        (z * share + shift[..., 2]).astype(np.float32), (sigma * share).astype(np.float32),
        np.where(known, old.views[near_y, near_x], 0).astype(np.float32),
        np.where(known, old.source[near_y, near_x], HeightSource.UNKNOWN).astype(np.uint8),
        np.where(known, old.intensity[near_y, near_x], np.nan).astype(np.float32),
    )  # fmt: skip


def _averaged(old: Layers, new: Layers, chosen: Bool, is_later: Bool) -> Layers:
    """Average where both agree; elsewhere prefer a measured height, then a later one that is higher, then
    the one with more views: a bar laid since appears, one that a few views missed stays. Where both agree,
    a later pass's gray level counts: a label would pale.

    chosen: (rows, columns) where the newer pass counts. is_later: (rows, columns) where its time is later.
    """
    has_old, has_new = old.source != HeightSource.UNKNOWN, (new.source != HeightSource.UNKNOWN) & chosen
    both = has_old & has_new
    gate = np.maximum(AGREE_SIGMAS * np.hypot(old.sigma_m, new.sigma_m), AGREE_M)
    alike = (old.source == new.source) & (np.abs(old.z_m - new.z_m) <= gate) & both
    better = (is_later & (new.z_m > old.z_m)) | (new.views >= old.views)
    better = np.where(old.source == new.source, better, new.source == HeightSource.VISION)
    takes_new = has_new & (~has_old | (~alike & better))
    weights = [np.nan_to_num(1 / np.square(one.sigma_m)) for one in (old, new)]
    share = np.where(alike, weights[1] / np.maximum(weights[0] + weights[1], 1e-12), takes_new)
    shares = {"z_m": share, "sigma_m": share, "intensity": np.where(alike & is_later, 1.0, share)}
    mixed = {
        name: np.where(
            part == 0, getattr(old, name),
            np.where(part == 1, getattr(new, name),
                     (1 - part) * getattr(old, name) + part * getattr(new, name)),
        ).astype(np.float32)
        for name, part in shares.items()
    }  # fmt: skip
    views = np.where(alike, old.views + new.views, np.where(takes_new, new.views, old.views))
    source = np.where(takes_new, new.source, old.source)
    return Layers(views=views.astype(np.float32), source=source.astype(np.uint8), **mixed)


def _coarse(one: PassSurface, low: Float64, shape: tuple[int, int], cells: int) -> tuple[Float32, Float32]:
    """Compute the heights of a pass's places and their sigma as medians of `cells` x `cells` cells; NaN
    where fewer than half were seen.
    """
    out = [np.full(shape, np.nan, np.float32) for _ in range(2)]
    step = TILE_CELLS // cells
    occupied = one.surface.tiles
    for first in range(0, shape[0], step):
        for left in range(0, shape[1], step):
            rows, columns = min(step, shape[0] - first), min(step, shape[1] - left)
            column, row = int(low[0]) + left * cells, int(low[1]) + first * cells
            if occupied.isdisjoint(covering_tiles(column, row, (rows * cells, columns * cells))):
                continue
            layers = moved_window(one, column, row, columns * cells, rows * cells)
            seen = layers.source == HeightSource.VISION
            for target, values in zip(out, (layers.z_m, layers.sigma_m), strict=True):
                target[first : first + rows, left : left + columns] = _medians(values, seen, cells)
    return out[0], out[1]


def _medians(values: Float32, seen: Bool, cells: int) -> Float32:
    rows, columns = (size // cells for size in values.shape)
    known = np.where(seen, values, np.float32(np.nan))
    square = known.reshape(rows, cells, columns, cells).swapaxes(1, 2).reshape(rows * columns, cells * cells)
    found = np.full(rows * columns, np.nan, np.float32)
    enough = np.isfinite(square).sum(axis=1) * 2 >= cells * cells
    if enough.any():
        found[enough] = np.nanmedian(square[enough], axis=1)
    return found.reshape(rows, columns)
