"""Fit planes to the pixels' disparity steps on supports that follow a bar and cross no edge of depth or gray
value.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from barsight.core.arrays import Float32, Int64, kernel
from barsight.core.parallel import parallel_bands
from barsight.stereo.direct.plane_sums import (
    Evidence,
    SupportPairs,
    fit_lanes,
    place_pairs,
)
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
_SAME_PLANE = np.float32(0.5)
"""Maximum difference in disparity, as a share of same_surface_px, between rows that share their planes."""


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
    shapes: Sequence[SupportShape],
    same_surface_px: float,
    room: tuple[Float32, Float32, Float32],
    size: tuple[int, ...],
) -> list[tuple[Float32, Float32]]:
    """Fit a plane through the evidence of each pixel's support, for each of the supports' shapes; return its
    disparity there, and its information, (H, W) each.

    Pixel i contributes disparity[i] + pull[i] / weight[i], with weight[i] (0 = nothing). Its share falls with
    the distance (Gaussian) and with the differences in disparity and, along the axis, in gray value (Tukey's
    biweight, see `biweight_of_both`), so that a support doesn't cross a depth edge, or the outline of
    something so low that its disparities hardly differ. Shading across a bar doesn't narrow its support.
    Supports along a column overlap almost entirely: of a column's rows only one in FITTED_EVERY is fitted,
    and the rows between are interpolated from those above and below, as far as these are the same surface.
    Frames in, no NaN, and three more (`room`) as scratch; the pulls change. size: (H, W).
    """
    unit = np.float32(same_surface_px)
    # In units of same_surface_px, each point needs one multiplication less.
    if unit != 1:
        np.divide(evidence.pull, unit, out=evidence.pull)
        evidence = evidence._replace(disparity=np.divide(evidence.disparity, unit, out=room[2]))
    found = []
    for shape in shapes:
        fit = np.empty(size, dtype=np.float32), np.empty(size, dtype=np.float32)
        _fit_shape(evidence, axes, shape, room[:2], fit)
        if unit != 1:
            np.multiply(fit[0], unit, out=fit[0])
        found.append(fit)
    return found


def _fit_shape(
    evidence: Evidence, axes: Float32, shape: SupportShape, room: tuple[Float32, Float32],
    fit: tuple[Float32, Float32],
) -> None:  # fmt: skip
    """Fit the planes of one shape, see `fit_planes`, in units of same_surface_px."""
    heard, pairs = evidence, _pairs(shape)
    if shape.step > 1:
        # Summing over a step along the axis first lets the support go in steps and still use every pixel.
        near = np.arange(shape.step) - shape.step // 2

        def sum_up(first: int, end: int) -> None:
            _sum_near(evidence, axes, near, fit[0].shape, room, first, end)

        parallel_bands(sum_up, len(axes), BAND_TILES)
        heard = evidence._replace(weight=room[0], pull=room[1])

    for only_between in (False, True):

        def gather(first: int, end: int, between: bool = only_between) -> None:
            _gather(heard, axes, pairs, between, *fit, first, end)

        parallel_bands(gather, len(axes), BAND_TILES)


def _pairs(shape: SupportShape) -> SupportPairs:
    """List one point of each of a support's pairs."""
    furthest = min(int(_REACH * shape.along_px), MARGIN - 8) // shape.step
    reach = int(_REACH * shape.across_px + 0.5)
    c, a = np.mgrid[-reach : reach + 1, -furthest : furthest + 1].reshape(2, -1)
    a, c = a[: a.size // 2], c[: c.size // 2]
    a *= shape.step
    share = np.exp(-0.5 * ((a / shape.along_px) ** 2 + (c / shape.across_px) ** 2))
    factors = share[:, None] * np.stack([np.ones_like(a), a, c, a * a, a * c, c * c], axis=1)
    return SupportPairs(a, c, factors.astype(np.float32), furthest)


@kernel(borrows=True)
def _add_near(evidence: Evidence, middle: int, offsets: Int64, sums: Float32) -> None:
    """Add up the weights and the pulls of a few points for TILE_COLUMNS pixels from `middle` on.

    evidence: flat. offsets: (K,), from a pixel to each point. Fills sums (2 TILE_COLUMNS,), the weights'
    before the pulls'.
    """
    disparity, weight, pull, gray = evidence
    here = np.uint64(middle)
    for i in range(TILE_COLUMNS):
        sums[i] = 0
    for i in range(TILE_COLUMNS):
        sums[TILE_COLUMNS + i] = 0
    for j in range(len(offsets)):
        there = np.uint64(middle + offsets[j])
        for i in range(TILE_COLUMNS):
            lane = np.uint64(i)
            gap = disparity[there + lane] - disparity[here + lane]
            alike = biweight_of_both(gap, gray[there + lane] - gray[here + lane])
            heard = alike * weight[there + lane]
            sums[i] += heard
            sums[TILE_COLUMNS + i] += heard * gap + alike * pull[there + lane]


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
    found = np.empty(2 * TILE_COLUMNS, dtype=np.float32)
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
                for i in range(count, TILE_COLUMNS):
                    found[i] = found[TILE_COLUMNS + i] = 0
                at = np.uint64(middle)
                for i in range(TILE_COLUMNS):
                    weight_sums[at + np.uint64(i)] = found[i]
                for i in range(TILE_COLUMNS):
                    pull_sums[at + np.uint64(i)] = found[TILE_COLUMNS + i]


@kernel()
def _gather(
    evidence: Evidence, axes: Float32, pairs: SupportPairs, only_between: bool, fitted: Float32,
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
    part = np.empty(TILE_COLUMNS, dtype=np.float32)
    offsets = np.empty((axes.shape[1], 2, len(pairs.along)), dtype=np.int64)
    for tile_y in range(first_tile, end_tile):
        for tile_x in range(axes.shape[1]):
            place_pairs(axes[tile_y, tile_x], pairs, framed_width, offsets[tile_x])
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
                fit_lanes(flat, middle, offsets[tile_x], pairs, row, row_information)
