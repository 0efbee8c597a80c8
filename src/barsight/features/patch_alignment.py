"""Align patches inverse-compositionally, with gain and offset, to a few hundredths of a pixel.

Lucas-Kanade by Gauss-Newton [Baker 2004, inverse compositional] with two more unknowns, gain and offset: two
cameras never expose alike, and where a patch is brighter on one side an offset of 5 % shifts plain
Lucas-Kanade by tenths of a pixel. Pictures are interpolated by cubic B-splines, which hardly damp fine
texture at any fraction of a pixel.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from barsight.core.arrays import Bool, Float32, Float64, UInt8, kernel
from barsight.core.linalg.bspline import sixfold_weights
from barsight.core.records.pairs import RectifiedPair

HALF_PX = 5
"""Half-width of a patch, which is 2 * HALF_PX + 1 pixels wide."""
MAX_ROWS = 64
"""Maximum number of source rows for reading a patch; a patch that needs more isn't aligned."""
MAX_STEPS = 15
CLOSE_PX = 0.01
COARSE_REACH_PX = 6.0
"""Maximum distance from its guess at which a patch is accepted in the half-size picture, in full-size px."""
FINE_REACH_PX = 2.5
MIN_LIKENESS = 0.7
CORE_PX, MIN_CORE_LIKENESS = 2, -0.5
MIDDLE_PX, MAX_MIDDLE_SIGMA_PX = 3, 0.4
"""Half-width of a patch's middle, and maximum sigma of a position from the middle alone. With `CORE_PX`, this
rejects patches of which only the rim has matched, which may belong to another surface.
"""
MIN_CONTRAST_DN = 1.0
_SIZE = 2 * HALF_PX + 1
_POLE = 3.0**0.5 - 2.0
_PREFILTER = (3.0**0.5 * _POLE ** np.abs(np.arange(-8, 9))).astype(np.float32)


@dataclass(frozen=True, eq=False)
class PatchImage:
    """Picture prepared for reading at fractions of a pixel: spline coefficients (H, W), also at half size."""

    fine: Float32
    coarse: Float32


@dataclass(frozen=True, eq=False)
class PatchPair:
    """Rectified pair, and its pictures prepared for reading at fractions of a pixel."""

    pair: RectifiedPair
    left: PatchImage
    right: PatchImage


@dataclass(frozen=True, eq=False)
class AlignedPatches:
    """pixels: (N, 2) x, y in the target. sigma_px: (N,) of x and y each, from the patch's own misfit, along
    its weaker direction. likeness: (N,) share of the patch's variance that the other patch explains. found:
    (N,) whether it converged near its guess and is alike, its middle included.
    """

    pixels: Float64
    sigma_px: Float64
    likeness: Float64
    found: Bool


def patch_image(image: UInt8) -> PatchImage:
    """Compute the spline coefficients of an (H, W) picture."""
    return PatchImage(_coefficients(image), _coefficients(cv2.pyrDown(image)))


def patch_pair(pair: RectifiedPair) -> PatchPair:
    """Prepare both pictures of a pair for reading at fractions of a pixel."""
    return PatchPair(pair, patch_image(pair.left), patch_image(pair.right))


def align_patches(
    source: PatchImage, target: PatchImage, places: Float64, guesses: Float64, sure: bool = False,
    grown: Float64 | None = None,
) -> AlignedPatches:  # fmt: skip
    """Align the patches of `source` at `places` (N, 2) with `target`, near the `guesses` (N, 2).

    grown: (N,) factor by which the target shows them larger, 1 where not given. sure: the guesses are within
    `FINE_REACH_PX`; otherwise the half-size pictures are aligned first.
    """
    places = np.ascontiguousarray(places, np.float64)
    start = np.ascontiguousarray(guesses, np.float64)
    size = np.ones(len(places)) if grown is None else np.ascontiguousarray(grown, np.float64)
    if not sure:
        # Full-size pixel p is half-size pixel p / 2 (pyrDown keeps the even ones).
        half = _located(source.coarse, target.coarse, places / 2, start / 2, size, COARSE_REACH_PX / 2)
        start = np.where(half.found[:, None], half.pixels * 2, start)
    return _located(source.fine, target.fine, places, start, size, FINE_REACH_PX)


def _located(
    source: Float32, target: Float32, places: Float64, guesses: Float64, grown: Float64, reach: float
) -> AlignedPatches:
    count = len(places)
    pixels, sigma, likeness = guesses.copy(), np.full(count, np.nan), np.zeros(count)
    _locate(source, target, places, pixels, grown, sigma, likeness, reach)
    found: Bool = np.isfinite(sigma) & (likeness > MIN_LIKENESS)
    return AlignedPatches(pixels, sigma, likeness, found)


def _coefficients(image: UInt8) -> Float32:
    """Compute cubic B-spline coefficients; the recursive prefilter's tail is cut off at 8 px, where it is
    3e-5.
    """
    result: Float32 = cv2.sepFilter2D(
        image, cv2.CV_32F, _PREFILTER, _PREFILTER, borderType=cv2.BORDER_REFLECT_101
    )
    return result


