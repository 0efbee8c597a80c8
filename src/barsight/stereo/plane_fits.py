"""Planes fitted to the pixels' answers on supports that follow a bar and don't cross a depth edge."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from barsight.core.arrays import Float32, Int64, kernel
from barsight.core.parallel import in_bands
from barsight.stereo.supports import BAND_TILES, MARGIN, TILE_COLUMNS, TILE_ROWS
from barsight.stereo.vectors import FLOAT_LANES, FLOATS, Vectors

_REACH = 2.0


@dataclass(frozen=True)
class SupportShape:
    """A Gaussian support: one sigma along and across the axis; it goes along the axis in odd steps (px)."""

    along_px: float
    across_px: float
    step: int = 1


def fit_planes(
    disparity: Float32,
    weight: Float32,
    pull: Float32,
    axes: Float32,
    shape: SupportShape,
    same_surface_px: float,
    room: tuple[Float32, Float32],
    fitted: Float32,
    information: Float32,
) -> None:
    """A plane through the evidence of each pixel's support: its disparity there, and its information.

    Pixel i says: disparity[i] + pull[i] / weight[i], with weight[i] (0 = nothing). Its share falls with the
    distance (Gaussian) and with the difference of disparity (Tukey's biweight that ends at same_surface_px),
    so that a support doesn't cross a depth edge. Frames in, no NaN, and two more (`room`) for use inside;
    (H, W) out.
    """
    step, nearness = shape.step, np.float32(1 / same_surface_px)
    if step > 1:
        # Summed over a step along the axis first, the support can go in steps and still hear every pixel.
        near = np.arange(step) - step // 2

        def sum_up(first: int, end: int) -> None:
            _sum_near(disparity, weight, pull, axes, near, nearness, fitted.shape, *room, first, end)

        in_bands(sum_up, len(axes), BAND_TILES)
        weight, pull = room
    along = _gaussian(shape.along_px, min(int(_REACH * shape.along_px), MARGIN - 8) // step, step)
    across = _gaussian(shape.across_px, int(_REACH * shape.across_px + 0.5), 1)

    def gather(first: int, end: int) -> None:
        _gather(disparity, weight, pull, axes, *along, *across, nearness, fitted, information, first, end)

    in_bands(gather, len(axes), BAND_TILES)


def _gaussian(sigma_px: float, reach: int, step: int) -> tuple[Float32, Int64]:
    """Weights and places (px) of 2 * reach + 1 points a step apart."""
    places = step * np.arange(-reach, reach + 1)
    return np.exp(-0.5 * (places / sigma_px) ** 2).astype(np.float32), places


@intrinsic  # type: ignore[untyped-decorator]
def _add_up(
    _: Any, theres: Any, weights: Any, pulls: Any, middle: Any, offsets: Any, shares: Any, alongs: Any,
    across_shares: Any, acrosses: Any, nearness: Any, sums: Any, at: Any, stride: Any,
) -> Any:  # fmt: skip
    """The nine sums of a plane's normal equations for 16 pixels from `middle` on: the weights times 1, a, c,
    a a, a c, c c and the pulls times 1, a, c; a along, c across the axis. They lie `stride` apart.

    offsets: (across, along), flat, from a pixel to its support's points. All arrays are flat.
    """
    signature = types.void(
        theres, weights, pulls, middle, offsets, shares, alongs, across_shares, acrosses, nearness, sums, at,
        stride,
    )  # fmt: skip

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        v = Vectors(context, builder, signature, arguments)
        index = arguments[3].type
        centre, nearness = v.load(v.data(0), arguments[3], FLOATS), v.all(arguments[9], FLOATS)
        totals = v.zeros(9)
        with cgutils.for_range(builder, v.length(7)) as outer:
            line = [cgutils.alloca_once(builder, FLOATS) for _ in range(5)]
            for place in line:
                builder.store(v.all(0.0, FLOATS), place)
            with cgutils.for_range(builder, v.length(5)) as inner:
                point = builder.add(builder.mul(outer.index, v.length(5)), inner.index)
                there = builder.add(arguments[3], builder.load(builder.gep(v.data(4), [point])))
                gap = v.difference(v.load(v.data(0), there, FLOATS), centre)
                kept = v.product(v.number(5, inner.index, FLOATS), v.alike(gap, nearness))
                weight = v.product(kept, v.load(v.data(1), there, FLOATS))
                pull = v.sum(v.product(weight, gap), v.product(kept, v.load(v.data(2), there, FLOATS)))
                a = v.number(6, inner.index, FLOATS)
                weight_a = v.product(weight, a)
                terms = (weight, weight_a, v.product(weight_a, a), pull, v.product(pull, a))
                for place, term in zip(line, terms, strict=True):
                    v.add_to(place, term)
            share, c = v.number(7, outer.index, FLOATS), v.number(8, outer.index, FLOATS)
            n, na, naa, m, ma = (v.product(share, builder.load(place)) for place in line)
            nc = v.product(n, c)
            outer_terms = (n, na, nc, naa, v.product(na, c), v.product(nc, c), m, ma, v.product(m, c))
            for place, term in zip(totals, outer_terms, strict=True):
                v.add_to(place, term)
        for one, place in enumerate(totals):
            target = builder.add(arguments[11], builder.mul(arguments[12], index(one)))
            v.store(builder.load(place), v.data(10), target)
        return context.get_dummy_value()

    return signature, generate


@intrinsic  # type: ignore[untyped-decorator]
def _add_near(
    _: Any, theres: Any, weights: Any, pulls: Any, middle: Any, offsets: Any, nearness: Any, weight_sums: Any,
    pull_sums: Any, at: Any,
) -> Any:  # fmt: skip
    """The sums of the weights and of the pulls of a few points for 16 pixels from `middle` on, written from
    `at` on. All arrays are flat."""
    signature = types.void(theres, weights, pulls, middle, offsets, nearness, weight_sums, pull_sums, at)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        v = Vectors(context, builder, signature, arguments)
        centre, nearness = v.load(v.data(0), arguments[3], FLOATS), v.all(arguments[5], FLOATS)
        totals = v.zeros(2)
        with cgutils.for_range(builder, v.length(4)) as loop:
            there = builder.add(arguments[3], builder.load(builder.gep(v.data(4), [loop.index])))
            gap = v.difference(v.load(v.data(0), there, FLOATS), centre)
            kept = v.alike(gap, nearness)
            weight = v.product(kept, v.load(v.data(1), there, FLOATS))
            v.add_to(totals[0], weight)
            v.add_to(
                totals[1], v.sum(v.product(weight, gap), v.product(kept, v.load(v.data(2), there, FLOATS)))
            )
        for place, total in zip((6, 7), totals, strict=True):
            v.store(builder.load(total), v.data(place), arguments[8])
        return context.get_dummy_value()

    return signature, generate


@kernel()
def _sum_near(
    disparity: Float32, weight: Float32, pull: Float32, axes: Float32, near: Int64, nearness: np.float32,
    shape: tuple[int, int], weight_sum: Float32, pull_sum: Float32, first_tile: int, end_tile: int,
) -> None:  # fmt: skip
    """Sums of weights and of pulls from each pixel's own disparity over the points `near` along the axis.
    Frames in and out."""
    height, width = shape
    framed_width = disparity.shape[1]
    theres, weights, pulls = disparity.reshape(-1), weight.reshape(-1), pull.reshape(-1)
    offsets = np.empty(len(near), dtype=np.int64)
    flat = np.empty((2, TILE_COLUMNS), dtype=np.float32)
    weight_part, pull_part = flat[0], flat[1]
    for tile_y in range(first_tile, end_tile):
        for tile_x in range(axes.shape[1]):
            axis_x, axis_y = axes[tile_y, tile_x, 0], axes[tile_y, tile_x, 1]
            for j in range(len(near)):
                offsets[j] = round(near[j] * axis_y) * framed_width + round(near[j] * axis_x)
            x0 = tile_x * TILE_COLUMNS
            count = min(TILE_COLUMNS, width - x0)
            for y in range(tile_y * TILE_ROWS, min(height, tile_y * TILE_ROWS + TILE_ROWS)):
                middle = (y + MARGIN) * framed_width + x0 + MARGIN
                for part in range(0, count, FLOAT_LANES):
                    _add_near(
                        theres, weights, pulls, middle + part, offsets, nearness, weight_part, pull_part, part
                    )
                for i in range(count):
                    weight_sum[y + MARGIN, x0 + MARGIN + i] = weight_part[i]
                    pull_sum[y + MARGIN, x0 + MARGIN + i] = pull_part[i]


@kernel(fastmath=True)
def _gather(
    disparity: Float32,
    weight: Float32,
    pull: Float32,
    axes: Float32,
    along_shares: Float32,
    alongs: Int64,
    across_shares: Float32,
    acrosses: Int64,
    nearness: np.float32,
    fitted: Float32,
    information: Float32,
    first_tile: int,
    end_tile: int,
) -> None:
    height, width = fitted.shape
    one = np.float32(1)
    framed_width, lines, points = disparity.shape[1], len(acrosses), len(alongs)
    theres, weights, pulls = disparity.reshape(-1), weight.reshape(-1), pull.reshape(-1)
    float_alongs, float_acrosses = alongs.astype(np.float32), acrosses.astype(np.float32)
    flat = np.empty(9 * TILE_COLUMNS, dtype=np.float32)
    sums = flat.reshape(9, TILE_COLUMNS)
    offsets = np.empty(lines * points, dtype=np.int64)
    for tile_y in range(first_tile, end_tile):
        for tile_x in range(axes.shape[1]):
            axis_x, axis_y = axes[tile_y, tile_x, 0], axes[tile_y, tile_x, 1]
            for k in range(lines):
                for j in range(points):
                    row = round(alongs[j] * axis_y + acrosses[k] * axis_x)
                    column = round(alongs[j] * axis_x - acrosses[k] * axis_y)
                    offsets[k * points + j] = row * framed_width + column
            x0 = tile_x * TILE_COLUMNS
            count = min(TILE_COLUMNS, width - x0)
            for y in range(tile_y * TILE_ROWS, min(height, tile_y * TILE_ROWS + TILE_ROWS)):
                middle = (y + MARGIN) * framed_width + x0 + MARGIN
                for part in range(0, count, FLOAT_LANES):
                    _add_up(
                        theres, weights, pulls, middle + part, offsets, along_shares, float_alongs,
                        across_shares, float_acrosses, nearness, flat, part, TILE_COLUMNS,
                    )  # fmt: skip
                centre = disparity[y + MARGIN, x0 + MARGIN : x0 + MARGIN + count]
                planes, certain = fitted[y, x0 : x0 + count], information[y, x0 : x0 + count]
                for i in range(count):
                    # A slope of zero is held with a small weight, so that a line of pixels still has a plane.
                    s, sa, sc, r, ra, rc = (
                        sums[0, i],
                        sums[1, i],
                        sums[2, i],
                        sums[6, i],
                        sums[7, i],
                        sums[8, i],
                    )
                    held = np.float32(0.02) * (sums[3, i] + sums[5, i]) + np.float32(1e-3)
                    aa, ac, cc = sums[3, i] + held, sums[4, i], sums[5, i] + held
                    scale = one / (aa * cc - ac * ac)
                    from_a = (sa * cc - sc * ac) * scale
                    from_c = (sc * aa - sa * ac) * scale
                    certain[i] = max(s - from_a * sa - from_c * sc, np.float32(1e-6))
                    planes[i] = centre[i] + (r - from_a * ra - from_c * rc) / certain[i]
