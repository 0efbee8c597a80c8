"""Describe a yard as exact solids, round and square, and cut them by vertical lines.

`yard` frame, metres. A bundle is strapped steel: its bars, and the straps and tags on them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np

from barsight.core.arrays import Float32, Float64, Int32, kernel

STEEL_KG_PER_M3 = 7850.0
NEWTON_PER_KG = 9.81
STEP_M = 0.001
NOTHING = -1
"""Owner of what belongs to no bundle; number of no solid."""

Part = Literal["bar", "strap", "tag", "beam", "wall", "stanchion"]
STEEL: tuple[Part, ...] = ("bar", "strap", "stanchion")


@dataclass(frozen=True, eq=False)
class Solid:
    """A capped cylinder or a box. centre: (3,). axes: (3, 3) rows, unit, of a cylinder the first its own.

    half: (3,) half sizes along the axes; of a cylinder half length, radius, radius. bundle: whose part it
    is, NOTHING where it is of none.
    """

    part: Part
    is_round: bool
    centre: Float64
    axes: Float64
    half: Float64
    bundle: int = NOTHING

    @property
    def is_steel(self) -> bool:
        """Tell whether a magnet pulls it."""
        return self.part in STEEL

    @property
    def bounds(self) -> Float64:
        """Return the lower and the upper corner (2, 3) of what encloses it."""
        if self.is_round:
            axis = np.abs(self.axes[0])
            reach = axis * self.half[0] + self.half[1] * np.sqrt(np.maximum(1 - axis**2, 0))
        else:
            reach = np.abs(self.axes).T @ self.half
        return np.stack([self.centre - reach, self.centre + reach])

    def moved(self, by: Float64) -> Solid:
        """Shift by (3,)."""
        return replace(self, centre=self.centre + by)

    def turned(self, yaw_rad: float) -> Solid:
        """Turn about the vertical through the origin."""
        turn = turn_about_z(yaw_rad)
        return replace(self, centre=turn @ self.centre, axes=self.axes @ turn.T)


def cylinder(
    part: Part, centre: Float64, direction: Float64, radius: float, length: float, bundle: int = NOTHING
) -> Solid:
    """Make a round solid; direction: (3,), any length."""
    along = direction / np.linalg.norm(direction)
    helper = np.eye(3)[int(np.argmin(np.abs(along)))]
    beside = np.cross(along, helper)
    beside /= np.linalg.norm(beside)
    axes = np.stack([along, beside, np.cross(along, beside)])
    return Solid(part, True, np.asarray(centre, float), axes, np.array([length / 2, radius, radius]), bundle)


def box(part: Part, centre: Float64, size: Float64, yaw_rad: float = 0.0, bundle: int = NOTHING) -> Solid:
    """Make a level box; size: (3,) along X, Y and Z before it is turned by the yaw."""
    axes = turn_about_z(yaw_rad).T
    return Solid(part, False, np.asarray(centre, float), axes, np.asarray(size, float) / 2, bundle)


def turn_about_z(yaw_rad: float) -> Float64:
    """Return the turn (3, 3)."""
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


@dataclass(frozen=True, eq=False)
class SolidYard:
    """All that lies and stands on the floor z = 0."""

    solids: tuple[Solid, ...]

    @cached_property
    def table(self) -> Float64:
        """Return (N, 16): 1 for round or 0, centre, three axes, half sizes."""
        rows = [[float(s.is_round), *s.centre, *s.axes.ravel(), *s.half] for s in self.solids]
        return np.array(rows, dtype=np.float64).reshape(-1, 16)

    @cached_property
    def owner(self) -> Int32:
        """Return (N,): each solid's bundle."""
        return np.array([s.bundle for s in self.solids], dtype=np.int32)

    @cached_property
    def bundles(self) -> tuple[int, ...]:
        """Return the numbers of the bundles."""
        return tuple(sorted({s.bundle for s in self.solids} - {NOTHING}))

    def bars(self, bundle: int) -> tuple[Solid, ...]:
        """Return a bundle's bars."""
        return tuple(s for s in self.solids if s.bundle == bundle and s.part == "bar")

    def load(self, bundle: int) -> tuple[float, Float64]:
        """Compute a bundle's mass by its bars, kg, and its centre of mass (3,)."""
        bars = self.bars(bundle)
        kg = np.array([STEEL_KG_PER_M3 * math.pi * b.half[1] ** 2 * 2 * b.half[0] for b in bars])
        return float(kg.sum()), np.array([b.centre for b in bars]).T @ kg / kg.sum()

    def seen_from(self, x: float, y: float, yaw_rad: float) -> SolidYard:
        """Move into the frame that stands at (x, y), turned by the yaw."""
        by = np.array([-x, -y, 0.0])
        return SolidYard(tuple(s.moved(by).turned(-yaw_rad) for s in self.solids))


