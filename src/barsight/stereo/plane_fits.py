"""Planes fitted to the pixels' answers on supports that follow a bar and don't cross a depth edge."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import prange, types
from numba.core import cgutils
from numba.extending import intrinsic

from barsight.core.arrays import Float32, Int64, kernel
from barsight.stereo.supports import MARGIN, TILE_COLUMNS, TILE_ROWS, with_margin
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
) -> tuple[Float32, Float32]:
    """A plane through the evidence of each pixel's support: its disparity there, and its information.

    Pixel i says: disparity[i] + pull[i] / weight[i], with weight[i] (0 = nothing). Its share falls with the
    distance (Gaussian) and with the difference of disparity (Tukey's biweight that ends at same_surface_px),
    so that a support doesn't cross a depth edge. Inputs: (H, W), no NaN.
    """
    step = shape.step
    framed = with_margin(disparity)
    fitted, information = np.empty_like(disparity), np.empty_like(disparity)
    if step > 1:
        # Summed over a step along the axis first, the support can go in steps and still hear every pixel.
        alone = np.ones(1, dtype=np.float32), np.zeros(1, dtype=np.int64)
        near = np.ones(step, dtype=np.float32), np.arange(step) - step // 2
        weight_sum, pull_sum = np.empty_like(disparity), np.empty_like(disparity)
        _gather(
            framed, with_margin(weight), with_margin(pull), axes, *near, *alone, same_surface_px, False,
            weight_sum, pull_sum,
        )  # fmt: skip
        weight, pull = weight_sum, pull_sum
    along = _gaussian(shape.along_px, min(int(_REACH * shape.along_px), MARGIN - 8) // step, step)
    across = _gaussian(shape.across_px, int(_REACH * shape.across_px + 0.5), 1)
    _gather(
        framed, with_margin(weight), with_margin(pull), axes, *along, *across, same_surface_px, True,
        fitted, information,
    )  # fmt: skip
    return fitted, information


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
        zero = v.all(0.0, FLOATS)

        def add(place: Any, term: Any) -> None:
            builder.store(v.sum(builder.load(place), term), place)

        def number(place: int, at: Any) -> Any:
            return v.all(builder.load(builder.gep(v.data(place), [at])), FLOATS)

        def length(place: int) -> Any:
            return context.make_array(signature.args[place])(context, builder, arguments[place]).nitems

        centre = v.load(v.data(0), arguments[3], FLOATS)
        nearness = v.all(arguments[9], FLOATS)
        totals = [cgutils.alloca_once_value(builder, zero) for _ in range(9)]
        with cgutils.for_range(builder, length(7)) as outer:
            line = [cgutils.alloca_once(builder, FLOATS) for _ in range(5)]
            for place in line:
                builder.store(zero, place)
            with cgutils.for_range(builder, length(5)) as inner:
                point = builder.add(builder.mul(outer.index, length(5)), inner.index)
                there = builder.add(arguments[3], builder.load(builder.gep(v.data(4), [point])))
                gap = v.difference(v.load(v.data(0), there, FLOATS), centre)
                scaled = v.product(gap, nearness)
                same = v.not_negative(v.difference(v.all(1.0, FLOATS), v.product(scaled, scaled)))
                kept = v.product(number(5, inner.index), same, same)
                weight = v.product(kept, v.load(v.data(1), there, FLOATS))
                pull = v.sum(v.product(weight, gap), v.product(kept, v.load(v.data(2), there, FLOATS)))
                a = number(6, inner.index)
                weight_a = v.product(weight, a)
                terms = (weight, weight_a, v.product(weight_a, a), pull, v.product(pull, a))
                for place, term in zip(line, terms, strict=True):
                    add(place, term)
            share, c = number(7, outer.index), number(8, outer.index)
            n, na, naa, m, ma = (v.product(share, builder.load(place)) for place in line)
            nc = v.product(n, c)
            outer_terms = (n, na, nc, naa, v.product(na, c), v.product(nc, c), m, ma, v.product(m, c))
            for place, term in zip(totals, outer_terms, strict=True):
                add(place, term)
        for one, place in enumerate(totals):
            target = builder.add(arguments[11], builder.mul(arguments[12], index(one)))
            v.store(builder.load(place), v.data(10), target)
        return context.get_dummy_value()

    return signature, generate


@kernel(parallel=True, fastmath=True)
def _gather(
    disparity: Float32,
    weight: Float32,
    pull: Float32,
    axes: Float32,
    along_shares: Float32,
    alongs: Int64,
    across_shares: Float32,
    acrosses: Int64,
    same_surface_px: float,
    as_planes: bool,
    first: Float32,
    second: Float32,
) -> None:
    """With as_planes each pixel's plane and information, else the sums of weights and of pulls from its own
    disparity. Arrays with margins in, without out."""
    height, width = first.shape
    nearness, one = np.float32(1.0 / same_surface_px), np.float32(1)
    framed_width, lines, points = disparity.shape[1], len(acrosses), len(alongs)
    theres, weights, pulls = disparity.reshape(-1), weight.reshape(-1), pull.reshape(-1)
    float_alongs, float_acrosses = alongs.astype(np.float32), acrosses.astype(np.float32)
    for tile_y in prange(axes.shape[0]):
        flat = np.empty(9 * TILE_COLUMNS, dtype=np.float32)
        sums = flat.reshape(9, TILE_COLUMNS)
        s, sa, sc, saa, sac, scc, r, ra, rc = (
            sums[0], sums[1], sums[2], sums[3], sums[4], sums[5], sums[6], sums[7], sums[8],
        )  # fmt: skip
        offsets = np.empty(lines * points, dtype=np.int64)
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
                if not as_planes:
                    first[y, x0 : x0 + count] = s[:count]
                    second[y, x0 : x0 + count] = r[:count]
                    continue
                centre = disparity[y + MARGIN, x0 + MARGIN : x0 + MARGIN + count]
                for i in range(count):
                    # A slope of zero is held with a small weight, so that a line of pixels still has a plane.
                    held = np.float32(0.02) * (saa[i] + scc[i]) + np.float32(1e-3)
                    aa, ac, cc = saa[i] + held, sac[i], scc[i] + held
                    scale = one / (aa * cc - ac * ac)
                    from_a = (sa[i] * cc - sc[i] * ac) * scale
                    from_c = (sc[i] * aa - sa[i] * ac) * scale
                    left_over = max(s[i] - from_a * sa[i] - from_c * sc[i], np.float32(1e-6))
                    first[y, x0 + i] = centre[i] + (r[i] - from_a * ra[i] - from_c * rc[i]) / left_over
                    second[y, x0 + i] = left_over
