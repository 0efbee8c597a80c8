"""Find free places to set a bundle down: known, level and wide enough, ranked."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from barsight.core.arrays import Bool, Float32, Float64
from barsight.core.types import HeightSource
from barsight.yard.sections import patches
from barsight.yard.types import HeightMap, YardMap

COARSE_M = 0.05
LEVEL_M = 0.04
CLEARANCE_M = 0.1
MIN_KNOWN = 0.9
GULLY_M = 0.4
"""Gullies narrower than this between tops don't make a layer uneven: dunnage bridges them."""
MAX_VALUE = 20
_PATCH_CELLS = 256
RULE = (
    "The lowest first, then the most level; at least 90 % seen, level within 40 mm, 100 mm clear all round."
)


@dataclass(frozen=True)
class FreePlace:
    """A rectangle along Y for a bundle: its middle. level_m: spread of its heights; known_share: seen."""

    x_m: float
    y_m: float
    z_m: float
    level_m: float
    known_share: float


def free_places(yard: YardMap, width_m: float, length_m: float) -> tuple[FreePlace, ...]:
    """Find places along Y for a bundle of this size, in `RULE`'s order; at most 20, none over another.

    On the floor or on a layer of bundles: what counts is the upper envelope, closed over gullies.
    """
    step = max(round(COARSE_M / yard.cell_m), 1)
    top, known = np.empty((2, *(n // step for n in yard.shape)), np.float32)
    for patch in patches(yard, _PATCH_CELLS * step):
        blocks = tuple(slice(cut.start // step, cut.stop // step) for cut in patch)
        top[blocks], known[blocks] = _coarse(yard.part(*patch), step)
    cell = yard.cell_m * step
    wide = round((width_m + 2 * CLEARANCE_M) / cell) | 1
    long = round((length_m + 2 * CLEARANCE_M) / cell) | 1
    if wide > top.shape[1] or long > top.shape[0]:
        return ()
    gully = np.ones((1, round(GULLY_M / cell) | 1), np.uint8)
    envelope = cv2.morphologyEx(np.where(known > 0, top, -1.0).astype(np.float32), cv2.MORPH_CLOSE, gully)
    window = np.ones((long, wide), np.uint8)
    highest, lowest = cv2.dilate(envelope, window), cv2.erode(envelope, window)
    share = cv2.boxFilter(known, -1, (wide, long))
    level = highest - lowest
    fits: Bool = (level < LEVEL_M) & (share > MIN_KNOWN)
    rows, columns = long // 2, wide // 2
    inner = np.zeros_like(fits)
    inner[rows : fits.shape[0] - rows, columns : fits.shape[1] - columns] = True
    return _ranked(fits & inner, highest, level, share, yard, cell, (wide, long))


def _coarse(heights: HeightMap, step: int) -> tuple[Float32, Float32]:
    """Compute the highest seen height and fraction of seen cells of each block of step x step."""
    rows, columns = (n // step for n in heights.z_m.shape)
    seen = (heights.source != HeightSource.UNKNOWN) & (heights.source != HeightSource.FILLED)
    z = np.where(seen, heights.z_m, -np.inf)[: rows * step, : columns * step]
    blocks = z.reshape(rows, step, columns, step)
    share = np.isfinite(blocks).mean(axis=(1, 3)).astype(np.float32)
    return np.where(share > 0, blocks.max(axis=(1, 3)), 0).astype(np.float32), share


def _ranked(
    fits: Bool, z: Float32, level: Float32, share: Float32, yard: YardMap, cell: float,
    size: tuple[int, int],
) -> tuple[FreePlace, ...]:  # fmt: skip
    found: list[FreePlace] = []
    row, column = np.nonzero(fits)
    order = np.lexsort((level[row, column], np.round(z[row, column], 1)))
    taken = np.zeros(fits.shape, np.bool_)
    wide, long = size
    offset: Float64 = np.array([yard.x0_m, yard.y0_m]) + (cell - yard.cell_m) / 2
    for k in order:
        i, j = int(row[k]), int(column[k])
        if taken[i, j]:
            continue
        x, y = offset + np.array([j, i]) * cell
        found.append(
            FreePlace(float(x), float(y), float(z[i, j]), float(level[i, j]), float(min(share[i, j], 1.0)))
        )
        if len(found) == MAX_VALUE:
            break
        taken[max(i - long + 1, 0) : i + long, max(j - wide + 1, 0) : j + wide] = True
    return tuple(found)
