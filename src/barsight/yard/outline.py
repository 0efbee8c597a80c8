"""What a bundle looks like from above: the upper outline of round bars in hexagonal packing."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from barsight.core.arrays import Float64, kernel

BARS_OF_RINGS = (1, 7, 19, 37, 61)
"""Bars of a full hexagon of 0, 1, 2, ... rings around the middle bar."""
LOOSENESS = 1.003
"""Distance of neighbouring axes over the diameter: bars are never quite straight."""
PERIOD_RAD = np.pi / 3
"""A hexagon looks the same after this turn."""
STEP_M = 0.001


@lru_cache(maxsize=8)
def hexagon(rings: int) -> Float64:
    """(bars, 2) axes of the packing, sideways and up, in diameters, a row lying level."""
    cells = [
        (q + r / 2, r * np.sqrt(0.75))
        for q in range(-rings, rings + 1)
        for r in range(-rings, rings + 1)
        if abs(q + r) <= rings
    ]
    return LOOSENESS * np.array(cells, dtype=np.float64).reshape(-1, 2)


def turned_hexagon(rings: int, diameter_m: float, roll_rad: float) -> Float64:
    """(bars, 2) axes in m, the packing rolled clockwise by roll_rad as seen along the bundle."""
    c, s = np.cos(roll_rad), np.sin(roll_rad)
    turned: Float64 = diameter_m * (hexagon(rings) @ np.array([[c, s], [-s, c]]))
    return turned


def bundle_width(rings: int, diameter_m: float) -> float:
    """Diameter of the circle around all bars."""
    return diameter_m * (2 * LOOSENESS * rings + 1)


@dataclass(frozen=True, eq=False)
class Outline:
    """Heights over the bundle's axis at sideways places -reach_m ... reach_m, STEP_M apart; odd in number.

    exact_m: NaN beyond the outermost bar. seen_m: as a map with `smoothing_m` shows it. slope: of seen_m.
    """

    reach_m: float
    exact_m: Float64
    seen_m: Float64
    slope: Float64


def make_outline(rings: int, diameter_m: float, roll_rad: float, smoothing_m: float) -> Outline:
    """The upper outline of a bundle."""
    axes = turned_hexagon(rings, diameter_m, roll_rad)
    half = int(np.ceil((np.abs(axes[:, 0]).max() + diameter_m / 2) / STEP_M)) + 1
    return Outline(half * STEP_M, *_trace(axes, diameter_m / 2, half, smoothing_m))


@kernel()
def _trace(axes: Float64, radius: float, half: int, sigma: float) -> tuple[Float64, Float64, Float64]:
    """Outline, its Gaussian mean over the part that is there, and that mean's slope, at -half ... half."""
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
    weight = np.ones(reach + 1)
    for k in range(1, reach + 1):
        weight[k] = np.exp(-0.5 * (STEP_M * k / sigma) ** 2)
    for i in range(size):
        if exact[i] != exact[i]:
            continue
        total = share = 0.0
        for k in range(max(i - reach, 0), min(i + reach, size - 1) + 1):
            if exact[k] == exact[k]:
                total += weight[abs(k - i)] * exact[k]
                share += weight[abs(k - i)]
        seen[i] = total / share
    for i in range(1, size - 1):
        slope[i] = (seen[i + 1] - seen[i - 1]) / (2 * STEP_M)
    return exact, seen, slope
