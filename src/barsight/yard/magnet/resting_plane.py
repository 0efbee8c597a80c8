"""Rest a rigid plane on the map under the poles.

A map's noise would hold the plane up, so heights are medians along the bars, straightened by a prior.
"""

from __future__ import annotations

import numpy as np

from barsight.core.arrays import Float32, Float64, Int64, UInt8, kernel
from barsight.core.linalg.robust import SIGMA_PER_MAD
from barsight.core.records.heights import HeightSource
from barsight.yard.magnet.footprint import Placement
from barsight.yard.types import HeightMap

SEGMENT_M = 0.45
"""Length (m) along the bars over which median heights are taken: bars are straight, noise isn't."""
STEP_M = 0.01
CORRELATED_CELLS = 5.0
"""Number of neighbouring cells that count as one, because they share their matching windows."""
STRAIGHT_M = 0.002
"""Standard deviation (m) of bundles from straight and even along their bars. Larger deviations in the map are
mostly the map's own error, as long as its sigma explains them.
"""
BENT_SIGMA, STRAIGHT_UP_TO = 3.0, 0.8
"""Deviation from straight, in sigmas, that is taken as measured; fraction of it from which on the measured
value gains weight.
"""
NEAR_LINE_M = 0.02
"""Distance (m) of a height from its line along the bars beyond which it has less weight in the load's slope;
at twice this it has none.
"""
ASKEW, BENT_PER_M, SAG_PER_M = 0.005, 0.002, 0.002
"""Standard deviations of the angle between a load's axis and the beam (rad), and of its bends sideways and
downwards (m from its middle, per metre along squared). With the first two its section lies elsewhere under
each pole; the last one is how bars sag between their supports, or hang down beyond them.
"""
COLUMNS = 8
U, V, Z, SCATTER, SEEN, ALL, SIGMA, POLE = range(COLUMNS)
_STEEPEST = 0.35
_UNKNOWN, _FILLED = HeightSource.UNKNOWN, HeightSource.FILLED


def profiles(heights: HeightMap, place: Placement, poles: Float64) -> tuple[list[tuple[int, int]], Float64]:
    """Sample columns across and parts along each pole. Returns (N, COLUMNS) of all: place across and along,
    median height, scatter, cells seen and in all, the cells' mean sigma, the pole.
    """
    shape = [
        (max(round(width / STEP_M), 2), max(round(length / SEGMENT_M), 1)) for _, _, length, width in poles
    ]
    points = np.empty((sum(a * b for a, b in shape), COLUMNS))
    _sample(
        heights.z_m, heights.sigma_m, heights.source,
        np.array([heights.x0_m, heights.y0_m, heights.cell_m]),
        place.frame, poles, np.array(shape), points,
    )  # fmt: skip
    return shape, points


@kernel()
def straighten_heights(points: Float64) -> float:
    """Correct the heights (N, COLUMNS), in place, towards a straight load; return the noise that remains.

    A load's section is the same under all poles except for a slope along it, and for how its axis turns and
    bends under the beam. Deviations from that, by pole and by point, are weighted by how straight bundles are
    relative to how accurate the map is.
    """
    seen = np.flatnonzero(~np.isnan(points[:, Z]))
    known = points[seen]
    cells = max(np.median(known[:, SEEN]) / CORRELATED_CELLS, 1.0)
    noise = 1.25 * np.median(known[:, SCATTER]) / np.sqrt(cells)
    points[seen, Z] = _straight(known, _columns(known[:, U]), noise)
    return float(noise * STRAIGHT_M / np.hypot(STRAIGHT_M, noise))


@kernel()
def _columns(u: Float64) -> Int64:
    """Number the points' places across (N,): those within half a micrometre are one."""
    numbers, places, count = np.empty(u.size, np.int64), np.empty(u.size), 0
    for k in range(u.size):
        number = 0
        while number < count and abs(places[number] - u[k]) > 0.5e-6:
            number += 1
        if number == count:
            places[count] = u[k]
            count += 1
        numbers[k] = number
    return numbers


@kernel()
def _straight(known: Float64, column: Int64, noise: float) -> Float64:
    """Estimate the most likely heights (N,); column: (N,) number of the place across."""
    u, v, z, pole = known[:, U], known[:, V], known[:, Z], known[:, POLE]
    path, steep, line, along = np.zeros(4), np.zeros(z.size), np.zeros(z.size), np.zeros(z.size)
    rest, near, sigma = np.empty(z.size), np.empty(z.size), known[:, SIGMA]
    for _ in range(4):
        for k in range(z.size):
            rest[k] = z[k] - along[k]
        _median_of_each(rest, column, line)
        for k in range(z.size):
            near[k] = min(max(2 - abs(rest[k] - line[k]) / NEAR_LINE_M, 0.0), 1.0)
            rest[k] = z[k] - line[k]
        steep = _steepness(u, line)
        path = _path(v, rest, steep, near, max(noise, 1e-3))
        for k in range(z.size):
            along[k] = path[0] * v[k] - steep[k] * (path[1] * v[k] + path[2] * v[k] ** 2)
            along[k] += path[3] * v[k] ** 2
    apart, unsure, number = np.empty(z.size), np.empty(z.size), pole.astype(np.int64)
    for k in range(z.size):
        line[k] += along[k]
        rest[k] = z[k] - line[k]
    _median_of_each(rest, number, apart)
    _median_of_each(sigma, number, unsure)
    for k in range(z.size):
        line[k] += _likely(apart[k], unsure[k]) + _likely(rest[k] - apart[k], noise)
    return line


