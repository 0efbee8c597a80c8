"""Patches found again to a few hundredths of a pixel, whatever the gain and offset between the pictures.

Lucas-Kanade by Gauss-Newton [Baker 2004, inverse compositional] with two more unknowns, gain and offset:
two cameras never expose alike, and where a patch is brighter on one side an offset of 5 % moves plain
Lucas-Kanade by tenths of a pixel. Pictures are read as cubic B-splines, which hardly damp fine texture at
any fraction of a pixel.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from barsight.core.arrays import Bool, Float32, Float64, UInt8, kernel
from barsight.core.types import RectifiedPair

HALF_PX = 5
"""A patch is 2 * HALF_PX + 1 wide."""
MOST_STEPS = 15
CLOSE_PX = 0.01
COARSE_REACH_PX = 6.0
"""How far from its guess the half-size picture may take a patch, full px."""
FINE_REACH_PX = 2.5
LEAST_LIKENESS = 0.7
LEAST_CONTRAST_DN = 1.0
_POLE = 3.0**0.5 - 2.0
_PREFILTER = (3.0**0.5 * _POLE ** np.abs(np.arange(-8, 9))).astype(np.float32)


@dataclass(frozen=True, eq=False)
class PatchImage:
    """A picture ready to be read at fractions of a pixel: spline coefficients (H, W), also at half size."""

    fine: Float32
    coarse: Float32


@dataclass(frozen=True, eq=False)
class PatchPair:
    """A rectified pair and its pictures ready to be read."""

    pair: RectifiedPair
    left: PatchImage
    right: PatchImage


@dataclass(frozen=True, eq=False)
class Located:
    """pixels: (N, 2) x, y in the target. sigma_px: (N,) of x and y each, from the patch's own misfit, along
    its weaker direction. likeness: (N,) share of the patch's variance that the other patch explains.
    found: (N,) whether it settled near its guess and is alike.
    """

    pixels: Float64
    sigma_px: Float64
    likeness: Float64
    found: Bool


def patch_image(image: UInt8) -> PatchImage:
    """The coefficients of an (H, W) picture."""
    return PatchImage(_coefficients(image), _coefficients(cv2.pyrDown(image)))


def patch_pair(pair: RectifiedPair) -> PatchPair:
    """Both pictures of a pair made ready."""
    return PatchPair(pair, patch_image(pair.left), patch_image(pair.right))


def locate(
    source: PatchImage, target: PatchImage, places: Float64, guesses: Float64, sure: bool = False,
    grown: Float64 | None = None,
) -> Located:  # fmt: skip
    """Where `target` shows the patches of `source` at `places` (N, 2), near the `guesses` (N, 2).

    grown: (N,) how much larger the target shows them, 1 where it isn't given. sure: the guesses are within
    `FINE_REACH_PX`; otherwise the half-size pictures are asked first.
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
) -> Located:
    count = len(places)
    pixels, sigma, likeness = guesses.copy(), np.full(count, np.nan), np.zeros(count)
    _locate(source, target, places, pixels, grown, sigma, likeness, reach)
    found: Bool = np.isfinite(sigma) & (likeness > LEAST_LIKENESS)
    return Located(pixels, sigma, likeness, found)


def _coefficients(image: UInt8) -> Float32:
    """Cubic B-spline coefficients; the recursive prefilter's tail is cut at 8 px, where it is 3e-5."""
    result: Float32 = cv2.sepFilter2D(
        image, cv2.CV_32F, _PREFILTER, _PREFILTER, borderType=cv2.BORDER_REFLECT_101
    )
    return result


@kernel(fastmath=True)
def _weights(t: float, weights: Float64) -> None:
    """The four B-spline weights at a fraction t of a pixel."""
    t2, rest = t * t, 1 - t
    weights[0] = rest * rest * rest / 6
    weights[3] = t2 * t / 6
    weights[1] = (4 - 6 * t2) / 6 + 3 * weights[3]
    weights[2] = 1 - weights[0] - weights[1] - weights[3]


