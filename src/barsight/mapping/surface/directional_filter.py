"""Average heights along bars and deblur across them: a bar is straight, so along it the same height is
measured again and again, and what matching's window has blurred across it can be undone without raising the
noise.
"""

from __future__ import annotations

import cv2
import numpy as np

from barsight.core.arrays import Bool, Float32, Float64, Int8, Int64, kernel

VOTE_CELLS = 9
_SAMPLE_CELLS = 2
_DIRECTIONS = 16
_STEP_M = 0.03
_WIDEST_CELLS = np.float32(1.5)
_BLUR_CELLS, _BLUR_RATIO, _VALLEY_RATIO = 11, 2.0, 4.5
_VALLEY_CELLS = 6
_RAMP_PX, _RAMP_RATIO, _RIM_PX, _RIM_RATIO = 3.0, 0.5, 1.0, 0.5
_FAR_M = np.float32(1e4)


def smooth_along_bars(z: Float32, weight: Float32, gate_m: float, reach: int) -> tuple[Float32, Int8]:
    """Average heights (H, W) along that of 16 directions in which each is most alike, and the number of that
    direction, -1 where there is no height.

    weight: (H, W), 0 where there is no height (NaN). Heights further than gate_m from a cell's own are
    another surface: they don't count in its mean, and against the direction. Every other cell up to `reach`
    on either side is read; those that are missing or outside count against the direction too.
    """
    turn = np.arange(_DIRECTIONS)[:, None] * np.pi / _DIRECTIONS
    onward = np.arange(_SAMPLE_CELLS, reach + 1, _SAMPLE_CELLS)
    along = np.r_[-onward[::-1], 0, onward]
    rows, columns = (np.rint(f(turn) * along).astype(np.int64) for f in (np.sin, np.cos))
    z, weight = np.pad(z, reach, constant_values=np.nan), np.pad(weight, reach)
    return _lengthways(z, weight, gate_m, rows, columns, reach)


def vote_directions(direction: Int8) -> Int8:
    """Replace each direction (H, W) of `smooth_along_bars` by the most frequent one, the first of those that
    are alike, in 9 x 9 cells; -1 stays. On bars that the heights hardly show, noise turns single ones.
    """
    most = np.zeros(direction.shape, np.uint16)
    for number in range(_DIRECTIONS):
        own = (direction == number).view(np.uint8)
        votes = cv2.boxFilter(own, -1, (VOTE_CELLS,) * 2, normalize=False, borderType=cv2.BORDER_CONSTANT)
        np.maximum(most, votes * np.uint16(_DIRECTIONS) + np.uint16(_DIRECTIONS - 1 - number), out=most)
    voted = (_DIRECTIONS - 1 - most % _DIRECTIONS).astype(np.int8)
    voted[direction < 0] = -1
    return voted


@kernel()
def _lengthways(
    z: Float32, weight: Float32, gate_m: float, rows: Int64, columns: Int64, reach: int
) -> tuple[Float32, Int8]:
    """Average along the best direction, the first of those that are alike.

    z, weight: with `reach` cells more on each side. The squares of a whole row of cells are summed at once,
    direction by direction, which vector instructions do. z, weight: (rows + 2 reach, columns + 2 reach).
    rows, columns: (16, N) cells from the middle to each point of a direction. Returns the heights and the
    directions, (rows, columns), -1 where there is none.
    """
    height, width = z.shape[0] - 2 * reach, z.shape[1] - 2 * reach
    out, chosen = np.empty((height, width), np.float32), np.full((height, width), -1, np.int8)
    least, squares = np.empty(width, np.float32), np.empty(width, np.float32)
    gate, best = np.float32(gate_m), np.empty(width, np.int32)
    flat, weights, ways = z.ravel(), weight.ravel(), rows * z.shape[1] + columns
    for i in range(height):
        out[i] = z[i + reach, reach : reach + width]
        known = np.flatnonzero(weight[i + reach, reach : reach + width] > 0)
        if known.size == 0:
            continue
        first, size = reach + known[0], known[-1] + 1 - known[0]
        own = z[i + reach, first : first + size]
        least[:size] = np.inf
        for d in range(rows.shape[0]):
            squares[:size] = 0
            for k in range(rows.shape[1]):
                b = first + columns[d, k]
                if rows[d, k] == 0 and columns[d, k] == 0:
                    continue
                _add_squares(squares[:size], z[i + reach + rows[d, k], b : b + size], own, gate)
            for j in range(size):
                best[j] = d if squares[j] < least[j] else best[j]
                least[j] = min(squares[j], least[j])
        for column in known:
            chosen[i, column] = best[column - known[0]]
            middle = (i + reach) * z.shape[1] + reach + column
            own_m = flat[middle]
            off, total = 0.0, 0.0
            for k in range(ways.shape[1]):
                at = middle + ways[chosen[i, column], k]
                gap = flat[at] - own_m
                if abs(gap) <= gate_m:
                    off += weights[at] * gap
                    total += weights[at]
            out[i, column] = own_m + off / total
    return out, chosen