@kernel()
def _median_of_each(values: Float64, number: Int64, out: Float64) -> None:
    """Fill out (N,) with the median of the values (N,) that have the same number."""
    own = np.empty(values.size)
    for n in range(number.max() + 1):
        count = 0
        for k in range(values.size):
            if number[k] == n:
                own[count] = values[k]
                count += 1
        if count == 0:
            continue
        median = np.median(own[:count])
        for k in range(values.size):
            if number[k] == n:
                out[k] = median


@kernel()
def _steepness(u: Float64, line: Float64) -> Float64:
    """Compute the slope (N,) across of a section with heights line (N,), m, at places u
    (N,), by neighbours.
    """
    steep = np.zeros(u.size)
    for k in range(u.size):
        low, high = k, k
        for n in range(u.size):
            if -1.5 * STEP_M < u[n] - u[k] < u[low] - u[k] - 1e-6:
                low = n
            if 1.5 * STEP_M > u[n] - u[k] > u[high] - u[k] + 1e-6:
                high = n
        if u[high] > u[low]:
            steep[k] = (line[high] - line[low]) / (u[high] - u[low])
    return steep


@kernel()
def _path(v: Float64, rise: Float64, steep: Float64, weight: Float64, noise: float) -> Float64:
    """Estimate how a load runs under the beam (4,): slope, sideways turn, sideways bend and sag per metre.

    rise: (N,) heights over the section at places v (N,) along, m; steep: (N,) its slope across; weight: (N,).
    noise: m. Linear least squares, with priors of ASKEW, BENT_PER_M and SAG_PER_M on turn, bend and sag.
    """
    normal, right = np.zeros((4, 4)), np.zeros(4)
    middle = (weight * v**2).sum() / max(weight.sum(), 1e-9)
    for k in range(v.size):
        term = v[k], -steep[k] * v[k], -steep[k] * v[k] ** 2, v[k] ** 2 - middle
        for a in range(4):
            right[a] += weight[k] * term[a] * rise[k]
            for b in range(4):
                normal[a, b] += weight[k] * term[a] * term[b]
    for a, sigma in ((0, 1.0), (1, ASKEW), (2, BENT_PER_M), (3, SAG_PER_M)):
        normal[a, a] += (noise / sigma) ** 2
    # Gaussian elimination: LAPACK's solver would take half of this module's compile time.
    for a in range(3):
        for b in range(a + 1, 4):
            share = normal[b, a] / normal[a, a]
            right[b] -= share * right[a]
            for c in range(a, 4):
                normal[b, c] -= share * normal[a, c]
    for a in (3, 2, 1, 0):
        for c in range(a + 1, 4):
            right[a] -= normal[a, c] * right[c]
        right[a] /= normal[a, a]
    return right


@kernel()
def _likely(measured: float, sigma: float) -> float:
    """Estimate the most likely true value of a deviation from straight that was measured."""
    # Between straight and bent the share rises continuously: with a jump, a micrometre would decide a lift.
    bent = abs(measured) / (BENT_SIGMA * np.hypot(STRAIGHT_M, sigma))
    share = min(max((bent - STRAIGHT_UP_TO) / (1 - STRAIGHT_UP_TO), 0.0), 1.0)
    shrunk = STRAIGHT_M**2 / (STRAIGHT_M**2 + sigma**2)
    return float(measured * (share + (1 - share) * shrunk))


@kernel()
def rest_faces(
    u: Float64, v: Float64, z: Float64, noise: float, max_roll: float
) -> tuple[float, float, float, float]:
    """Rest the faces: height at the centre, roll, pitch, and how far from the middle they rest where the
    suspension stops their lean, within the lean's sigma; otherwise 0.

    u, v, z: (N,) m across and along from the centre, and up; noise: m. Roll is the slope along u, at most
    max_roll; pitch along v.
    """
    height, roll, pitch = rest_plane(u, v, z, max_roll)
    # The maximum of many noisy points is biased upwards.
    height -= noise
    rests_off = 0.0
    sigma = noise / max(u.max() - u.min(), 1e-3)
    if abs(roll) > 0.999 * max_roll - sigma:
        gap = height + roll * u + pitch * v - z
        near = np.maximum(1 - (gap - gap.min()) / (noise + 0.0005), 0.0)
        rests_off = abs((near * u).sum() / near.sum())
    return height, roll, pitch, rests_off