@kernel(fastmath=True)
def _read(image: Float32, x: float, y: float, half: int, step: float, patch: Float64, room: Float64) -> bool:
    """The (2 half + 1)^2 patch around (x, y), `step` px between its pixels; false where it leaves it.

    room: (2, at least 2 half + 1, 4) scratch.
    """
    reach = half * step
    if x - reach < 1 or y - reach < 1 or x + reach > image.shape[1] - 3 or y + reach > image.shape[0] - 3:
        return False
    size = 2 * half + 1
    for j in range(size):
        px, py = x + (j - half) * step, y + (j - half) * step
        _weights(px - np.floor(px), room[0, j])
        _weights(py - np.floor(py), room[1, j])
    for i in range(size):
        top = int(np.floor(y + (i - half) * step)) - 1
        b = room[1, i]
        first, second, third, fourth = image[top], image[top + 1], image[top + 2], image[top + 3]
        for j in range(size):
            left = int(np.floor(x + (j - half) * step)) - 1
            value = 0.0
            for k in range(4):
                c = left + k
                value += room[0, j, k] * (
                    b[0] * first[c] + b[1] * second[c] + b[2] * third[c] + b[3] * fourth[c]
                )
            patch[i, j] = value
    return True


@kernel()
def _locate(
    source: Float32, target: Float32, places: Float64, pixels: Float64, grown: Float64, sigma: Float64,
    likeness: Float64, reach: float,
) -> None:  # fmt: skip
    half, size = HALF_PX, 2 * HALF_PX + 1
    wide = np.empty((size + 2, size + 2))
    room = np.empty((2, size + 2, 4))
    other = np.empty((size, size))
    design = np.empty((size * size, 4))
    residual = np.empty(size * size)
    for n in range(places.shape[0]):
        if not _read(source, places[n, 0], places[n, 1], half + 1, 1 / grown[n], wide, room):
            continue
        mean = wide[1:-1, 1:-1].mean()
        for i in range(size):
            for j in range(size):
                k = i * size + j
                design[k, 0] = (wide[i + 1, j + 2] - wide[i + 1, j]) / 2
                design[k, 1] = (wide[i + 2, j + 1] - wide[i, j + 1]) / 2
                design[k, 2] = wide[i + 1, j + 1] - mean
                design[k, 3] = 1.0
        if design[:, 2].std() < LEAST_CONTRAST_DN:
            continue
        normal = design.T @ design
        if normal[0, 0] * normal[1, 1] - normal[0, 1] ** 2 < 1e-3 * normal[0, 0] * normal[1, 1] + 1e-9:
            continue
        inverse = np.linalg.inv(normal)
        x0, y0 = pixels[n, 0], pixels[n, 1]
        x, y = x0, y0
        settled = False
        for _ in range(MOST_STEPS):
            if not _read(target, x, y, half, 1.0, other, room):
                break
            for i in range(size):
                for j in range(size):
                    residual[i * size + j] = other[i, j] - wide[i + 1, j + 1]
            step = inverse @ (design.T @ residual)
            x -= step[0]
            y -= step[1]
            if abs(x - x0) > reach or abs(y - y0) > reach:
                break
            if abs(step[0]) < CLOSE_PX and abs(step[1]) < CLOSE_PX:
                settled = True
                break
        if not settled:
            continue
        misfit = residual - design @ step
        variance = (misfit**2).sum() / (size * size - 4)
        spread = variance * inverse
        middle = (spread[0, 0] + spread[1, 1]) / 2
        swing = np.sqrt(((spread[0, 0] - spread[1, 1]) / 2) ** 2 + spread[0, 1] ** 2)
        sigma[n] = np.sqrt(middle + swing)
        pixels[n, 0], pixels[n, 1] = x, y
        likeness[n] = 1 - (misfit**2).mean() / max(other.var(), 1e-9)
