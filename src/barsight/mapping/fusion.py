"""Fuse views robustly: each cell keeps a few heights, each view votes for one, and the best supported wins.

A view's height joins the stored one within its gate (weighted mean, weighted squares for the scatter) or
starts a new one, so that a wrong match stays alone and is outvoted. A view takes the same work however many
came before.
"""

from __future__ import annotations

import numpy as np

from barsight.core.arrays import Bool, Float32, Int32, Int64, kernel
from barsight.mapping.observation import CellObservations
from barsight.mapping.settings import MapSettings
from barsight.mapping.tiles import (
    CENTRAL,
    GRAY,
    SHARED,
    SLOTS,
    SQUARES,
    TILE_CELLS,
    VIEWS,
    WEIGHT,
    TileStore,
    Z,
)

PRIOR_VIEWS = 4.0
"""Weight of the stated sigmas against the views' own scatter, in views."""


def fuse_view(store: TileStore, view: CellObservations, settings: MapSettings) -> None:
    """Add one view to the tiles in `store`; afterwards at most as many stay in memory as the view has
    touched.
    """
    first = int(view.x.min()) // TILE_CELLS, int(view.y.min()) // TILE_CELLS
    columns, rows = (
        int(at.max()) // TILE_CELLS - low + 1 for at, low in zip((view.x, view.y), first, strict=True)
    )
    order, starts = _by_tile(view.x, view.y, first, (rows, columns))
    touched = np.flatnonzero(np.diff(starts))
    for number in touched.tolist():
        members = order[starts[number] : starts[number + 1]]
        key = first[0] + number % columns, first[1] + number // columns
        _vote(
            store.take(key),
            members,
            (key[0] * TILE_CELLS, key[1] * TILE_CELLS),
            (view.x, view.y),
            view.z_m,
            view.variance_m2,
            view.shared_m,
            view.intensity,
            view.central,
            (settings.gate_sigma, settings.min_gate_m),
        )
    store.hold(touched.size)


@kernel()
def _by_tile(x: Int32, y: Int32, first: tuple[int, int], shape: tuple[int, int]) -> tuple[Int64, Int64]:
    """Sort cells x, y (N,) with a counting sort: their indices (N,), tile by tile and row by row, and where
    each tile starts (tiles + 1,).

    shape: rows and columns of tiles, starting at the tile `first` (x, y).
    """
    starts, order = np.zeros(shape[0] * shape[1] + 1, np.int64), np.empty(x.size, np.int64)
    tile = np.empty(x.size, np.int64)
    for i in range(x.size):
        tile[i] = (y[i] // TILE_CELLS - first[1]) * shape[1] + x[i] // TILE_CELLS - first[0]
        starts[np.uint64(tile[i] + 1)] += 1
    for k in range(starts.size - 1):
        starts[k + 1] += starts[k]
    cursor = starts[:-1].copy()
    for i in range(x.size):
        own = np.uint64(tile[i])
        order[np.uint64(cursor[own])] = i
        cursor[own] += 1
    return order, starts


@kernel(borrows=True)
def _vote(
    tile: Float32,
    members: Int64,
    first: tuple[int, int],
    cells: tuple[Int32, Int32],
    z: Float32,
    variance: Float32,
    shared: Float32,
    intensity: Float32,
    central: Bool,
    gates: tuple[float, float],
) -> None:
    """Fuse a view's heights into a tile's slots, in place.

    tile: (TILE_CELLS, TILE_CELLS, SLOTS, FIELDS). members: (M,) indices of the heights that lie in the tile;
    first: column and row of its first cell. cells (x, y), z (m), variance (m^2), shared (m), intensity,
    central: (N,), see `CellObservations`. gates (sigma, m): a height joins the nearest slot within the larger
    of both. If there is none, it takes an empty slot, else replaces a height with a single view, else is
    dropped.
    """
    (first_column, first_row), (x, y), (gate_sigma, min_gate) = first, cells, gates
    for m in members:
        slots = tile[y[m] - first_row, x[m] - first_column]
        best, target = _choose_slots(slots, z[m], variance[m], shared[m], gate_sigma, min_gate)
        w = 1.0 / max(variance[m], 1e-10)
        if best >= 0:
            total = slots[best, WEIGHT] + w
            step = z[m] - slots[best, Z]
            share = w / total
            slots[best, Z] += share * step
            slots[best, SQUARES] += w * step * step * (1 - share)
            slots[best, WEIGHT] = total
            slots[best, VIEWS] += 1
            slots[best, CENTRAL] += central[m]
            slots[best, SHARED] += share * (shared[m] - slots[best, SHARED])
            slots[best, GRAY] += share * (intensity[m] - slots[best, GRAY])
            continue
        if target < 0:
            continue
        slots[target, Z] = z[m]
        slots[target, WEIGHT] = w
        slots[target, SQUARES] = 0
        slots[target, VIEWS] = 1
        slots[target, SHARED] = shared[m]
        slots[target, GRAY] = intensity[m]
        slots[target, CENTRAL] = central[m]


@kernel(borrows=True)
def _choose_slots(
    slots: Float32, z: float, variance: float, shared: float, gate_sigma: float, min_gate: float
) -> tuple[int, int]:
    """Choose which of a cell's slots (SLOTS, FIELDS) a height z (m) joins, and which one it takes if it
    joins none; -1 where there is no such slot.
    """
    best, best_gap = -1, np.inf
    empty, weakest = -1, 0
    for s in range(SLOTS):
        if slots[s, VIEWS] == 0:
            if empty < 0:
                empty = s
            continue
        gap = abs(slots[s, Z] - z)
        spread = variance + 1.0 / slots[s, WEIGHT] + shared**2 + slots[s, SHARED] ** 2
        if gap < best_gap and gap <= max(gate_sigma * np.sqrt(spread), min_gate):
            best, best_gap = s, gap
        if slots[s, VIEWS] < slots[weakest, VIEWS]:
            weakest = s
    if empty < 0 and slots[weakest, VIEWS] <= 1:
        empty = weakest
    return best, empty


def height_sigma(slots: Float32) -> Float32:
    """Compute the sigma (...) of fused heights (..., FIELDS).

    This is the noise by the weights, scaled by the views' actual scatter, plus the calibration's part in
    full: it is the same in all views and doesn't average out.
    """
    scatter = (PRIOR_VIEWS + slots[..., SQUARES]) / (PRIOR_VIEWS + slots[..., VIEWS] - 1)
    sigma: Float32 = np.sqrt(scatter / slots[..., WEIGHT] + slots[..., SHARED] ** 2)
    return sigma
