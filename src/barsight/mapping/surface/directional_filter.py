"""Average heights along bars and deblur across them: a bar is straight, so the same height is measured
repeatedly along it, and the blur of matching's window across it can be undone without amplifying the
noise.
"""

from __future__ import annotations

import cv2
import numpy as np

from barsight.core.arrays import Bool, Float32, Float64, Int8, Int64, kernel
from barsight.mapping.surface.bar_directions import (
    DIRECTIONS,
    FINE_RATIO,
    choose_directions,
    elect_directions,
    line_cells,
)

VOTE_CELLS = 9
_STEP_M = 0.03
_MAX_BLUR_CELLS = np.float32(1.5)
"""Maximum blur that is undone in full."""
_BLUR_CELLS, _BLUR_RATIO, _VALLEY_RATIO = 11, 2.0, 4.5
_VALLEY_CELLS = 6
_RAMP_PX, _RAMP_RATIO, _RIM_PX, _RIM_RATIO = 3.0, 0.5, 1.0, 0.5
_FAR_M = np.float32(1e4)


def smooth_along_bars(z: Float32, weight: Float32, gate_m: float, reach: int) -> tuple[Float32, Int8]:
    """Average heights (H, W) along the bar. Also return the index (of 16) of the direction in which each is
    most alike over a short distance, -1 where there is no height.

    weight: (H, W), 0 where there is no height (NaN). Heights further than gate_m from a cell's own are
    another surface and don't count. Every other cell up to `reach` on either side is read, in the direction
    of `elect_directions`.
    """
    direction = choose_directions(z, weight > 0, gate_m, reach)
    elected = elect_directions(z, direction, gate_m, reach)
    rows, columns = line_cells(FINE_RATIO * DIRECTIONS, reach)
    padded, weights = np.pad(z, reach, constant_values=np.nan), np.pad(weight, reach)
    return _average_along(padded, weights, elected, gate_m, rows, columns, reach), direction


def vote_directions(direction: Int8) -> Int8:
    """Replace each direction (H, W) of `smooth_along_bars` by the most frequent one in 9 x 9 cells, the
    first one in a tie; -1 stays. On bars that the heights hardly show, noise rotates single ones.
    """
    most = np.zeros(direction.shape, np.uint16)
    for number in range(DIRECTIONS):
        own = (direction == number).view(np.uint8)
        votes = cv2.boxFilter(own, -1, (VOTE_CELLS,) * 2, normalize=False, borderType=cv2.BORDER_CONSTANT)
        np.maximum(most, votes * np.uint16(DIRECTIONS) + np.uint16(DIRECTIONS - 1 - number), out=most)
    voted = (DIRECTIONS - 1 - most % DIRECTIONS).astype(np.int8)
    voted[direction < 0] = -1
    return voted


@kernel()
def _average_along(
    z: Float32, weight: Float32, elected: Int8, gate_m: float, rows: Int64, columns: Int64, reach: int
) -> Float32:  # fmt: skip
    """Average heights along each cell's direction; NaN and cells without direction stay as they are.

    z, weight: (H + 2 reach, W + 2 reach). elected: (H, W). rows, columns: (directions, N) offsets from the
    cell.
    """
    height, width = elected.shape
    out = z[reach : reach + height, reach : reach + width].copy()
    flat, weights, ways = z.ravel(), weight.ravel(), rows * z.shape[1] + columns
    for i in range(height):
        for j in range(width):
            if elected[i, j] < 0:
                continue
            middle = (i + reach) * z.shape[1] + reach + j
            own_m, off, total = flat[middle], 0.0, 0.0
            for k in range(ways.shape[1]):
                at = middle + ways[elected[i, j], k]
                gap = flat[at] - own_m
                if abs(gap) <= gate_m:
                    off += weights[at] * gap
                    total += weights[at]
            out[i, j] = own_m + off / total
    return out


def deblur_across(z: Float32, direction: Int8, blur_cells: Float32) -> Float32:
    """Deblur heights (H, W) across the bar: move them away from the mean of both neighbours by what a blur
    with a sigma of blur_cells (H, W) takes from crests and adds to valleys [van Cittert 1931, one step].

    direction: (H, W) the bar's own, of `smooth_along_bars`, which also returned the heights z. A cell stays
    as it is where a neighbour is missing or more than 30 mm higher or lower, which is a step and not a
    curvature. A blur above `_MAX_BLUR_CELLS` is undone only in part, since the noise would grow more than the
    bars gain.
    """
    rows, columns = np.rint(_across()).astype(np.int64)
    return _sharpened(z, direction, np.minimum(blur_cells, _MAX_BLUR_CELLS) ** 2, rows, columns)


def valley_mask(z: Float32, direction: Int8) -> Bool:
    """Mark valleys (H, W): cells with a higher one on both sides, across the bar and within `_VALLEY_CELLS`;
    cells beyond a step of more than 30 mm don't count.

    z: (H, W) heights, NaN where there is none; direction: (H, W) the bar's own, of `smooth_along_bars`.
    """
    onward = np.arange(1, _VALLEY_CELLS + 1)[:, None]
    rows, columns = (np.rint(onward * turn).astype(np.int64) for turn in _across())
    return _valleys(z, direction, rows, columns)


