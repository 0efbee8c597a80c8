"""Describe a yard as exact solids, round and square.

`yard` frame, metres. A bundle is strapped steel: its bars, and the straps and tags on them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np

from barsight.core.arrays import Float64, Int32

STEEL_KG_PER_M3 = 7850.0
NOTHING = -1
"""Owner of a solid that belongs to no bundle; also the number that stands for no solid."""

Part = Literal["bar", "strap", "tag", "beam", "wall", "stanchion", "cart", "person"]
STEEL: tuple[Part, ...] = ("bar", "strap", "stanchion")


@dataclass(frozen=True, eq=False)
class Solid:
    """A capped cylinder or a box. centre: (3,). axes: (3, 3) unit rows; the first of a cylinder is its axis.

    half: (3,) half sizes along the axes; of a cylinder: half length, radius, radius. bundle: the bundle that
    it belongs to, or NOTHING.
    """

    part: Part
    is_round: bool
    centre: Float64
    axes: Float64
    half: Float64
    bundle: int = NOTHING

    @property
    def is_steel(self) -> bool:
        """Tell whether a magnet attracts it."""
        return self.part in STEEL

    @property
    def bounds(self) -> Float64:
        """Return the lower and the upper corner (2, 3) of its bounding box."""
        if self.is_round:
            axis = np.abs(self.axes[0])
            reach = axis * self.half[0] + self.half[1] * np.sqrt(np.maximum(1 - axis**2, 0))
        else:
            reach = np.abs(self.axes).T @ self.half
        return np.stack([self.centre - reach, self.centre + reach])

    def moved(self, by: Float64) -> Solid:
        """Shift the solid by (3,)."""
        return replace(self, centre=self.centre + by)

    def turned(self, yaw_rad: float) -> Solid:
        """Rotate the solid about the vertical through the origin."""
        turn = turn_about_z(yaw_rad)
        return replace(self, centre=turn @ self.centre, axes=self.axes @ turn.T)


def cylinder(
    part: Part, centre: Float64, direction: Float64, radius: float, length: float, bundle: int = NOTHING
) -> Solid:
    """Create a round solid; direction: (3,), any length."""
    long = math.sqrt(float(direction @ direction))
    x, y, z = (float(d) / long for d in direction)
    if abs(z) > 0.9:
        level, u, v, w = math.hypot(y, z), 0.0, z, -y
    else:
        level, u, v, w = math.hypot(x, y), y, -x, 0.0
    u, v, w = u / level, v / level, w / level
    axes = np.array([[x, y, z], [u, v, w], [y * w - z * v, z * u - x * w, x * v - y * u]])
    return Solid(part, True, np.asarray(centre, float), axes, np.array([length / 2, radius, radius]), bundle)


def box(part: Part, centre: Float64, size: Float64, yaw_rad: float = 0.0, bundle: int = NOTHING) -> Solid:
    """Create a level box; size: (3,) along X, Y and Z before it is rotated by the yaw."""
    axes = turn_about_z(yaw_rad).T
    return Solid(part, False, np.asarray(centre, float), axes, np.asarray(size, float) / 2, bundle)


def turn_about_z(yaw_rad: float) -> Float64:
    """Return the rotation matrix (3, 3) about the vertical."""
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


@dataclass(frozen=True, eq=False)
class SolidYard:
    """All solids on the floor z = 0."""

    solids: tuple[Solid, ...]

    @cached_property
    def table(self) -> Float64:
        """Return (N, 16): 1 for a round solid or else 0, centre, three axes, half sizes."""
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
        """Compute a bundle's mass from its bars, kg, and its centre of mass (3,)."""
        bars = self.bars(bundle)
        kg = np.array([STEEL_KG_PER_M3 * math.pi * b.half[1] ** 2 * 2 * b.half[0] for b in bars])
        return float(kg.sum()), np.array([b.centre for b in bars]).T @ kg / kg.sum()

    def seen_from(self, x: float, y: float, yaw_rad: float) -> SolidYard:
        """Transform the yard into a frame at (x, y), rotated by the yaw."""
        by = np.array([-x, -y, 0.0])
        return SolidYard(tuple(s.moved(by).turned(-yaw_rad) for s in self.solids))
