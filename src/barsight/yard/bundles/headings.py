"""Find the headings of the bars by the map's slopes."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from barsight.core.arrays import Float64
from barsight.core.records.heights import HeightSource
from barsight.yard.types import HeightMap

_BLOCK_M = 0.3
_COHERENT = 0.5
_STEEPEST = 1.5
_STRIP_BLOCKS = 64
_MIN_RATIO = 0.02
_MIN_RELIEF = 0.15
"""Minimum mean squared slope of a block that counts, as a fraction of that in the blocks with most relief."""


def find_headings(
    height_map: HeightMap, apart_deg: float, stock_over_m: float = -np.inf
) -> tuple[float, ...]:
    """Find headings (rad, in (-pi/2, pi/2], 0 along +y), most common first, at least `apart_deg` apart.

    Bars slope only across their axis, so the structure tensor of each block of 0.3 m shows the direction and
    how distinct it is [Bigun 1987]. A heading close to an axis of the map (within 0.6 `apart_deg`) is
    replaced by that axis. Heights up to stock_over_m are floor, whose ripples follow the pictures' direction.
    """
    block = max(round(_BLOCK_M / height_map.cell_m), 1)
    rows, columns = (n // block for n in height_map.z_m.shape)
    if rows < 1 or columns < 1 or min(height_map.z_m.shape) < 3:
        return (0.0,)
    strips = [
        _slopes(height_map, block, rows, first, min(first + _STRIP_BLOCKS, columns), stock_over_m)
        for first in range(0, columns, _STRIP_BLOCKS)
    ]
    even, odd, energy = np.concatenate(strips, axis=2)
    # The ripples of a level platform follow the pictures, not the bars, and have little relief.
    usual = float((energy**2).sum() / max(energy.sum(), 1e-12))
    clear = np.hypot(even, odd) > _COHERENT * np.maximum(energy, 1e-12)
    clear &= energy > _MIN_RELIEF * usual
    if not clear.any():
        return (0.0,)
    across = 0.5 * np.arctan2(odd[clear], even[clear])  # direction of the slope from +x: the heading itself
    degrees = np.degrees(across)
    counts, _ = np.histogram(degrees, bins=180, range=(-90, 90))
    smooth = ndimage.gaussian_filter1d(counts.astype(np.float64), 2.0, mode="wrap")
    found: list[float] = []
    peak = (smooth >= np.roll(smooth, 1)) & (smooth >= np.roll(smooth, -1))
    for index in np.argsort(np.where(peak, -smooth, 0.0), kind="stable"):
        if not peak[index] or smooth[index] < _MIN_RATIO * smooth.sum() or len(found) == 4:
            break
        near = np.abs((degrees - (index - 89.5) + 90) % 180 - 90) < apart_deg
        offset = np.median((degrees[near] - (index - 89.5) + 90) % 180 - 90) if near.any() else 0.0
        heading = _snapped(index - 89.5 + float(offset), apart_deg)
        if all(abs((heading - other + 90) % 180 - 90) > apart_deg for other in found):
            found.append(heading)
    return tuple(float(np.radians(h)) for h in found) or (0.0,)


def _slopes(
    height_map: HeightMap, block: int, rows: int, first: int, last: int, stock_over_m: float
) -> Float64:
    """Compute the structure tensors (3, rows, last - first) of the blocks: difference of the squared slopes
    along both axes, twice their product, and their sum. Done in strips: the slopes of a long yard take many
    times the memory of its map.
    """
    low, high = max(first * block - 1, 0), min(last * block + 1, height_map.z_m.shape[1])
    seen = HeightSource.measured(height_map.source[:, low:high])
    seen &= height_map.z_m[:, low:high] > stock_over_m
    z = np.where(seen, height_map.z_m[:, low:high], np.nan).astype(np.float64)
    gy, gx = np.gradient(z, height_map.cell_m)
    usable = np.isfinite(gx) & np.isfinite(gy) & (np.hypot(gx, gy) < _STEEPEST)
    inner = np.s_[: rows * block, first * block - low : last * block - low]
    gx, gy = np.where(usable, gx, 0.0)[inner], np.where(usable, gy, 0.0)[inner]
    parts = np.stack([gx * gx - gy * gy, 2 * gx * gy, gx * gx + gy * gy])
    summed: Float64 = parts.reshape(3, rows, block, last - first, block).sum(axis=(2, 4))
    return summed


def _snapped(heading_deg: float, apart_deg: float) -> float:
    for axis in (0.0, 90.0, -90.0):
        if abs(heading_deg - axis) < 0.6 * apart_deg:
            return abs(axis)
    return heading_deg
