"""Intersect exact solids with vertical lines: highest surface over a grid, underside of one solid."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from barsight.core.arrays import Float32, Float64, Int32, kernel
from barsight.simulation.worlds.solids import NOTHING, SolidYard

STEP_M = 0.001


@dataclass(frozen=True, eq=False)
class Envelope:
    """Highest surface over a grid of spacing STEP_M or more. Cell (i, j) is at (x0 + i step, y0 + j step).

    z: (X, Y) height, m, 0 where there is only the floor. top: (X, Y) number of the topmost solid, NOTHING for
    the floor.
    """

    x0: float
    y0: float
    step: float
    z: Float32
    top: Int32


def envelope(
    yard: SolidYard, low: tuple[float, float], high: tuple[float, float], take: Float64 | None = None,
    step: float = STEP_M,
) -> Envelope:  # fmt: skip
    """Rasterise the highest surface of the solids between two corners, except those with `take` (N,) 0."""
    shape = tuple(round((b - a) / step) + 1 for a, b in zip(low, high, strict=True))
    z, top = np.zeros(shape, np.float32), np.full(shape, NOTHING, np.int32)
    chosen = np.ones(len(yard.solids)) if take is None else np.asarray(take, float)
    bounds = np.array([s.bounds for s in yard.solids]).reshape(-1, 2, 3)
    _draw(yard.table, bounds, chosen, low[0], low[1], step, z, top)
    return Envelope(low[0], low[1], step, z, top)


def undersides(
    yard: SolidYard, low: tuple[float, float], high: tuple[float, float], number: int, step: float
) -> Float64:
    """Compute the lowest surface (X, Y), m, of one solid over a grid; inf where the solid is not."""
    shape = tuple(round((b - a) / step) + 1 for a, b in zip(low, high, strict=True))
    out = np.full(shape, np.inf)
    _draw_underside(yard.table[number], low[0], low[1], step, out)
    return out


@kernel()
def _draw(
    table: Float64, bounds: Float64, take: Float64, x0: float, y0: float, step: float, z: Float32, top: Int32
) -> None:
    """Rasterise the highest surface into z (X, Y), m, and the number of its solid into top (X, Y).

    table: (N, 16); bounds: (N, 2, 3), lower and upper corner of each solid; take: (N,), 0 for solids to
    ignore.
    """
    # The highest solids first, so that most of those below them are skipped.
    for n in np.argsort(-bounds[:, 1, 2]):
        if take[n] == 0:
            continue
        first_i = max(math.ceil((bounds[n, 0, 0] - x0) / step), 0)
        last_i = min(math.floor((bounds[n, 1, 0] - x0) / step), z.shape[0] - 1)
        first_j = max(math.ceil((bounds[n, 0, 1] - y0) / step), 0)
        last_j = min(math.floor((bounds[n, 1, 1] - y0) / step), z.shape[1] - 1)
        for i in range(first_i, last_i + 1):
            for j in range(first_j, last_j + 1):
                if bounds[n, 1, 2] <= z[i, j]:
                    continue
                low, high = cut(table[n], x0 + i * step, y0 + j * step)
                if low <= high and high > z[i, j]:
                    z[i, j], top[i, j] = high, n


@kernel()
def _draw_underside(solid: Float64, x0: float, y0: float, step: float, out: Float64) -> None:
    """Rasterise the lowest surface of one solid, a row (16,) of the table, into out (X, Y), m."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            low, high = cut(solid, x0 + i * step, y0 + j * step)
            if low <= high:
                out[i, j] = low


@kernel()
def cut(solid: Float64, x: float, y: float) -> tuple[float, float]:
    """Intersect a solid with the vertical line at (x, y): lower and upper z, m; lower > upper if it misses.

    solid: (16,), a row of `SolidYard.table`.
    """
    qx, qy = x - solid[1], y - solid[2]
    low, high = -np.inf, np.inf
    for k in range(1 if solid[0] else 3):
        aside, rise = qx * solid[4 + 3 * k] + qy * solid[5 + 3 * k], solid[6 + 3 * k]
        half = solid[13 + k]
        if abs(rise) < 1e-12:
            if abs(aside) > half:
                return 1.0, -1.0
        else:
            a, b = (-half - aside) / rise, (half - aside) / rise
            low, high = max(low, min(a, b)), min(high, max(a, b))
    if solid[0]:
        aside, rise, radius = qx * solid[4] + qy * solid[5], solid[6], solid[14]
        steep = 1 - rise * rise
        rest = qx * qx + qy * qy - aside * aside - radius * radius
        if steep < 1e-12:
            if rest > 0:
                return 1.0, -1.0
        else:
            root = aside * aside * rise * rise - steep * rest
            if root < 0:
                return 1.0, -1.0
            low = max(low, (aside * rise - math.sqrt(root)) / steep)
            high = min(high, (aside * rise + math.sqrt(root)) / steep)
    return solid[3] + low, solid[3] + high