@kernel()
def _sample(
    z: Float32, sigma: Float32, source: UInt8, at: Float64, frame: Float64, poles: Float64, shape: Int64,
    out: Float64,
) -> None:  # fmt: skip
    """Sample the map's median heights under all poles, each of `shape` (P, 2) columns and parts; see
    `_profile`. Fills out (N, COLUMNS), pole by pole.
    """
    first = 0
    for number in range(len(poles)):
        last = first + shape[number, 0] * shape[number, 1]
        out[first:last, POLE] = number
        _profile(z, sigma, source, at, frame, poles[number], shape[number, 1], out[first:last])
        first = last


@kernel()
def _profile(
    z: Float32, sigma: Float32, source: UInt8, at: Float64, frame: Float64, pole: Float64, parts: int,
    out: Float64,
) -> None:  # fmt: skip
    """Sample the map's median heights under one pole.

    z, sigma: maps (rows, columns), m; source: `HeightSource`, of which unknown and filled cells count as
    unseen. at: x and y of the first cell's centre, and its size, m. frame: (3, 2) the magnet's place, m, unit
    vectors along and across. pole: (4,) along, across, length, width, m. parts: along the pole, sampled every
    STEP_M. Fills out (columns * parts, COLUMNS) except for POLE; height and scatter are NaN where fewer than
    half of a part's samples are seen.
    """
    along, across, length, width = pole[0], pole[1], pole[2], pole[3]
    columns = out.shape[0] // parts
    samples = max(int(length / parts / STEP_M), 1)
    values = np.empty(samples)
    for i in range(columns):
        u = across + width * ((i + 0.5) / columns - 0.5)
        for k in range(parts):
            count, unsure, weight = 0, 0.0, 0.0
            for m in range(samples):
                v = along + length * ((k + (m + 0.5) / samples) / parts - 0.5)
                column = (frame[0, 0] + u * frame[2, 0] + v * frame[1, 0] - at[0]) / at[2]
                row = (frame[0, 1] + u * frame[2, 1] + v * frame[1, 1] - at[1]) / at[2]
                left, low = int(np.floor(column)), int(np.floor(row))
                total, spread, found = 0.0, 0.0, 0.0
                for c, share_c in ((left, 1 - (column - left)), (left + 1, column - left)):
                    for r, share_r in ((low, 1 - (row - low)), (low + 1, row - low)):
                        if r < 0 or c < 0 or r >= z.shape[0] or c >= z.shape[1]:
                            continue
                        if source[r, c] == _UNKNOWN or source[r, c] == _FILLED:
                            continue
                        total += share_c * share_r * z[r, c]
                        spread += share_c * share_r * sigma[r, c]
                        found += share_c * share_r
                weight += found
                if found >= 0.5:
                    values[count] = total / found
                    unsure += spread / found
                    count += 1
            own = out[i * parts + k]
            own[U], own[V] = u, along + length * ((k + 0.5) / parts - 0.5)
            own[SEEN], own[ALL], own[SIGMA] = weight, samples, unsure / max(count, 1)
            own[Z] = own[SCATTER] = np.nan
            if 2 * count >= samples:
                middle = np.median(values[:count])
                own[Z] = middle
                own[SCATTER] = SIGMA_PER_MAD * np.median(np.abs(values[:count] - middle))


@kernel()
def rest_plane(u: Float64, v: Float64, z: Float64, max_roll: float) -> tuple[float, float, float]:
    """Rest a plane on the points: height at the origin, slope along u and along v.

    Of all planes on or above the points it has the lowest origin; its slope along u is limited to `max_roll`.
    The height is convex in the slopes, so two nested searches find the only minimum. u, v, z: (N,) m.
    """
    low, high = -max_roll, max_roll
    for _ in range(26):
        a, b = low + (high - low) * 0.382, low + (high - low) * 0.618
        at_a, at_b = _rest_along(u, v, z, a), _rest_along(u, v, z, b)
        if at_a[0] <= at_b[0]:
            high = b
        else:
            low = a
    roll = (low + high) / 2
    if max_roll - abs(roll) < 1e-3 * max_roll:
        roll = max_roll if roll > 0 else -max_roll
    height, pitch = _rest_along(u, v, z, roll)
    return height, roll, pitch


@kernel()
def _rest_along(u: Float64, v: Float64, z: Float64, roll: float) -> tuple[float, float]:
    """Rest the plane with a given slope along u: height (m) at the origin and slope along v.

    u, v, z: (N,) m. roll: slope along u. Golden-section search over slopes within `_STEEPEST` for the lowest
    height, which is convex in the slope [Kiefer 1953].
    """
    low, high = -_STEEPEST, _STEEPEST
    for _ in range(26):
        a, b = low + (high - low) * 0.382, low + (high - low) * 0.618
        at_a = at_b = -np.inf
        for i in range(u.size):
            left = z[i] - roll * u[i]
            at_a = max(at_a, left - a * v[i])
            at_b = max(at_b, left - b * v[i])
        if at_a <= at_b:
            high = b
        else:
            low = a
    slope = (low + high) / 2
    height = -np.inf
    for i in range(u.size):
        height = max(height, z[i] - roll * u[i] - slope * v[i])
    return height, slope