@kernel()
def _weights(t: float, weights: Float32) -> None:
    """Fill weights (4,) for a fraction t of a pixel; their sum is 1 to within 32-bit precision."""
    before, at, _, after = sixfold_weights(t)
    weights[0], weights[1], weights[3] = before / 6, at / 6, after / 6
    weights[2] = 1 - weights[0] - weights[1] - weights[3]


@kernel()
def _inside(image: Float32, x: float, y: float, reach: float) -> bool:
    """Check that the spline can be read from x - reach to x + reach and likewise in y, px.

    image: (H, W) coefficients, of which one before a position and two after it are needed.
    """
    return (
        x - reach >= 1
        and y - reach >= 1
        and x + reach <= image.shape[1] - 3
        and y + reach <= image.shape[0] - 3
    )


@kernel()
def _read(
    image: Float32, x: float, y: float, half: int, step: float, patch: Float32, rows: Float32, room: Float32
) -> None:
    """Sample the (2 half + 1)^2 patch around (x, y) with pixels `step` px apart, all of it inside.

    rows: (at least 2 half step + 5, 2 half + 1) and room: (2, at least 2 half + 1, 4) are scratch.
    """
    size = 2 * half + 1
    for j in range(size):
        px, py = x + (j - half) * step, y + (j - half) * step
        _weights(px - np.floor(px), room[0, j])
        _weights(py - np.floor(py), room[1, j])
    top, bottom = int(np.floor(y - half * step)) - 1, int(np.floor(y + half * step)) + 2
    for j in range(size):
        left = int(np.floor(x + (j - half) * step)) - 1
        a = room[0, j]
        for i in range(bottom - top + 1):
            line = image[top + i]
            rows[i, j] = (
                a[0] * line[left] + a[1] * line[left + 1] + a[2] * line[left + 2] + a[3] * line[left + 3]
            )
    for i in range(size):
        first = int(np.floor(y + (i - half) * step)) - 1 - top
        b = room[1, i]
        for j in range(size):
            patch[i, j] = (
                b[0] * rows[first, j] + b[1] * rows[first + 1, j] + b[2] * rows[first + 2, j]
                + b[3] * rows[first + 3, j]
            )  # fmt: skip


@kernel()
def _read_whole(image: Float32, x: float, y: float, patch: Float32, rows: Float32, room: Float32) -> None:
    """Sample a whole patch at full size: all its pixels have the same weights, which are applied along the
    rows, then down the columns.

    rows: (at least _SIZE + 3, _SIZE) scratch.
    """
    left, top = int(np.floor(x)) - HALF_PX - 1, int(np.floor(y)) - HALF_PX - 1
    a, b = room[0, 0], room[1, 0]
    _weights(x - np.floor(x), a)
    _weights(y - np.floor(y), b)
    for i in range(_SIZE + 3):
        line = image[top + i, left : left + _SIZE + 3]
        for j in range(_SIZE):
            rows[i, j] = a[0] * line[j] + a[1] * line[j + 1] + a[2] * line[j + 2] + a[3] * line[j + 3]
    for i in range(_SIZE):
        for j in range(_SIZE):
            patch[i, j] = (
                b[0] * rows[i, j] + b[1] * rows[i + 1, j] + b[2] * rows[i + 2, j] + b[3] * rows[i + 3, j]
            )


@kernel()
def _prepare(wide: Float32, design: Float32, normal: Float64) -> float:
    """Build the design (5, _SIZE^2) of a patch: horizontal and vertical gradient, gain, offset and the patch
    itself; and the normal matrix (4, 4) of the first four. Returns the patch's standard deviation.
    """
    mean = wide[1:-1, 1:-1].sum() / np.float32(_SIZE * _SIZE)
    half = np.float32(0.5)
    for i in range(_SIZE):
        for j in range(_SIZE):
            k = i * _SIZE + j
            design[0, k] = (wide[i + 1, j + 2] - wide[i + 1, j]) * half
            design[1, k] = (wide[i + 2, j + 1] - wide[i, j + 1]) * half
            design[2, k] = wide[i + 1, j + 1] - mean
            design[3, k] = 1
            design[4, k] = wide[i + 1, j + 1]
    for k in range(4):
        for m in range(k, 4):
            total = np.float32(0)
            for i in range(_SIZE * _SIZE):
                total += design[k, i] * design[m, i]
            normal[k, m] = normal[m, k] = total
    return float(np.sqrt(normal[2, 2] / (_SIZE * _SIZE)))


@kernel()
def _step(other: Float32, design: Float32, inverse: Any, step: Float64) -> None:
    """Compute the Gauss-Newton step (4,) towards the other patch (_SIZE^2,)."""
    along, down, gain, offset = np.float32(0), np.float32(0), np.float32(0), np.float32(0)
    for k in range(_SIZE * _SIZE):
        off = other[k] - design[4, k]
        along += design[0, k] * off
        down += design[1, k] * off
        gain += design[2, k] * off
        offset += off
    for k in range(4):
        step[k] = inverse[k, 0] * along + inverse[k, 1] * down + inverse[k, 2] * gain + inverse[k, 3] * offset


