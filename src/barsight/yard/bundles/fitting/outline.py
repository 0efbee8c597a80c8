"""Compute a bundle's upper outline: that of round bars packed in a full hexagon or a triangle."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from barsight.core.arrays import Float64, Int64, kernel

BARS_OF_RINGS = (1, 7, 19, 37, 61, 3)
"""Bars in each packing: a full hexagon of 0, 1, 2, ... rings around the middle bar, then the triangle."""
TRIANGLE = 5
"""Code used instead of a number of rings for a triangle: one bar on two, as thick bars are strapped."""
TRIANGLE_BARS_M = (0.06, 0.12)
"""Minimum and maximum diameter (m) of a triangle's bars: the shoulders of thinner ones are lost in the map's
smoothing, and thicker ones are bundles of their own that are piled up.
"""
LOOSENESS = 1.003
"""Distance between neighbouring axes in diameters: bars are never quite straight."""
STEP_M = 0.001
_ROLL_STEP_RAD = float(np.radians(1.0))
_DIAMETER_STEP = 0.01


@lru_cache(maxsize=8)
def packing_axes(rings: int) -> Float64:
    """Compute the axes of the packing (bars, 2), sideways and up, in diameters, with a row of bars level."""
    if rings == TRIANGLE:
        rise = np.sqrt(0.75) / 2
        return LOOSENESS * np.array([(-0.5, -rise), (0.5, -rise), (0.0, rise)])
    cells = [
        (q + r / 2, r * np.sqrt(0.75))
        for q in range(-rings, rings + 1)
        for r in range(-rings, rings + 1)
        if abs(q + r) <= rings
    ]
    return LOOSENESS * np.array(cells, dtype=np.float64).reshape(-1, 2)


def turned_packing(rings: int, diameter_m: float, roll_rad: float) -> Float64:
    """Compute the axes (bars, 2) in m of the packing, rolled clockwise as seen along the bundle."""
    return _turned(packing_axes(rings), diameter_m, roll_rad)


def bundle_width(rings: int, diameter_m: float) -> float:
    """Compute the diameter (m) of the circle around all bars."""
    return diameter_m * (1 + LOOSENESS * (1 if rings == TRIANGLE else 2 * rings))


def period_rad(rings: int) -> float:
    """Return the rotation after which the packing looks the same."""
    return 2 * np.pi / 3 if rings == TRIANGLE else np.pi / 3


def highest_bars(axes_m: Float64, radius_m: float, u_m: Float64) -> tuple[Int64, Float64]:
    """Find the highest bar at each lateral place, and its height there; -1 and -inf where there is none."""
    inside = radius_m**2 - (u_m[:, None] - axes_m[:, 0]) ** 2
    heights = np.where(inside > 0, axes_m[:, 1] + np.sqrt(np.maximum(inside, 0)), -np.inf)
    top: Float64 = heights.max(axis=1)
    return np.where(np.isfinite(top), heights.argmax(axis=1), -1).astype(np.int64), top


@dataclass(frozen=True, eq=False)
class Outline:
    """Heights over the bundle's axis at lateral places -reach_m ... reach_m, STEP_M apart; odd in number.

    exact_m: NaN beyond the outermost bar. seen_m: as it appears in a map smoothed by `smoothing_m`. slope:
    that of seen_m.
    """

    reach_m: float
    exact_m: Float64
    seen_m: Float64
    slope: Float64


def make_outline(rings: int, diameter_m: float, roll_rad: float, smoothing_m: float) -> Outline:
    """Compute the upper outline of a bundle."""
    axes = turned_packing(rings, diameter_m, roll_rad)
    exact, seen, slope = _trace(axes, diameter_m / 2, smoothing_m)
    return Outline(exact.size // 2 * STEP_M, exact, seen, slope)


@kernel()
def _trace(axes: Float64, radius: float, sigma: float) -> tuple[Float64, Float64, Float64]:
    """Trace the outline, its Gaussian mean over the part that exists, and that mean's slope, at -half ...
    half.

    axes: (bars, 2) sideways and up, m. radius, sigma: m. Returns three arrays (N,), STEP_M apart, NaN where
    there is no bar.
    """
    half = int(np.ceil((np.abs(axes[:, 0]).max() + radius) / STEP_M)) + 1
    size = 2 * half + 1
    exact, seen, slope = np.full(size, np.nan), np.full(size, np.nan), np.full(size, np.nan)
    for b in range(axes.shape[0]):
        first = int(np.ceil((axes[b, 0] - radius) / STEP_M)) + half
        last = int(np.floor((axes[b, 0] + radius) / STEP_M)) + half
        for i in range(first, last + 1):
            beside = STEP_M * (i - half) - axes[b, 0]
            height = axes[b, 1] + np.sqrt(max(radius * radius - beside * beside, 0.0))
            if not exact[i] >= height:
                exact[i] = height
    reach = int(3 * sigma / STEP_M)
    there, height, total, share = np.zeros(size), np.zeros(size), np.zeros(size), np.zeros(size)
    for i in range(size):
        if not np.isnan(exact[i]):
            there[i], height[i] = 1.0, exact[i]
    for k in range(-reach, reach + 1):
        weight = np.exp(-0.5 * (STEP_M * k / sigma) ** 2) if k != 0 else 1.0
        first, end = max(-k, 0), min(size - k, size)
        add_weighted(total[first:end], height[first + k : end + k], weight)
        add_weighted(share[first:end], there[first + k : end + k], weight)
    for i in range(size):
        if there[i] > 0:
            seen[i] = total[i] / share[i]
    for i in range(1, size - 1):
        slope[i] = (seen[i + 1] - seen[i - 1]) / (2 * STEP_M)
    return exact, seen, slope


@kernel(inline=True)
def add_weighted(sums: Float64, values: Float64, weight: float) -> None:
    """Add weighted values (N,) to sums (N,).

    Pass slices that begin at 0: otherwise the compiler has to check for negative indices, and adds the values
    one at a time.
    """
    for i in range(sums.size):
        sums[i] += weight * values[i]


@kernel()
def trace_with_changes(packing: Float64, diameter: float, roll: float, sigma: float) -> Float64:
    """Trace the visible outline of `packing` (see `packing_axes`): heights, slope, and derivatives by roll
    and by diameter (4, N).
    """
    _, seen, slope = _trace(_turned(packing, diameter, roll), diameter / 2, sigma)
    _, rolled, _ = _trace(_turned(packing, diameter, roll + _ROLL_STEP_RAD), diameter / 2, sigma)
    wide = diameter * (1 + _DIAMETER_STEP)
    _, grown, _ = _trace(_turned(packing, wide, roll), wide / 2, sigma)
    tables = np.full((4, seen.size), np.nan)
    tables[0], tables[1] = seen, slope
    for i in range(seen.size):
        k = i + (rolled.size - seen.size) // 2
        if 0 <= k < rolled.size:
            tables[2, i] = (rolled[k] - seen[i]) / _ROLL_STEP_RAD
        k = i + (grown.size - seen.size) // 2
        if 0 <= k < grown.size:
            tables[3, i] = (grown[k] - seen[i]) / (diameter * _DIAMETER_STEP)
    return tables


@kernel()
def _turned(packing: Float64, diameter: float, roll: float) -> Float64:
    """Rotate the packing (bars, 2), in diameters, by roll (rad, sideways towards up) and scale it to m.

    diameter: m. Returns the axes (bars, 2), sideways and up.
    """
    turned = np.empty_like(packing)
    c, s = np.cos(roll), np.sin(roll)
    for b in range(packing.shape[0]):
        turned[b, 0] = diameter * (packing[b, 0] * c - packing[b, 1] * s)
        turned[b, 1] = diameter * (packing[b, 0] * s + packing[b, 1] * c)
    return turned
