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
from barsight.stereo.vectors import FLOAT_LANES, Vectors

_REACH = 2.0
_PLANE_LANES = 8
"""As many as leave the sums in registers."""


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
    step, unit = shape.step, np.float32(same_surface_px)
    # In units of same_surface_px, each point takes one product less.
    if unit != 1:
        disparity, pull = disparity / unit, pull / unit
    if step > 1:
        # Summed over a step along the axis first, the support can go in steps and still hear every pixel.
        near = np.arange(step) - step // 2

        def sum_up(first: int, end: int) -> None:
            _sum_near(disparity, weight, pull, axes, near, fitted.shape, *room, first, end)

        in_bands(sum_up, len(axes), BAND_TILES)
        weight, pull = room
    alongs = step * np.arange(min(int(_REACH * shape.along_px), MARGIN - 8) // step + 1)
    shares = np.exp(-0.5 * (alongs / shape.along_px) ** 2)
    factors = np.stack([shares, shares * alongs, shares * alongs**2]).astype(np.float32)
    reach = int(_REACH * shape.across_px + 0.5)
    acrosses = np.arange(-reach, reach + 1)
    across_shares = np.exp(-0.5 * (acrosses / shape.across_px) ** 2).astype(np.float32)

    def gather(first: int, end: int) -> None:
        _gather(
            disparity, weight, pull, axes, alongs, factors, acrosses, across_shares, fitted,
            information, first, end,
        )  # fmt: skip

    in_bands(gather, len(axes), BAND_TILES)
    if unit != 1:
        fitted *= unit


@intrinsic  # type: ignore[untyped-decorator]
def _add_up(
    _: Any, theres: Any, weights: Any, pulls: Any, middle: Any, offsets: Any, factors: Any, stride: Any,
    across_shares: Any, acrosses: Any, sums: Any, at: Any,
) -> Any:  # fmt: skip
    """The nine sums of a plane's normal equations for 8 pixels from `middle` on: the weights times 1, a, c,
    a a, a c, c c and the pulls times 1, a, c; a along, c across the axis. They lie TILE_COLUMNS apart.

    A line along the axis is its middle and pairs of points a and -a from it: what a pair has in common is
    worked out once. offsets: (across, 2, stride), from a pixel to its support's points at 0, a and at 0, -a.
    factors: (3, stride), a point's share times 1, a, a a. All arrays are flat.
    """
    signature = types.void(
        theres, weights, pulls, middle, offsets, factors, stride, across_shares, acrosses, sums, at
    )

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        v = Vectors(context, builder, signature, arguments, _PLANE_LANES)
        index, stride = arguments[3].type, arguments[6]
        centre = v.load(v.data(0), arguments[3], v.floats)
        totals = v.zeros(9)

        def heard(place: Any) -> tuple[Any, Any]:
            """Weight and pull of the points whose offset lies at `place`."""
            there = builder.add(arguments[3], builder.load(builder.gep(v.data(4), [place])))
            gap = v.difference(v.load(v.data(0), there, v.floats), centre)
            alike = v.biweight(gap)
            weight = v.product(alike, v.load(v.data(1), there, v.floats))
            return weight, v.sum(v.product(weight, gap), v.product(alike, v.load(v.data(2), there, v.floats)))

        with cgutils.for_range(builder, v.length(7)) as outer:
            line = v.zeros(5)
            start = builder.mul(outer.index, builder.mul(stride, index(2)))
            share = v.number(5, index(0), v.floats)
            for place, term in zip((line[0], line[3]), heard(start), strict=True):
                builder.store(v.product(share, term), place)
            with cgutils.for_range(builder, builder.sub(stride, index(1))) as inner:
                point = builder.add(inner.index, index(1))
                forth = heard(builder.add(start, point))
                back = heard(builder.add(start, builder.add(point, stride)))
                share, share_a, share_aa = (
                    v.number(5, builder.add(point, builder.mul(stride, index(k))), v.floats) for k in range(3)
                )
                weight, pull = (v.sum(one, other) for one, other in zip(forth, back, strict=True))
                lean, pull_lean = (v.difference(one, other) for one, other in zip(forth, back, strict=True))
                terms = weight, lean, weight, pull, pull_lean
                factors = share, share_a, share_aa, share, share_a
                for place, term, factor in zip(line, terms, factors, strict=True):
                    v.add_to(place, v.product(term, factor))
            share, c = v.number(7, outer.index, v.floats), v.number(8, outer.index, v.floats)
            n, na, naa, m, ma = (v.product(share, builder.load(place)) for place in line)
            nc = v.product(n, c)
            outer_terms = (n, na, nc, naa, v.product(na, c), v.product(nc, c), m, ma, v.product(m, c))
            for place, term in zip(totals, outer_terms, strict=True):
                v.add_to(place, term)
        for one, place in enumerate(totals):
            v.store(builder.load(place), v.data(9), builder.add(arguments[10], index(one * TILE_COLUMNS)))
        return context.get_dummy_value()

    return signature, generate


@intrinsic  # type: ignore[untyped-decorator]
def _add_near(
    _: Any, theres: Any, weights: Any, pulls: Any, middle: Any, offsets: Any, weight_sums: Any,
    pull_sums: Any, at: Any,
) -> Any:  # fmt: skip
    """The sums of the weights and of the pulls of a few points for 16 pixels from `middle` on, written from
    `at` on. All arrays are flat."""
    signature = types.void(theres, weights, pulls, middle, offsets, weight_sums, pull_sums, at)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        v = Vectors(context, builder, signature, arguments)
        centre = v.load(v.data(0), arguments[3], v.floats)
        totals = v.zeros(2)
        with cgutils.for_range(builder, v.length(4)) as loop:
            there = builder.add(arguments[3], builder.load(builder.gep(v.data(4), [loop.index])))
            gap = v.difference(v.load(v.data(0), there, v.floats), centre)
            kept = v.biweight(gap)
            weight = v.product(kept, v.load(v.data(1), there, v.floats))
            v.add_to(totals[0], weight)
            v.add_to(
                totals[1], v.sum(v.product(weight, gap), v.product(kept, v.load(v.data(2), there, v.floats)))
            )
        for place, total in zip((5, 6), totals, strict=True):
            v.store(builder.load(total), v.data(place), arguments[7])
        return context.get_dummy_value()

    return signature, generate


@kernel()
def _sum_near(
    disparity: Float32, weight: Float32, pull: Float32, axes: Float32, near: Int64,
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
    for tile_x in range(axes.shape[1]):
        for tile_y in range(first_tile, end_tile):
            axis_x, axis_y = axes[tile_y, tile_x, 0], axes[tile_y, tile_x, 1]
            for j in range(len(near)):
                offsets[j] = round(near[j] * axis_y) * framed_width + round(near[j] * axis_x)
            x0 = tile_x * TILE_COLUMNS
            count = min(TILE_COLUMNS, width - x0)
            for y in range(tile_y * TILE_ROWS, min(height, tile_y * TILE_ROWS + TILE_ROWS)):
                middle = (y + MARGIN) * framed_width + x0 + MARGIN
                for part in range(0, count, FLOAT_LANES):
                    _add_near(theres, weights, pulls, middle + part, offsets, weight_part, pull_part, part)
                for i in range(count):
                    weight_sum[y + MARGIN, x0 + MARGIN + i] = weight_part[i]
                    pull_sum[y + MARGIN, x0 + MARGIN + i] = pull_part[i]


@kernel(fastmath=True)
def _gather(
    disparity: Float32, weight: Float32, pull: Float32, axes: Float32, alongs: Int64, factors: Float32,
    acrosses: Int64, across_shares: Float32, fitted: Float32, information: Float32,
    first_tile: int, end_tile: int,
) -> None:  # fmt: skip
    height, width = fitted.shape
    framed_width, lines, points = disparity.shape[1], len(acrosses), len(alongs)
    step = alongs[1] - alongs[0] if points > 1 else 1
    theres, weights, pulls = disparity.reshape(-1), weight.reshape(-1), pull.reshape(-1)
    flat_factors, float_acrosses = factors.reshape(-1), acrosses.astype(np.float32)
    flat = np.empty(9 * TILE_COLUMNS, dtype=np.float32)
    sums = flat.reshape(9, TILE_COLUMNS)
    offsets = np.empty(lines * 2 * points, dtype=np.int64)
    for tile_x in range(axes.shape[1]):
        for tile_y in range(first_tile, end_tile):
            axis_x, axis_y = axes[tile_y, tile_x, 0], axes[tile_y, tile_x, 1]
            for k in range(lines):
                for j in range(2 * points):
                    along = alongs[j] if j < points else -alongs[j - points]
                    row = round(along * axis_y + acrosses[k] * axis_x)
                    column = round(along * axis_x - acrosses[k] * axis_y)
                    offsets[k * 2 * points + j] = row * framed_width + column
            x0 = tile_x * TILE_COLUMNS
            count = min(TILE_COLUMNS, width - x0)
            # Rows a step apart have most of their supports' rows in common: those stay in the nearest cache.
            first_row, end_row = tile_y * TILE_ROWS, min(height, tile_y * TILE_ROWS + TILE_ROWS)
            for turn in range(step):
                for y in range(first_row + turn, end_row, step):
                    middle = (y + MARGIN) * framed_width + x0 + MARGIN
                    for part in range(0, count, _PLANE_LANES):
                        _add_up(
                            theres, weights, pulls, middle + part, offsets, flat_factors, points,
                            across_shares, float_acrosses, flat, part,
                        )  # fmt: skip
                    centre = disparity[y + MARGIN, x0 + MARGIN : x0 + MARGIN + count]
                    _solve(sums, centre, fitted[y, x0 : x0 + count], information[y, x0 : x0 + count])


@kernel(fastmath=True)
def _solve(sums: Float32, centre: Float32, planes: Float32, certain: Float32) -> None:
    """The planes' disparities and information out of the nine sums."""
    one = np.float32(1)
    for i in range(len(centre)):
        # A slope of zero is held with a small weight, so that a line of pixels still has a plane.
        s, sa, sc, r, ra, rc = sums[0, i], sums[1, i], sums[2, i], sums[6, i], sums[7, i], sums[8, i]
        held = np.float32(0.02) * (sums[3, i] + sums[5, i]) + np.float32(1e-3)
        aa, ac, cc = sums[3, i] + held, sums[4, i], sums[5, i] + held
        scale = one / (aa * cc - ac * ac)
        from_a = (sa * cc - sc * ac) * scale
        from_c = (sc * aa - sa * ac) * scale
        certain[i] = max(s - from_a * sa - from_c * sc, np.float32(1e-6))
        planes[i] = centre[i] + (r - from_a * ra - from_c * rc) / certain[i]
