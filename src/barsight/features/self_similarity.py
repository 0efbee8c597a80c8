"""Estimate the period of texture that repeats along the rows: bars side by side."""

from __future__ import annotations

import cv2
import numpy as np
from scipy.fft import irfft, rfft

from barsight.core.arrays import Float32, Float64, UInt8

TILES = (4, 4)
NEAREST_PX = 5
ROW_STEP = 8
"""Number of rows that are averaged into one: neighbouring rows show the same bars."""
MIN_LIKENESS = 0.35
"""Minimum autocorrelation of a tile's rows at its first peak for the tile to count as repeating."""


def texture_period_px(image: UInt8, places: Float64) -> Float64:
    """Estimate the period (N,) px along the rows of the tile around each position (N, 2); infinite where
    there is none.

    The period is the first peak of the mean autocorrelation of the tile's rows, with slow changes of light
    removed.
    """
    bands = max(1, image.shape[0] // ROW_STEP)
    rows_of = cv2.resize(image, (image.shape[1], bands), interpolation=cv2.INTER_AREA).astype(np.float32)
    detail = rows_of - cv2.blur(rows_of, (81, 11))
    rows, columns = detail.shape[0] // TILES[0], detail.shape[1] // TILES[1]
    tiles = detail[: TILES[0] * rows, : TILES[1] * columns].reshape(TILES[0], rows, TILES[1], columns)
    likeness = _likeness(tiles.transpose(0, 2, 1, 3))
    table = np.array([[_first_peak(tile) for tile in line] for line in likeness])
    row = (places[:, 1] * TILES[0] / image.shape[0]).astype(int).clip(0, TILES[0] - 1)
    column = (places[:, 0] * TILES[1] / image.shape[1]).astype(int).clip(0, TILES[1] - 1)
    result: Float64 = table[row, column]
    return result


def _likeness(tiles: Float32) -> Float64:
    """Compute the mean autocorrelation (..., W / 2) of tiles (..., H, W), 1 at zero lag; 0 for a blank
    tile.
    """
    width = tiles.shape[-1]
    centred = tiles - tiles.mean(axis=-1, keepdims=True)
    power = (np.abs(rfft(centred, 2 * width)) ** 2).mean(axis=-2)
    likeness = irfft(power.astype(np.float64))[..., : width // 2]
    likeness *= width / (width - np.arange(width // 2))
    return likeness / np.maximum(likeness[..., :1], 1e-9)


def _first_peak(likeness: Float64) -> float:
    """Find the lag of the first peak after the autocorrelation's initial fall; infinity where there is
    none.
    """
    if likeness[0] <= 0:
        return float("inf")
    fallen = np.flatnonzero(likeness < MIN_LIKENESS / 2)
    if fallen.size == 0:
        return float("inf")
    start = max(NEAREST_PX, int(fallen[0]))
    inner = likeness[start:-1]
    peaks = np.flatnonzero((inner > likeness[start - 1 : -2]) & (inner >= likeness[start + 1 :]))
    high = peaks[inner[peaks] > MIN_LIKENESS]
    return float(start + high[0]) if high.size else float("inf")