@kernel()
def _misfit(other: Float32, design: Float32, step: Float64, half: int) -> tuple[float, float]:
    """Sum squares over the middle (2 half + 1)^2 of the patch: those of the residuals after the step, and
    those of the other patch about its mean there.

    other: (_SIZE^2,). design: (5, _SIZE^2), see `_prepare`; step: (4,), see `_step`.
    """
    a, b, c, d = np.float32(step[0]), np.float32(step[1]), np.float32(step[2]), np.float32(step[3])
    left, mean, square = np.float32(0), np.float32(0), np.float32(0)
    first = other[_SIZE * _SIZE // 2]
    for i in range(HALF_PX - half, HALF_PX + half + 1):
        for k in range(i * _SIZE + HALF_PX - half, i * _SIZE + HALF_PX + half + 1):
            off = other[k] - design[4, k]
            off -= a * design[0, k] + b * design[1, k] + c * design[2, k] + d
            left += off * off
            mean += other[k] - first
            square += (other[k] - first) * (other[k] - first)
    return float(left), float(square - mean * mean / np.float32((2 * half + 1) ** 2))


@kernel()
def _middle_holds(other: Float32, design: Float32, step: Float64, variance: float) -> bool:
    """Check that the patch's middle matches at that position and would determine it alone.

    other: (_SIZE^2,). design: (5, _SIZE^2), see `_prepare`; step: (4,), see `_step`. variance: DN^2 of a
    pixel's noise.
    """
    left, spread = _misfit(other, design, step, CORE_PX)
    if 1 - left / max(spread, 1e-9) < MIN_CORE_LIKENESS:
        return False
    along, both, down = 0.0, 0.0, 0.0
    for i in range(HALF_PX - MIDDLE_PX, HALF_PX + MIDDLE_PX + 1):
        for k in range(i * _SIZE + HALF_PX - MIDDLE_PX, i * _SIZE + HALF_PX + MIDDLE_PX + 1):
            along += design[0, k] * design[0, k]
            both += design[0, k] * design[1, k]
            down += design[1, k] * design[1, k]
    weaker = (along + down) / 2 - np.sqrt(((along - down) / 2) ** 2 + both * both)
    return bool(variance < MAX_MIDDLE_SIGMA_PX**2 * weaker)


@kernel()
def _locate(
    source: Float32, target: Float32, places: Float64, pixels: Float64, grown: Float64, sigma: Float64,
    likeness: Float64, reach: float,
) -> None:  # fmt: skip
    """Align each patch by inverse-compositional Gauss-Newton [Baker 2004].

    source, target: (H, W) spline coefficients. places: (N, 2) x, y px in the source. pixels: (N, 2) guesses
    in the target, replaced where the patch is found within `reach` px of them in x and y. grown: (N,), see
    `align_patches`. sigma: (N,) px, likeness: (N,); filled where it is found, else left as they were (NaN and
    0).
    """
    wide = np.empty((_SIZE + 2, _SIZE + 2), np.float32)
    room = np.empty((2, _SIZE + 2, 4), np.float32)
    rows = np.empty((MAX_ROWS, _SIZE + 2), np.float32)
    other = np.empty((_SIZE, _SIZE), np.float32)
    flat = other.ravel()
    design = np.empty((5, _SIZE * _SIZE), np.float32)
    normal, step = np.empty((4, 4)), np.empty(4)
    for n in range(places.shape[0]):
        size = 1 / grown[n]
        if (_SIZE + 2) * size + 5 > MAX_ROWS or not _inside(
            source, places[n, 0], places[n, 1], (HALF_PX + 1) * size
        ):
            continue
        _read(source, places[n, 0], places[n, 1], HALF_PX + 1, size, wide, rows, room)
        if _prepare(wide, design, normal) < MIN_CONTRAST_DN:
            continue
        if normal[0, 0] * normal[1, 1] - normal[0, 1] ** 2 < 1e-3 * normal[0, 0] * normal[1, 1] + 1e-9:
            continue
        inverse = np.linalg.inv(normal)
        x0, y0 = pixels[n, 0], pixels[n, 1]
        x, y = x0, y0
        settled = False
        for _ in range(MAX_STEPS):
            if not _inside(target, x, y, HALF_PX):
                break
            _read_whole(target, x, y, other, rows, room)
            _step(flat, design, inverse, step)
            x -= step[0]
            y -= step[1]
            if abs(x - x0) > reach or abs(y - y0) > reach:
                break
            if abs(step[0]) < CLOSE_PX and abs(step[1]) < CLOSE_PX:
                settled = True
                break
        if not settled:
            continue
        left, spread = _misfit(flat, design, step, HALF_PX)
        variance = left / (_SIZE * _SIZE - 4)
        if not _middle_holds(flat, design, step, variance):
            continue
        middle = variance * (inverse[0, 0] + inverse[1, 1]) / 2
        swing = np.sqrt(((inverse[0, 0] - inverse[1, 1]) / 2) ** 2 + inverse[0, 1] ** 2)
        sigma[n] = np.sqrt(middle + variance * swing)
        pixels[n, 0], pixels[n, 1] = x, y
        likeness[n] = 1 - left / max(spread, 1e-9)