@dataclass(frozen=True, eq=False)
class Envelope:
    """Highest surface over a grid of STEP_M or coarser. Cell (i, j) is at (x0 + i step, y0 + j step).

    z: (X, Y), 0 where there is the floor only. top: (X, Y) number of the solid, NOTHING for the floor.
    """

    x0: float
    y0: float
    step: float
    z: Float32
    top: Int32


def envelope(
    yard: SolidYard, low: tuple[float, float], high: tuple[float, float], take: Float64 | None = None,
    step: float = STEP_M,
) -> Envelope:  # fmt: skip
    """Draw the envelope of the solids, or of those for which `take` (N,) is not 0, from corner to corner."""
    shape = tuple(round((b - a) / step) + 1 for a, b in zip(low, high, strict=True))
    z, top = np.zeros(shape, np.float32), np.full(shape, NOTHING, np.int32)
    chosen = np.ones(len(yard.solids)) if take is None else np.asarray(take, float)
    bounds = np.array([s.bounds for s in yard.solids]).reshape(-1, 2, 3)
    _draw(yard.table, bounds, chosen, low[0], low[1], step, z, top)
    return Envelope(low[0], low[1], step, z, top)


def undersides(
    yard: SolidYard, low: tuple[float, float], high: tuple[float, float], number: int, step: float
) -> Float64:
    """Compute the lowest surface (X, Y) of one solid over a grid, inf beside it."""
    shape = tuple(round((b - a) / step) + 1 for a, b in zip(low, high, strict=True))
    out = np.full(shape, np.inf)
    _draw_underside(yard.table[number], low[0], low[1], step, out)
    return out


@kernel()
def _draw(
    table: Float64, bounds: Float64, take: Float64, x0: float, y0: float, step: float, z: Float32, top: Int32
) -> None:
    """Draw the highest surface over the cells (X, Y) into z, m, and its solid's number into top.

    table: (N, 16); bounds: (N, 2, 3) of each solid; take: (N,), 0 for those that are left out.
    """
    # The highest first: most of what lies below is then passed over.
    for n in np.argsort(-bounds[:, 1, 2]):
        if take[n] == 0:
            continue
        first_i = max(math.ceil((bounds[n, 0, 0] - x0) / step), 0)
        last_i = min(math.floor((bounds[n, 1, 0] - x0) / step), z.shape[0] - 1)
        first_j = max(math.ceil((bounds[n, 0, 1] - y0) / step), 0)
        last_j = min(math.floor((bounds[n, 1, 1] - y0) / step), z.shape[1] - 1)
        for i in range(first_i, last_i + 1):
            for j in range(first_j, last_j + 1):
                if bounds[n, 1, 2] <= z[i, j]:
                    continue
                low, high = cut(table[n], x0 + i * step, y0 + j * step)
                if low <= high and high > z[i, j]:
                    z[i, j], top[i, j] = high, n


@kernel()
def _draw_underside(solid: Float64, x0: float, y0: float, step: float, out: Float64) -> None:
    """Draw the lowest surface of one row (16,) of the table over the cells (X, Y) into out, m."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            low, high = cut(solid, x0 + i * step, y0 + j * step)
            if low <= high:
                out[i, j] = low


@kernel()
def cut(solid: Float64, x: float, y: float) -> tuple[float, float]:
    """Cut a solid by the vertical line at (x, y): from z to z, empty (first over second) where it misses.

    solid: (16,), a row of `SolidYard.table`. All m.
    """
    qx, qy = x - solid[1], y - solid[2]
    low, high = -np.inf, np.inf
    for k in range(1 if solid[0] else 3):
        aside, rise = qx * solid[4 + 3 * k] + qy * solid[5 + 3 * k], solid[6 + 3 * k]
        half = solid[13 + k]
        if abs(rise) < 1e-12:
            if abs(aside) > half:
                return 1.0, -1.0
        else:
            a, b = (-half - aside) / rise, (half - aside) / rise
            low, high = max(low, min(a, b)), min(high, max(a, b))
    if solid[0]:
        aside, rise, radius = qx * solid[4] + qy * solid[5], solid[6], solid[14]
        steep = 1 - rise * rise
        rest = qx * qx + qy * qy - aside * aside - radius * radius
        if steep < 1e-12:
            if rest > 0:
                return 1.0, -1.0
        else:
            root = aside * aside * rise * rise - steep * rest
            if root < 0:
                return 1.0, -1.0
            low = max(low, (aside * rise - math.sqrt(root)) / steep)
            high = min(high, (aside * rise + math.sqrt(root)) / steep)
    return solid[3] + low, solid[3] + high
