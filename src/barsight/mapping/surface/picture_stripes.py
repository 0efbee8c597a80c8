"""Find the stripes that bars make in the picture where the heights don't show the bars."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from barsight.core.arrays import Float32, Int8, Int64, kernel
from barsight.mapping.surface.bar_directions import DIRECTIONS

NODE_CELLS = 2
STEP_CELLS = 1.4
"""Height difference between neighbouring cells, in cells, above which a surface ends."""
_ACROSS_CELLS, _ALONG_CELLS, _TAPER_CELLS = 6, 6, 1.5
_PITCHES = np.float32(2.4) * np.float32(1.06) ** np.arange(24, dtype=np.float32)
_MIN_EXPLAINED, _MIN_CONTRAST, _MIN_SPREAD = 0.6, 0.12, 0.06
_MIN_CELLS, _MIN_INDEPENDENCE = 2.5, 0.04


class Stripes(NamedTuple):
    """The picture's stripes at every second cell (rows, columns): pitch and distance to the nearest crest
    across the bar, cells; pitch 0 where there are none.
    """

    pitch: Float32
    crest: Float32


class _Window(NamedTuple):
    """A node's window for each direction: cells across (16, N) and along (16, L) as offsets in rows and
    columns, weights (16, N), and cosine and sine at each cell for each pitch (16, N, pitches).
    """

    across_rows: Int64
    across_columns: Int64
    along_rows: Int64
    along_columns: Int64
    taper: Float32
    cosine: Float32
    sine: Float32


def find_stripes(z: Float32, gray: Float32, direction: Int8, cell_m: float) -> Stripes:
    """Fit a wave across the bars to the gray levels (H, W) around every second cell of heights z (H, W).

    direction: (H, W), of `smooth_along_bars`. Each cell across is the mean of 13 along the bar. The pitch
    (2.4 to 9.2 cells) is the one that explains most of the variance; it is a stripe's if that is at least 60
    %, with an amplitude of at least 12 % of the mean.
    """
    shape = tuple(-(-side // NODE_CELLS) for side in z.shape)
    stripes = Stripes(np.zeros(shape, np.float32), np.zeros(shape, np.float32))
    _fit_stripes(z, gray, direction, STEP_CELLS * cell_m, _PITCHES, _window(), *stripes)
    return stripes


@lru_cache(maxsize=1)
def _window() -> _Window:
    """Build the window of `_fit_stripes`."""
    turn = np.arange(DIRECTIONS)[:, None] * np.pi / DIRECTIONS
    across, along = np.arange(-_ACROSS_CELLS, _ACROSS_CELLS + 1), np.arange(-_ALONG_CELLS, _ALONG_CELLS + 1)
    rows, columns = np.rint(np.cos(turn) * across), np.rint(-np.sin(turn) * across)
    place = rows * np.cos(turn) - columns * np.sin(turn)
    taper = np.cos(np.pi / 2 * place / (_ACROSS_CELLS + _TAPER_CELLS)) ** 2
    phase = 2 * np.pi * place[:, :, None] / _PITCHES
    return _Window(
        rows.astype(np.int64),
        columns.astype(np.int64),
        np.rint(np.sin(turn) * along).astype(np.int64),
        np.rint(np.cos(turn) * along).astype(np.int64),
        taper.astype(np.float32),
        np.cos(phase).astype(np.float32),
        np.sin(phase).astype(np.float32),
    )


@kernel()
def _fit_stripes(
    z: Float32, gray: Float32, direction: Int8, step_m: float, pitches: Float32, window: _Window,
    pitch: Float32, crest: Float32,
) -> None:  # fmt: skip
    """Fit the wave of each node, see `find_stripes`.

    z, gray: (H, W), NaN where there is none. direction: (H, W), -1 where there is none. step_m: height
    difference between cells above which a surface ends. pitches: (P,) cells. Fills pitch and crest (rows,
    columns).
    """
    count = window.taper.shape[1]
    level, weight = np.empty(count, np.float32), np.empty(count, np.float32)
    along = np.full(z.shape, -1, np.int8), np.empty(z.shape, np.float32), np.empty(z.shape, np.float32)
    sums = np.empty((7, pitches.size), np.float32)
    for row in range(pitch.shape[0]):
        for column in range(pitch.shape[1]):
            i, j = row * NODE_CELLS, column * NODE_CELLS
            d = direction[i, j]
            if d < 0:
                continue
            total = _read_across(z, gray, i, j, d, step_m, window, along, level, weight)
            if total < _MIN_CELLS:
                continue
            mean, power = np.float32(0), np.float32(0)
            for k in range(count):
                mean += weight[k] * level[k]
            mean /= total
            for k in range(count):
                level[k] -= mean
                power += weight[k] * level[k] * level[k]
            if power > total * (_MIN_SPREAD * mean) ** 2:
                _sum_waves(level, weight, window.cosine[d], window.sine[d], sums)
                pitch[row, column], crest[row, column] = _best_wave(sums, total, mean, power, pitches)


@kernel()
def _sum_waves(level: Float32, weight: Float32, cosine: Float32, sine: Float32, sums: Float32) -> None:
    """Sum the terms of each wave's normal equations: cos, sin, cos^2, sin^2, cos sin, and level times cos and
    sin.

    level, weight: (N,). cosine, sine: (N, P). Fills sums (7, P).
    """
    sums[:] = 0
    for k in range(weight.size):
        w, v = weight[k], level[k]
        if w == 0:
            continue
        for p in range(sums.shape[1]):
            c, s = cosine[k, p], sine[k, p]
            wc, ws = w * c, w * s
            sums[0, p] += wc
            sums[1, p] += ws
            sums[2, p] += wc * c
            sums[3, p] += ws * s
            sums[4, p] += wc * s
            sums[5, p] += wc * v
            sums[6, p] += ws * v


@kernel()
def _best_wave(
    sums: Float32, total: np.float32, mean: np.float32, power: np.float32, pitches: Float32
) -> tuple[float, float]:
    """Select the wave that explains most of the power: its pitch and the distance to its crest, cells; pitch
    0 where no wave qualifies as a stripe.

    sums: (7, P), see `_sum_waves`, of levels minus their mean. total: sum of the weights. pitches: (P,)
    cells.
    """
    best, pitch, crest = _MIN_EXPLAINED * power, 0.0, 0.0
    for p in range(pitches.size):
        cc = sums[2, p] - sums[0, p] * sums[0, p] / total
        ss = sums[3, p] - sums[1, p] * sums[1, p] / total
        cs = sums[4, p] - sums[0, p] * sums[1, p] / total
        determinant = cc * ss - cs * cs
        if determinant < _MIN_INDEPENDENCE * total * total:
            continue
        a = (sums[5, p] * ss - sums[6, p] * cs) / determinant
        b = (sums[6, p] * cc - sums[5, p] * cs) / determinant
        explained = a * sums[5, p] + b * sums[6, p]
        if explained > best:
            best = explained
            pitch = float(pitches[p]) if a * a + b * b > (_MIN_CONTRAST * mean) ** 2 else 0.0
            crest = np.arctan2(b, a) / (2 * np.pi) * pitches[p]
    return pitch, crest


@kernel()
def _read_across(
    z: Float32, gray: Float32, i: int, j: int, d: int, step_m: float, window: _Window,
    along: tuple[Int8, Float32, Float32], level: Float32, weight: Float32,
) -> np.float32:  # fmt: skip
    """Average gray levels along the bar at each cell across it, outward from cell (i, j) up to a step.

    z, gray: (H, W). d: the direction. along: (H, W) each, a cache shared by neighbouring nodes: the direction
    in which a cell was last averaged (-1 before the first), its mean and its share of known cells. Fills
    level and weight (N,), 0 beyond a step, and returns the weights' sum.
    """
    height, width = z.shape
    middle, (turned, means, shares) = weight.size // 2, along
    weight[:], level[:] = 0, 0
    total = np.float32(0)
    for side in (-1, 1):
        last = z[i, j]
        for n in range((1 - side) // 2, middle + 1):
            k = middle + side * n
            a, b = i + window.across_rows[d, k], j + window.across_columns[d, k]
            if not (0 <= a < height and 0 <= b < width) or not abs(z[a, b] - last) <= step_m:
                break
            last = z[a, b]
            if turned[a, b] != d:
                turned[a, b] = d
                means[a, b], shares[a, b] = _mean_along(z, gray, a, b, d, step_m, window)
            level[k] = means[a, b]
            weight[k] = window.taper[d, k] * shares[a, b]
            total += weight[k]
    return total


@kernel()
def _mean_along(
    z: Float32, gray: Float32, row: int, column: int, d: int, step_m: float, window: _Window
) -> tuple[np.float32, np.float32]:
    """Average gray levels (H, W) along direction d over the cells whose heights z (H, W) are within step_m
    of the central one; return the mean and the share of cells that are known, 0 and 0 if none is.
    """
    height, width = z.shape
    heard, known, long = np.float32(0), 0, window.along_rows.shape[1]
    for q in range(long):
        a, b = row + window.along_rows[d, q], column + window.along_columns[d, q]
        inside = 0 <= a < height and 0 <= b < width
        if inside and abs(z[a, b] - z[row, column]) <= step_m and gray[a, b] > 0:
            heard += gray[a, b]
            known += 1
    return heard / np.float32(max(known, 1)), np.float32(known / long)