@kernel()
def _add_squares(squares: Float32, beside: Float32, own: Float32, gate_m: np.float32) -> None:
    """Add the squared differences of two rows of heights (W,), each no more than the gate; as much where one
    is missing.
    """
    for j in range(squares.size):
        gap = abs(beside[j] - own[j])
        squares[j] += gap * gap if gap <= gate_m else gate_m * gate_m


def deblur_across(z: Float32, direction: Int8, blur_cells: Float32) -> Float32:
    """Deblur heights (H, W) across the bar, away from the mean of both neighbours: what a blur with a sigma
    of blur_cells (H, W) takes from crests and gives to valleys [van Cittert 1931, one step].

    direction: (H, W) the bar's own, of `smooth_along_bars`, whose heights z are. A cell stays as it is where
    a neighbour is missing or over 30 mm higher or lower, which is a step and no bend. A wider blur than
    `_WIDEST_CELLS` is undone in part only, since noise would grow more than bars gain.
    """
    rows, columns = np.rint(_across()).astype(np.int64)
    return _sharpened(z, direction, np.minimum(blur_cells, _WIDEST_CELLS) ** 2, rows, columns)


def valley_mask(z: Float32, direction: Int8) -> Bool:
    """Mark valleys (H, W): heights below something on either side, across the bar and no further than
    `_VALLEY_CELLS`: what a step of over 30 mm parts from it doesn't count.

    z: (H, W) heights, NaN where there is none; direction: (H, W) the bar's own, of `smooth_along_bars`.
    """
    onward = np.arange(1, _VALLEY_CELLS + 1)[:, None]
    rows, columns = (np.rint(onward * turn).astype(np.int64) for turn in _across())
    return _valleys(z, direction, rows, columns)


def blur_sigma(moved: Float32, valley: Bool) -> Float32:
    """Estimate the standard deviation (H, W) that blur and gloss leave on bars. moved: (H, W) by how much
    `deblur_across` has moved heights, NaN or 0 where it couldn't; valley: (H, W), see `valley_mask`.

    The correction that is best differs from stack to stack by more than itself, and flanks are as unsure as
    crests: `_BLUR_RATIO` times the RMS over about a bar's width. Two bars of diameter D meet in a cusp: a
    pixel's width p beside its bottom they lie sqrt(D p) higher, while a crest falls by p^2 / D. So valleys
    have `_VALLEY_RATIO` times the RMS. Both shares were found on seven yards.
    """
    known = np.isfinite(moved) & (moved != 0)
    squares, count = (
        cv2.blur(a.astype(np.float32), (_BLUR_CELLS, _BLUR_CELLS))
        for a in (np.where(known, moved, 0) ** 2, known)
    )
    share = np.where(valley, np.float32(_VALLEY_RATIO), np.float32(_BLUR_RATIO))
    return np.asarray(share * np.sqrt(np.maximum(squares, 0) / np.maximum(count, 1e-6)), np.float32)


def step_sigma(z: Float32, pixel_cells: float) -> Float32:
    """Estimate the standard deviation (H, W) of heights beside steps of over 30 mm, 0 elsewhere.

    Matching stretches a higher surface over a lower one by one to three pixels, and the map's cells then lie
    on a ramp between both: half of what a height has over the lowest one within a pixel, and half of the
    smaller way to the lowest and to the highest one within three. z: (H, W), NaN where there is none.
    pixel_cells: a pixel's width on the ground.
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
    """Compute one cell across the bar of each direction (2, 16), as a step in rows and in columns."""
    turn = np.arange(_DIRECTIONS) * np.pi / _DIRECTIONS
    return np.array([np.cos(turn), -np.sin(turn)])


@kernel()
def _sharpened(z: Float32, direction: Int8, share: Float32, rows: Int64, columns: Int64) -> Float32:
    """Deblur heights across the bar by one step of van Cittert's iteration [1931]; returns a new array.

    z: (H, W) m, NaN where there is none. direction: (H, W), -1 where there is none. share: (H, W) the blur's
    variance, cells^2. rows, columns: (16,) one cell across each direction. A cell without direction, on the
    border, beside a missing height or a step stays as it is.
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

    z: (H, W) m; a missing height (NaN) on the way is passed over. direction: (H, W), -1 where there is none,
    and then no valley. rows, columns: (_VALLEY_CELLS, 16) cells across each direction.
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