def blur_sigma(moved: Float32, valley: Bool) -> Float32:
    """Estimate the standard deviation (H, W) that blur and gloss leave on bars. moved: (H, W) distance by
    which `deblur_across` has moved heights, NaN or 0 where it couldn't; valley: (H, W), see `valley_mask`.

    The best correction differs between stacks by more than its own size, and flanks are as uncertain as
    crests: the estimate is `_BLUR_RATIO` times the RMS over about a bar's width. Two bars of diameter D meet
    in a cusp: a pixel's width p from its bottom, they are sqrt(D p) higher, while a crest falls by p^2 / D.
    So valleys get `_VALLEY_RATIO` times the RMS. Both ratios were calibrated on seven yards.
    """
    known = np.isfinite(moved) & (moved != 0)
    squares, count = (
        cv2.blur(a.astype(np.float32), (_BLUR_CELLS, _BLUR_CELLS))
        for a in (np.where(known, moved, 0) ** 2, known)
    )
    share = np.where(valley, np.float32(_VALLEY_RATIO), np.float32(_BLUR_RATIO))
    return np.asarray(share * np.sqrt(np.maximum(squares, 0) / np.maximum(count, 1e-6)), np.float32)


def step_sigma(z: Float32, pixel_cells: float) -> Float32:
    """Estimate the standard deviation (H, W) of heights beside steps of more than 30 mm, 0 elsewhere.

    Matching stretches a higher surface over a lower one by one to three pixels, and the map's cells then lie
    on a ramp between both. The estimate combines half of a height's distance above the lowest one within a
    pixel, and half of the smaller of its distances to the lowest and the highest one within three pixels. z:
    (H, W), NaN where there is none. pixel_cells: width of a pixel on the ground.
    """
    unknown = np.isnan(z)
    low, high = np.where(unknown, _FAR_M, z), np.where(unknown, -_FAR_M, z)

    def ways(reach_px: float) -> tuple[Float32, Float32, Bool]:
        around = np.ones((2 * max(round(reach_px * pixel_cells), 1) + 1,) * 2, np.uint8)
        down, up = z - cv2.erode(low, around), cv2.dilate(high, around) - z
        return down, up, down + up > _STEP_M

    down, up, is_step = ways(_RAMP_PX)
    ramp = np.where(is_step, np.minimum(down, up), 0)
    down, _, is_step = ways(_RIM_PX)
    rim = np.where(is_step, down, 0)
    return np.asarray(np.sqrt((_RAMP_RATIO * ramp) ** 2 + (_RIM_RATIO * rim) ** 2), np.float32)


def _across() -> Float64:
    """Compute a step of one cell across the bar for each direction (2, 16), in rows and in columns."""
    turn = np.arange(DIRECTIONS) * np.pi / DIRECTIONS
    return np.array([np.cos(turn), -np.sin(turn)])


@kernel()
def _sharpened(z: Float32, direction: Int8, share: Float32, rows: Int64, columns: Int64) -> Float32:
    """Deblur heights across the bar by one step of van Cittert's iteration [1931]; returns a new array.

    z: (H, W) m, NaN where there is none. direction: (H, W), -1 where there is none. share: (H, W) the blur's
    variance, cells^2. rows, columns: (16,) offset by one cell across each direction. A cell without
    direction, on the border, or next to a missing height or a step stays as it is.
    """
    height, width = z.shape
    out = z.copy()
    for i in range(1, height - 1):
        for j in range(1, width - 1):
            if direction[i, j] < 0:
                continue
            di, dj = rows[direction[i, j]], columns[direction[i, j]]
            before, after = z[i - di, j - dj] - z[i, j], z[i + di, j + dj] - z[i, j]
            if abs(before) <= _STEP_M and abs(after) <= _STEP_M:
                out[i, j] = z[i, j] - share[i, j] * (before + after) / 2 / (di * di + dj * dj)
    return out


@kernel()
def _valleys(z: Float32, direction: Int8, rows: Int64, columns: Int64) -> Bool:
    """Mark valleys (H, W): cells with a higher one on both sides across the bar, before any step.

    z: (H, W) m; missing heights (NaN) in between are skipped. direction: (H, W); where it is -1 there is no
    valley. rows, columns: (_VALLEY_CELLS, 16) offsets across each direction.
    """
    height, width = z.shape
    out = np.zeros(z.shape, np.bool_)
    for i in range(height):
        for j in range(width):
            d = direction[i, j]
            if d < 0:
                continue
            sides = 0
            for side in (-1, 1):
                for k in range(rows.shape[0]):
                    a, b = i + side * rows[k, d], j + side * columns[k, d]
                    if not (0 <= a < height and 0 <= b < width) or abs(z[a, b] - z[i, j]) > _STEP_M:
                        break
                    if z[a, b] > z[i, j]:
                        sides += 1
                        break
            out[i, j] = sides == 2
    return out
