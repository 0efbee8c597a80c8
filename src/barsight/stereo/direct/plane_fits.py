"""Fit planes to the pixels' disparity steps on supports that follow a bar and cross no edge of depth or gray
value.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from barsight.core.arrays import Float32, Int64, kernel
from barsight.core.parallel import parallel_bands
from barsight.stereo.direct.support_regions import (
    BAND_TILES,
    MARGIN,
    TILE_COLUMNS,
    TILE_ROWS,
    biweight_of_both,
    blend_rows,
    fitted_rows,
    is_along_column,
    share_rows,
)

_REACH = 2.0
_LANES = TILE_COLUMNS
_SAME_PLANE = np.float32(0.5)
"""Maximum difference in disparity, as a share of same_surface_px, between rows that share their planes."""


class Evidence(NamedTuple):
    """Each pixel's disparity, weight, pull and gray value, as frames, which are (H, W) with MARGIN or more
    around them, or as flattened frames. gray: in units of alike_gray.
    """

    disparity: Float32
    weight: Float32
    pull: Float32
    gray: Float32


class _Pairs(NamedTuple):
    """Pairs of points (a, c) and (-a, -c) of a support, besides its central pixel.

    along, across: (K,) px. factors: (K, 6), the Gaussian weight times 1, a, c, a a, a c, c c.
    """

    along: Int64
    across: Int64
    factors: Float32


@dataclass(frozen=True)
class SupportShape:
    """A Gaussian support: one sigma along and across the axis; step: odd sampling step along the axis
    (px).
    """

    along_px: float
    across_px: float
    step: int = 1


def fit_planes(
    evidence: Evidence,
    axes: Float32,
    shape: SupportShape,
    same_surface_px: float,
    room: tuple[Float32, Float32],
    fitted: Float32,
    information: Float32,
) -> None:
    """Fit a plane through the evidence of each pixel's support; return its disparity there, and its
    information.

    Pixel i contributes disparity[i] + pull[i] / weight[i], with weight[i] (0 = nothing). Its share falls with
    the distance (Gaussian) and with the differences in disparity and, along the axis, in gray value (Tukey's
    biweight, see `biweight_of_both`), so that a support doesn't cross a depth edge, or the outline of
    something so low that its disparities hardly differ. Shading across a bar doesn't narrow its support.
    Supports along a column overlap almost entirely: of a column's rows only one in FITTED_EVERY is fitted,
    and the rows between are interpolated from those above and below, as far as these are the same surface.
    Frames in, no NaN, and two more (`room`) as scratch; (H, W) out.
    """
    step, unit = shape.step, np.float32(same_surface_px)
    # In units of same_surface_px, each point needs one multiplication less.
    if unit != 1:
        evidence = evidence._replace(disparity=evidence.disparity / unit, pull=evidence.pull / unit)
    heard = evidence
    if step > 1:
        # Summing over a step along the axis first lets the support go in steps and still use every pixel.
        near = np.arange(step) - step // 2

        def sum_up(first: int, end: int) -> None:
            _sum_near(evidence, axes, near, fitted.shape, room, first, end)

        parallel_bands(sum_up, len(axes), BAND_TILES)
        heard = Evidence(evidence.disparity, *room, evidence.gray)
    pairs = _pairs(shape)

    for only_between in (False, True):

        def gather(first: int, end: int, between: bool = only_between) -> None:
            _gather(heard, axes, pairs, between, fitted, information, first, end)

        parallel_bands(gather, len(axes), BAND_TILES)
    if unit != 1:
        fitted *= unit


def _pairs(shape: SupportShape) -> _Pairs:
    """List one point of each of a support's pairs."""
    furthest = min(int(_REACH * shape.along_px), MARGIN - 8) // shape.step
    reach = int(_REACH * shape.across_px + 0.5)
    c, a = np.mgrid[-reach : reach + 1, -furthest : furthest + 1].reshape(2, -1)
    a, c = a[: a.size // 2], c[: c.size // 2]
    a *= shape.step
    share = np.exp(-0.5 * ((a / shape.along_px) ** 2 + (c / shape.across_px) ** 2))
    factors = share[:, None] * np.stack([np.ones_like(a), a, c, a * a, a * c, c * c], axis=1)
    return _Pairs(a, c, factors.astype(np.float32))


@kernel(borrows=True)
def _sum_pairs(
    evidence: Evidence, middle: int, offsets: tuple[Int64, Int64], factors: Float32, sums: Float32
) -> None:
    """Sum the nine terms of a plane's normal equations for TILE_COLUMNS pixels from `middle` on: the weights
    times 1, a, c, a a, a c, c c and the pulls times 1, a, c; a along, c across the axis.

    Points come in pairs on opposite sides of the central pixel, so that common terms are computed once.
    evidence: flat. offsets: (K,), from a pixel to one point of each pair, and to the point beside the pixel
    on the same line along the axis, whose gray value the first one's must resemble. factors: (K, 6), see
    `_Pairs`. Fills sums (9 TILE_COLUMNS,), term by term.
    """
    disparity, weight, pull, gray = evidence
    here = np.uint64(middle)
    for i in range(_LANES, 9 * _LANES):
        sums[i] = 0
    for i in range(_LANES):
        sums[i] = weight[here + np.uint64(i)]
    for i in range(_LANES):
        sums[6 * _LANES + i] = pull[here + np.uint64(i)]
    there, beside = offsets
    for j in range(len(there)):
        # Unsigned: a loop whose index might be negative, and count from the end, isn't vectorised.
        forth, back = np.uint64(middle + there[j]), np.uint64(middle - there[j])
        forth_line, back_line = np.uint64(middle + beside[j]), np.uint64(middle - beside[j])
        f, fa, fc = factors[j, 0], factors[j, 1], factors[j, 2]
        faa, fac, fcc = factors[j, 3], factors[j, 4], factors[j, 5]
        for i in range(_LANES):
            lane = np.uint64(i)
            centre = disparity[here + lane]
            gap, gap_back = disparity[forth + lane] - centre, disparity[back + lane] - centre
            tone = gray[forth + lane] - gray[forth_line + lane]
            tone_back = gray[back + lane] - gray[back_line + lane]
            alike, alike_back = biweight_of_both(gap, tone), biweight_of_both(gap_back, tone_back)
            one, other = alike * weight[forth + lane], alike_back * weight[back + lane]
            one_pull = one * gap + alike * pull[forth + lane]
            other_pull = other * gap_back + alike_back * pull[back + lane]
            both, lean = one + other, one - other
            both_pull, lean_pull = one_pull + other_pull, one_pull - other_pull
            sums[i] += both * f
            sums[_LANES + i] += lean * fa
            sums[2 * _LANES + i] += lean * fc
            sums[3 * _LANES + i] += both * faa
            sums[4 * _LANES + i] += both * fac
            sums[5 * _LANES + i] += both * fcc
            sums[6 * _LANES + i] += both_pull * f
            sums[7 * _LANES + i] += lean_pull * fa
            sums[8 * _LANES + i] += lean_pull * fc


@kernel(borrows=True)
def _solve_planes(sums: Float32, steps: Float32, information: Float32) -> None:
    """Solve the sums of `_sum_pairs` for each plane's height at its pixel and that height's information.

    The slopes are regularised to zero with a small weight, so that a line of pixels still has a plane. Fills
    steps (TILE_COLUMNS,), relative to the pixels' own disparities, and information (TILE_COLUMNS,).
    """
    for i in range(_LANES):
        s, sa, sc = sums[i], sums[_LANES + i], sums[2 * _LANES + i]
        saa, sac, scc = sums[3 * _LANES + i], sums[4 * _LANES + i], sums[5 * _LANES + i]
        r, ra, rc = sums[6 * _LANES + i], sums[7 * _LANES + i], sums[8 * _LANES + i]
        held = np.float32(0.02) * (saa + scc) + np.float32(1e-3)
        aa, cc = saa + held, scc + held
        scale = np.float32(1) / (aa * cc - sac * sac)
        from_a, from_c = (sa * cc - sc * sac) * scale, (sc * aa - sa * sac) * scale
        certain = s - from_a * sa - from_c * sc
        certain = certain if certain > np.float32(1e-6) else np.float32(1e-6)
        steps[i] = (r - from_a * ra - from_c * rc) / certain
        information[i] = certain


@kernel(borrows=True)
def _add_near(evidence: Evidence, middle: int, offsets: Int64, sums: Float32) -> None:
    """Add up the weights and the pulls of a few points for TILE_COLUMNS pixels from `middle` on.

    evidence: flat. offsets: (K,), from a pixel to each point. Fills sums (2 TILE_COLUMNS,), the weights'
    before the pulls'.
    """
    disparity, weight, pull, gray = evidence
    here = np.uint64(middle)
    for i in range(_LANES):
        sums[i] = 0
    for i in range(_LANES):
        sums[_LANES + i] = 0
    for j in range(len(offsets)):
        there = np.uint64(middle + offsets[j])
        for i in range(_LANES):
            lane = np.uint64(i)
            gap = disparity[there + lane] - disparity[here + lane]
            alike = biweight_of_both(gap, gray[there + lane] - gray[here + lane])
            heard = alike * weight[there + lane]
            sums[i] += heard
            sums[_LANES + i] += heard * gap + alike * pull[there + lane]


@kernel()
def _flat(evidence: Evidence) -> Evidence:
    """Flatten the four frames."""
    return Evidence(
        evidence.disparity.reshape(-1), evidence.weight.reshape(-1), evidence.pull.reshape(-1),
        evidence.gray.reshape(-1),
    )  # fmt: skip


@kernel()
def _sum_near(
    evidence: Evidence, axes: Float32, near: Int64, shape: tuple[int, int], sums: tuple[Float32, Float32],
    first_tile: int, end_tile: int,
) -> None:  # fmt: skip
    """Sum weights, and pulls relative to each pixel's own disparity, over the points `near` along the axis,
    in tile rows first_tile...end_tile.

    near: (K,) px. shape: of the image, (H, W). Fills the frames of sums, the weights' and the pulls'.
    """
    height, width = shape
    framed_width = evidence.disparity.shape[1]
    flat = _flat(evidence)
    offsets = np.empty((axes.shape[1], len(near)), dtype=np.int64)
    weight_sums, pull_sums = sums[0].reshape(-1), sums[1].reshape(-1)
    found = np.empty(2 * _LANES, dtype=np.float32)
    for tile_y in range(first_tile, end_tile):
        for tile_x in range(axes.shape[1]):
            axis_x, axis_y = axes[tile_y, tile_x, 0], axes[tile_y, tile_x, 1]
            for j in range(len(near)):
                offsets[tile_x, j] = round(near[j] * axis_y) * framed_width + round(near[j] * axis_x)
        for y in range(tile_y * TILE_ROWS, min(height, tile_y * TILE_ROWS + TILE_ROWS)):
            for tile_x in range(axes.shape[1]):
                x0 = tile_x * TILE_COLUMNS
                count = min(TILE_COLUMNS, width - x0)
                middle = (y + MARGIN) * framed_width + x0 + MARGIN
                _add_near(flat, middle, offsets[tile_x], found)
                for i in range(count, _LANES):
                    found[i] = found[_LANES + i] = 0
                at = np.uint64(middle)
                for i in range(_LANES):
                    weight_sums[at + np.uint64(i)] = found[i]
                for i in range(_LANES):
                    pull_sums[at + np.uint64(i)] = found[_LANES + i]


@kernel(borrows=True)
def _place_pairs(axis: Float32, pairs: _Pairs, framed_width: int, offsets: Int64) -> None:
    """Rotate the pairs' points, and those beside the pixel, to a tile's axis (x, y). Fills offsets (2, K) in
    flat frames.
    """
    for j in range(offsets.shape[1]):
        a, c = pairs.along[j], pairs.across[j]
        offsets[0, j] = round(a * axis[1] + c * axis[0]) * framed_width + round(a * axis[0] - c * axis[1])
        offsets[1, j] = round(c * axis[0]) * framed_width + round(-c * axis[1])


@kernel(borrows=True)
def _fit_lanes(
    flat: Evidence, middle: int, offsets: Int64, factors: Float32, sums: Float32, row: Float32,
    row_information: Float32,
) -> None:  # fmt: skip
    """Fit the planes of up to TILE_COLUMNS pixels from `middle` on.

    sums: (11 TILE_COLUMNS,), scratch. Fills row and row_information, which determine the number of pixels.
    """
    steps, certain = sums[9 * _LANES : 10 * _LANES], sums[10 * _LANES :]
    _sum_pairs(flat, middle, (offsets[0], offsets[1]), factors, sums)
    _solve_planes(sums, steps, certain)
    for i in range(len(row)):
        row[i] = flat.disparity[np.uint64(middle + i)] + steps[i]
    for i in range(len(row)):
        row_information[i] = certain[i]


@kernel()
def _gather(
    evidence: Evidence, axes: Float32, pairs: _Pairs, only_between: bool, fitted: Float32,
    information: Float32, first_tile: int, end_tile: int,
) -> None:  # fmt: skip
    """Fit each pixel's plane in tile rows first_tile...end_tile, see `fit_planes`: where the axis is along a
    column, either one row of FITTED_EVERY or, with only_between, the rows in between.

    evidence: frames, disparity and pull in units of same_surface_px. axes: (tile rows, tile columns, 2).
    Fills fitted (in the same units) and information, both (H, W).
    """
    height, width = fitted.shape
    framed_width = evidence.disparity.shape[1]
    flat = _flat(evidence)
    sums, part = np.empty(11 * _LANES, dtype=np.float32), np.empty(_LANES, dtype=np.float32)
    offsets = np.empty((axes.shape[1], 2, len(pairs.along)), dtype=np.int64)
    for tile_y in range(first_tile, end_tile):
        for tile_x in range(axes.shape[1]):
            _place_pairs(axes[tile_y, tile_x], pairs, framed_width, offsets[tile_x])
        for y in range(tile_y * TILE_ROWS, min(height, tile_y * TILE_ROWS + TILE_ROWS)):
            above, below = fitted_rows(y, height)
            for tile_x in range(axes.shape[1]):
                is_between = above != y and below != y and is_along_column(axes[tile_y, tile_x])
                if only_between != is_between:
                    continue
                x0 = tile_x * TILE_COLUMNS
                lanes = slice(x0, min(width, x0 + TILE_COLUMNS))
                row, row_information = fitted[y, lanes], information[y, lanes]
                if is_between and share_rows(evidence.disparity, y, x0, height, _SAME_PLANE, part):
                    blend_rows(fitted[above, lanes], fitted[below, lanes], part, row)
                    certain = information[above, lanes], information[below, lanes]
                    blend_rows(certain[0], certain[1], part, row_information)
                    continue
                middle = (y + MARGIN) * framed_width + x0 + MARGIN
                _fit_lanes(flat, middle, offsets[tile_x], pairs.factors, sums, row, row_information)
