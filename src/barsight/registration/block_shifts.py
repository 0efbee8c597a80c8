"""Measure the shift of one height map with its picture against another, block by block."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar, cast

import cv2
import numpy as np

from barsight.core.arrays import Bool, Float32, Float64
from barsight.core.linalg.robust import mad_sigma

Floats = TypeVar("Floats", Float32, Float64)

BLOCK_CELLS = 64
MIN_KNOWN_RATIO = 0.3
"""Minimum share of a block's cells that both maps must know for it to be used."""
GATE_M = 0.06
"""Maximum height difference: cells further apart belong to another surface, or it has changed."""
TOGETHER_CELLS = 40.0
"""Number of cells whose errors are nearly the same, by which the information is divided: the map averages
along a bar, and matching has a window.
"""
STRAY_M = 0.01
"""Prior standard deviation of a block's shift, which limits blocks that show little."""
_FINE_CELLS, _COARSE_CELLS = 1.0, 10.0
_TURNS = 5
_MIN_CONTRAST = 2.0
"""Lower bound of the pictures' noise, in gray levels, for their weight."""


@dataclass(frozen=True, eq=False)
class MatchedMap:
    """Heights (H, W) m with their sigmas, NaN where unknown, and gray levels, NaN where there are none."""

    z_m: Float32
    sigma_m: Float32
    gray: Float32

    def moved(self, shift_m: Float64, cell_m: float) -> MatchedMap:
        """Shift the map by x, y and z (m) with bilinear interpolation; cells next to unknown ones become
        unknown.
        """
        rows, columns = self.z_m.shape
        x, y = np.meshgrid(
            np.arange(columns, dtype=np.float32) - np.float32(shift_m[0] / cell_m),
            np.arange(rows, dtype=np.float32) - np.float32(shift_m[1] / cell_m),
        )
        z, sigma, gray = (
            cv2.remap(one, x, y, cv2.INTER_LINEAR, borderValue=float("nan"))
            for one in (self.z_m, self.sigma_m, self.gray)
        )
        return MatchedMap(z + np.float32(shift_m[2]), sigma, gray)


@dataclass(frozen=True, eq=False)
class BlockShifts:
    """K blocks that two maps share. place_m: (K, 3) their centres; shift_m: (K, 3) that moves the second map
    onto the first; information: (K, 3, 3) of the shift, 1 / m^2, zero in directions that show nothing.
    """

    place_m: Float64
    shift_m: Float64
    information: Float64

    @classmethod
    def none(cls) -> BlockShifts:
        """Return no blocks."""
        return cls(np.empty((0, 3)), np.empty((0, 3)), np.empty((0, 3, 3)))

    def __add__(self, other: BlockShifts) -> BlockShifts:
        return BlockShifts(
            np.concatenate([self.place_m, other.place_m]), np.concatenate([self.shift_m, other.shift_m]),
            np.concatenate([self.information, other.information]),
        )  # fmt: skip


def block_shifts(
    first: MatchedMap, second: MatchedMap, origin_m: tuple[float, float], cell_m: float,
    begin_m: Float64 | None = None,
) -> BlockShifts:  # fmt: skip
    """Measure the shifts of all blocks by least squares over heights and pictures (Lucas-Kanade).

    first, second: on one grid, whose first cell's centre is origin_m (x, y). begin_m: (3,) start value. Bars
    alone don't show the shift along themselves; straps, ends, rust and mill scale do. Cells whose heights
    differ by more than GATE_M are left out. Slow changes of the brightness are removed.
    """
    total, found = np.zeros(3) if begin_m is None else begin_m, BlockShifts.none()
    for _ in range(_TURNS):
        found = _measured(first, second.moved(total, cell_m), origin_m, cell_m)
        if not len(found.place_m):
            return found
        step = _middle(found)
        total = total + step
        if np.abs(step).max() < 1e-4:
            break
    return BlockShifts(found.place_m, found.shift_m + total - step, found.information)


def _middle(found: BlockShifts) -> Float64:
    """Average the blocks' shifts weighted by their information, without those that lie far off the median."""
    middle = np.median(found.shift_m, axis=0)
    off = np.abs(found.shift_m - middle)
    near = (off <= 3 * np.median(off, axis=0) + 1e-4).all(axis=1)
    information = found.information[near]
    ridge = 1e-6 * np.trace(information.sum(axis=0)) * np.eye(3)
    weighted = np.einsum("kij,kj->i", information, found.shift_m[near])
    return np.asarray(np.linalg.solve(information.sum(axis=0) + ridge, weighted), np.float64)


