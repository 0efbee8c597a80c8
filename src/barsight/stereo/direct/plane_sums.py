"""Sum the evidence on supports into planes' normal equations, many pixels at once, and solve them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from barsight.core.arrays import Float32, Int64, kernel
from barsight.stereo.direct.kernels.vectors import FLOAT_LANES, prefetch, stack_array
from barsight.stereo.direct.support_regions import TILE_COLUMNS, biweight_of_both

_LANES = TILE_COLUMNS
_SUMS = 9 * TILE_COLUMNS


class Evidence(NamedTuple):
    """Each pixel's disparity, weight, pull and gray value, as frames, which are (H, W) with MARGIN or more
    around them, or as flattened frames. gray: in units of alike_gray.
    """

    disparity: Float32
    weight: Float32
    pull: Float32
    gray: Float32


class SupportPairs(NamedTuple):
    """Pairs of points (a, c) and (-a, -c) of a support, besides its central pixel, line by line: a along, c
    across the axis. The last `on_axis` pairs have c = 0.

    along, across: (K,) px, of one point of each pair. factors: (K, 6), the Gaussian weight times 1, a, c,
    a a, a c, c c.
    """

    along: Int64
    across: Int64
    factors: Float32
    on_axis: int


@kernel(inline=True)
def _add_pairs(
    evidence: Evidence, middle: int, offsets: tuple[Int64, Int64], factors: Float32, first: int, end: int,
    fetches: bool, sums: Float32,
) -> None:  # fmt: skip
    """Add pairs first...end, beside the axis, to the sums (9 TILE_COLUMNS,) of `fit_lanes`.

    Points come in pairs on opposite sides of the central pixel, so that common terms are computed once.
    evidence: flat. offsets: (K,), from a pixel to one point of each pair, and to the point beside the pixel
    on the same line along the axis, whose gray value the first one's must resemble. factors: (K, 6), see
    `SupportPairs`. fetches: whether to fetch what the next tile needs of the points' rows, which are more
    than a processor keeps track of.
    """
    disparity, weight, pull, gray = evidence
    here = np.uint64(middle)
    there, beside = offsets
    for j in range(first, end):
        # Unsigned: a loop whose index might be negative, and count from the end, isn't vectorised.
        forth, back = np.uint64(middle + there[j]), np.uint64(middle - there[j])
        forth_line, back_line = np.uint64(middle + beside[j]), np.uint64(middle - beside[j])
        f, fa, fc = factors[j, 0], factors[j, 1], factors[j, 2]
        faa, fac, fcc = factors[j, 3], factors[j, 4], factors[j, 5]
        if fetches:
            for ahead in range(_LANES, 2 * _LANES, FLOAT_LANES):
                for image in (disparity, weight, pull, gray):
                    prefetch(image, forth + np.uint64(ahead))
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


@kernel(inline=True)
def _add_on_axis(
    evidence: Evidence, middle: int, there: Int64, factors: Float32, first: int, sums: Float32
) -> None:
    """Add the pairs from `first` on, on the axis, to the sums (9 TILE_COLUMNS,): their c is 0, so four sums
    don't change. Otherwise as `_add_pairs`.
    """
    disparity, weight, pull, gray = evidence
    here = np.uint64(middle)
    for j in range(first, len(there)):
        forth, back = np.uint64(middle + there[j]), np.uint64(middle - there[j])
        f, fa, faa = factors[j, 0], factors[j, 1], factors[j, 3]
        for i in range(_LANES):
            lane = np.uint64(i)
            centre, tone = disparity[here + lane], gray[here + lane]
            gap, gap_back = disparity[forth + lane] - centre, disparity[back + lane] - centre
            alike = biweight_of_both(gap, gray[forth + lane] - tone)
            alike_back = biweight_of_both(gap_back, gray[back + lane] - tone)
            one, other = alike * weight[forth + lane], alike_back * weight[back + lane]
            one_pull = one * gap + alike * pull[forth + lane]
            other_pull = other * gap_back + alike_back * pull[back + lane]
            both = one + other
            sums[i] += both * f
            sums[_LANES + i] += (one - other) * fa
            sums[3 * _LANES + i] += both * faa
            sums[6 * _LANES + i] += (one_pull + other_pull) * f
            sums[7 * _LANES + i] += (one_pull - other_pull) * fa


@kernel(inline=True)
def _solve_planes(sums: Float32, steps: Float32, information: Float32) -> None:
    """Solve the sums of `fit_lanes` for each plane's height at its pixel and that height's information.

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
def place_pairs(axis: Float32, pairs: SupportPairs, framed_width: int, offsets: Int64) -> None:
    """Rotate the pairs' points, and those beside the pixel, to a tile's axis (x, y). Fills offsets (2, K) in
    flat frames.
    """
    for j in range(offsets.shape[1]):
        a, c = pairs.along[j], pairs.across[j]
        offsets[0, j] = round(a * axis[1] + c * axis[0]) * framed_width + round(a * axis[0] - c * axis[1])
        offsets[1, j] = round(c * axis[0]) * framed_width + round(-c * axis[1])


@kernel(borrows=True)
def fit_lanes(
    flat: Evidence, middle: int, offsets: Int64, pairs: SupportPairs, row: Float32, row_information: Float32
) -> None:
    """Fit the planes of up to TILE_COLUMNS pixels from `middle` on.

    flat: flattened frames. offsets: (2, K), see `place_pairs`. Fills row and row_information (N,), which
    determine the number of pixels. The nine terms of a plane's normal equations are the weights times 1, a,
    c, a a, a c, c c and the pulls times 1, a, c.
    """
    here = np.uint64(middle)
    sums = stack_array(_SUMS, np.float32)
    steps, certain = stack_array(_LANES, np.float32), stack_array(_LANES, np.float32)
    for i in range(_SUMS):
        sums[i] = 0
    for i in range(_LANES):
        sums[i] = flat.weight[here + np.uint64(i)]
    for i in range(_LANES):
        sums[6 * _LANES + i] = flat.pull[here + np.uint64(i)]
    places, on_axis = (offsets[0], offsets[1]), len(pairs.along) - pairs.on_axis
    # One line reaches into each of the support's rows.
    line = min(2 * pairs.on_axis + 1, on_axis)
    _add_pairs(flat, middle, places, pairs.factors, 0, line, True, sums)
    _add_pairs(flat, middle, places, pairs.factors, line, on_axis, False, sums)
    _add_on_axis(flat, middle, offsets[0], pairs.factors, on_axis, sums)
    _solve_planes(sums, steps, certain)
    for i in range(len(row)):
        row[i] = flat.disparity[np.uint64(middle + i)] + steps[i]
    for i in range(len(row)):
        row_information[i] = certain[i]
