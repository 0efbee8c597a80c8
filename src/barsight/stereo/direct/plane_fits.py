"""Fit planes to the pixels' disparity steps on supports that follow a bar and don't cross a depth edge."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from barsight.core.arrays import Float32, Int64, kernel
from barsight.core.parallel import parallel_bands
from barsight.stereo.direct.kernels.vectors import FLOAT_LANES, Vectors
from barsight.stereo.direct.support_regions import BAND_TILES, MARGIN, TILE_COLUMNS, TILE_ROWS

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
    """Fit a plane through the evidence of each pixel's support: its disparity there, and its information.

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

        parallel_bands(sum_up, len(axes), BAND_TILES)
        weight, pull = room
    alongs, acrosses, factors = _pairs(shape)

    def gather(first: int, end: int) -> None:
        _gather(
            disparity, weight, pull, axes, alongs, acrosses, factors, step, fitted, information, first, end
        )

    parallel_bands(gather, len(axes), BAND_TILES)
    if unit != 1:
        fitted *= unit


def _pairs(shape: SupportShape) -> tuple[Int64, Int64, Float32]:
    """List each pair of points (a, c) and (-a, -c) that a support has beside its middle: a along and c across
    the axis, (K,) px each, and its share times 1, a, c, a a, a c, c c (6, K).
    """
    furthest = min(int(_REACH * shape.along_px), MARGIN - 8) // shape.step
    reach = int(_REACH * shape.across_px + 0.5)
    c, a = np.mgrid[-reach : reach + 1, -furthest : furthest + 1].reshape(2, -1)
    a, c = a[: a.size // 2], c[: c.size // 2]
    a *= shape.step
    share = np.exp(-0.5 * ((a / shape.along_px) ** 2 + (c / shape.across_px) ** 2))
    factors = share * np.stack([np.ones_like(a), a, c, a * a, a * c, c * c])
    return a, c, factors.astype(np.float32)


@intrinsic  # type: ignore[untyped-decorator]
def _fit(
    _: Any, theres: Any, weights: Any, pulls: Any, middle: Any, offsets: Any, factors: Any, planes: Any,
    certain: Any, at: Any,
) -> Any:  # fmt: skip
    """Solve the planes' disparities and information for 16 pixels from `middle` on, written from `at` on, out
    of the nine sums of a plane's normal equations: the weights times 1, a, c, a a, a c, c c and the pulls
    times 1, a, c; a along, c across the axis.

    Points come in pairs on both sides of the middle: what a pair has in common is worked out once. offsets:
    (K,), from a pixel to one point of each pair. factors: see `_pairs`. All arrays are flat.
    """
    signature = types.void(theres, weights, pulls, middle, offsets, factors, planes, certain, at)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        v = Vectors(context, builder, signature, arguments)
        middle, pairs = arguments[3], v.length(4)
        centre = v.load(v.data(0), middle, v.floats)
        totals = v.zeros(9)
        for place, image in ((0, 1), (6, 2)):
            builder.store(v.load(v.data(image), middle, v.floats), totals[place])

        def heard(there: Any) -> tuple[Any, Any]:
            """Weight and pull of the points `there`."""
            gap = v.difference(v.load(v.data(0), there, v.floats), centre)
            alike = v.biweight(gap)
            weight = v.product(alike, v.load(v.data(1), there, v.floats))
            return weight, v.sum(v.product(weight, gap), v.product(alike, v.load(v.data(2), there, v.floats)))

        with cgutils.for_range(builder, pairs) as loop:
            offset = builder.load(builder.gep(v.data(4), [loop.index]))
            forth, back = heard(builder.add(middle, offset)), heard(builder.sub(middle, offset))
            weight, pull = (v.sum(one, other) for one, other in zip(forth, back, strict=True))
            lean, pull_lean = (v.difference(one, other) for one, other in zip(forth, back, strict=True))
            factors = [
                v.number(5, builder.add(loop.index, builder.mul(pairs, pairs.type(k))), v.floats)
                for k in range(6)
            ]
            terms = (weight, lean, lean, weight, weight, weight, pull, pull_lean, pull_lean)
            for place, term, factor in zip(totals, terms, factors + factors[:3], strict=True):
                v.add_to(place, v.product(term, factor))
        plane, information = _solved(v, *(builder.load(place) for place in totals))
        v.store(v.sum(centre, plane), v.data(6), arguments[8])
        v.store(information, v.data(7), arguments[8])
        return context.get_dummy_value()

    return signature, generate


def _solved(
    v: Vectors, s: Any, sa: Any, sc: Any, saa: Any, sac: Any, scc: Any, r: Any, ra: Any, rc: Any
) -> tuple[Any, Any]:
    """Solve a plane's height at the pixel and its information, vectors all.

    A slope of zero is held with a small weight, so that a line of pixels still has a plane.
    """
    less, times = v.difference, v.product
    held = v.sum(times(v.all(0.02, v.floats), v.sum(saa, scc)), v.all(1e-3, v.floats))
    aa, cc = v.sum(saa, held), v.sum(scc, held)
    scale = v.quotient(v.all(1.0, v.floats), less(times(aa, cc), times(sac, sac)))
    from_a = times(less(times(sa, cc), times(sc, sac)), scale)
    from_c = times(less(times(sc, aa), times(sa, sac)), scale)
    certain = v.at_least(less(less(s, times(from_a, sa)), times(from_c, sc)), 1e-6)
    return v.quotient(less(less(r, times(from_a, ra)), times(from_c, rc)), certain), certain


@intrinsic  # type: ignore[untyped-decorator]
def _add_near(
    _: Any, theres: Any, weights: Any, pulls: Any, middle: Any, offsets: Any, weight_sums: Any, pull_sums: Any
) -> Any:
    """Add the sums of the weights and of the pulls of a few points for 16 pixels from `middle` on, written to
    the same places. All arrays are flat.
    """
    signature = types.void(theres, weights, pulls, middle, offsets, weight_sums, pull_sums)

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
            v.store(builder.load(total), v.data(place), arguments[3])
        return context.get_dummy_value()

    return signature, generate


@kernel()
def _sum_near(
    disparity: Float32, weight: Float32, pull: Float32, axes: Float32, near: Int64,
    shape: tuple[int, int], weight_sum: Float32, pull_sum: Float32, first_tile: int, end_tile: int,
) -> None:  # fmt: skip
    """Sum weights and pulls from each pixel's own disparity over the points `near` along the axis.
    Frames in and out."""
    height, width = shape
    framed_width = disparity.shape[1]
    theres, weights, pulls = disparity.reshape(-1), weight.reshape(-1), pull.reshape(-1)
    offsets = np.empty(len(near), dtype=np.int64)
    weight_sums, pull_sums = weight_sum.reshape(-1), pull_sum.reshape(-1)
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
                    _add_near(theres, weights, pulls, middle + part, offsets, weight_sums, pull_sums)
                for beyond in range(middle + count, middle + TILE_COLUMNS):
                    weight_sums[beyond] = pull_sums[beyond] = 0


@kernel()
def _gather(
    disparity: Float32, weight: Float32, pull: Float32, axes: Float32, alongs: Int64, acrosses: Int64,
    factors: Float32, step: int, fitted: Float32, information: Float32, first_tile: int, end_tile: int,
) -> None:  # fmt: skip
    """Fit each pixel's plane in tile rows first_tile...end_tile, see `fit_planes`.

    disparity, weight, pull: frames, disparity and pull in units of same_surface_px. axes: (tile rows, tile
    columns, 2). alongs, acrosses: (K,) px and factors (6, K), see `_pairs`. step: the support's, in which
    rows are taken too. Fills fitted (in the same units) and information, (H, W).
    """
    height, width = fitted.shape
    framed_width = disparity.shape[1]
    theres, weights, pulls = disparity.reshape(-1), weight.reshape(-1), pull.reshape(-1)
    flat_factors = factors.reshape(-1)
    found = np.empty((2, TILE_COLUMNS), dtype=np.float32)
    planes, certain = found[0], found[1]
    offsets = np.empty(len(alongs), dtype=np.int64)
    for tile_x in range(axes.shape[1]):
        for tile_y in range(first_tile, end_tile):
            axis_x, axis_y = axes[tile_y, tile_x, 0], axes[tile_y, tile_x, 1]
            for j in range(len(alongs)):
                row = round(alongs[j] * axis_y + acrosses[j] * axis_x)
                offsets[j] = row * framed_width + round(alongs[j] * axis_x - acrosses[j] * axis_y)
            x0 = tile_x * TILE_COLUMNS
            count = min(TILE_COLUMNS, width - x0)
            # Rows a step apart have most of their supports' rows in common: those stay in the nearest cache.
            first_row, end_row = tile_y * TILE_ROWS, min(height, tile_y * TILE_ROWS + TILE_ROWS)
            for turn in range(step):
                for y in range(first_row + turn, end_row, step):
                    middle = (y + MARGIN) * framed_width + x0 + MARGIN
                    for part in range(0, count, FLOAT_LANES):
                        _fit(
                            theres, weights, pulls, middle + part, offsets, flat_factors, planes, certain,
                            part,
                        )  # fmt: skip
                    for i in range(count):
                        fitted[y, x0 + i] = planes[i]
                    for i in range(count):
                        information[y, x0 + i] = certain[i]