def _measured(
    first: MatchedMap, second: MatchedMap, origin_m: tuple[float, float], cell_m: float
) -> BlockShifts:
    both = np.isfinite(first.z_m) & np.isfinite(second.z_m)
    both &= np.abs(first.z_m - second.z_m) <= GATE_M
    known = _inner(both)  # where the slopes are those of known cells
    heights = [np.where(both, one.z_m, 0).astype(np.float32) for one in (first, second)]
    variance = np.nan_to_num(first.sigma_m**2 + second.sigma_m**2, nan=1.0) + 1e-8
    pictured = both & np.isfinite(first.gray) & np.isfinite(second.gray)
    pictures = [_contrast(one.gray, pictured) for one in (first, second)]
    pictured = _inner(pictured)
    noise = pictures[0] - pictures[1]
    spread = mad_sigma(noise[pictured]) if pictured.any() else 1.0
    normal = np.zeros((3, 3, *known.shape), np.float32)
    wanted = np.zeros((3, *known.shape), np.float32)
    for pair, weight, lifts in (
        (heights, np.where(known, 1 / variance, 0), 1.0),
        (pictures, np.where(pictured, 1 / max(spread, _MIN_CONTRAST) ** 2, 0), 0.0),
    ):
        middle = (pair[0] + pair[1]) / 2
        down, right = np.gradient(middle, cell_m)
        jacobian = (-right, -down, np.full_like(middle, lifts))
        for i in range(3):
            wanted[i] += weight * jacobian[i] * (pair[0] - pair[1])
            for j in range(3):
                normal[i, j] += weight * jacobian[i] * jacobian[j]
    return _solved(known, heights[0], normal, wanted, origin_m, cell_m)


def _inner(known: Bool) -> Bool:
    """Find the cells whose neighbours are known as well."""
    inner: Bool = cv2.erode(known.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    return inner


def _solved(
    known: Bool, z_m: Float32, normal: Float32, wanted: Float32, origin_m: tuple[float, float], cell_m: float
) -> BlockShifts:
    """Sum the equations of each block and solve them; directions without information stay at zero."""
    counts = _sums(known.astype(np.float32))
    chosen = counts >= MIN_KNOWN_RATIO * BLOCK_CELLS**2
    if not chosen.any():
        return BlockShifts.none()
    information = _sums(normal)[..., chosen].transpose(2, 0, 1) / TOGETHER_CELLS
    right = _sums(wanted)[..., chosen].T / TOGETHER_CELLS
    ridge = np.eye(3) / STRAY_M**2
    shift = np.asarray(np.linalg.solve(information + ridge, right[..., None])[..., 0], np.float64)
    rows, columns = np.nonzero(chosen)
    middle = (BLOCK_CELLS - 1) / 2
    place = np.column_stack([
        origin_m[0] + cell_m * (columns * BLOCK_CELLS + middle),
        origin_m[1] + cell_m * (rows * BLOCK_CELLS + middle),
        _sums(np.where(known, z_m, 0))[chosen] / counts[chosen],
    ])  # fmt: skip
    return BlockShifts(place, shift, information)


def _sums(values: Float32) -> Float64:
    """Sum (..., H, W) over whole blocks, (..., H // BLOCK_CELLS, W // BLOCK_CELLS)."""
    rows, columns = (size // BLOCK_CELLS for size in values.shape[-2:])
    whole = values[..., : rows * BLOCK_CELLS, : columns * BLOCK_CELLS].astype(np.float64)
    return np.asarray(
        whole.reshape(*values.shape[:-2], rows, BLOCK_CELLS, columns, BLOCK_CELLS).sum(axis=(-3, -1))
    )


def _contrast(gray: Float32, known: Bool) -> Float32:
    """Smooth a picture a little and subtract its slow part, using known cells only."""
    fine, coarse = (smooth_known(gray, known, cells) for cells in (_FINE_CELLS, _COARSE_CELLS))
    return np.where(known, fine - coarse, 0).astype(np.float32)


def smooth_known(values: Floats, known: Bool, sigma_cells: float) -> Floats:
    """Smooth a map (H, W) by a Gaussian mean of its known cells."""
    total = cv2.GaussianBlur(known.astype(values.dtype), (0, 0), sigma_cells)
    smooth = cv2.GaussianBlur(np.where(known, values, values.dtype.type(0)), (0, 0), sigma_cells)
    return cast(Floats, smooth / np.maximum(total, 1e-3))
