"""Compute with axes and rectangles in plan view, as bundles, loads and the magnet have. An axis has no
direction.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from barsight.core.arrays import Float64


def axes_of(yaw_rad: float) -> Float64:
    """Return unit vectors (2, 2): across an axis and along it."""
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    return np.array([[cos, sin], [-sin, cos]])


def high_side(yaw_rad: float) -> Float64:
    """Return the unit vector (2,) across an axis, towards high x, or high y if the axis is closer to X."""
    across, _ = axes_of(yaw_rad)
    larger = 0 if abs(across[0]) > abs(across[1]) else 1
    return np.asarray(-across if across[larger] < 0 else across)


def turn_between(yaw_rad: float, other_rad: float) -> float:
    """Compute the angle in [-pi/2, pi/2) from one axis to another."""
    return (other_rad - yaw_rad + math.pi / 2) % math.pi - math.pi / 2


def corners(centre: ArrayLike, yaw_rad: float, width_m: float, length_m: float) -> Float64:
    """Compute the corners (4, 2) of a rectangle, m: of its low-y end from the low to the high side, then of
    its high-y end back. centre: x and y. yaw_rad: of its length, from +Y about Z.
    """
    turns = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    corner: Float64 = np.asarray(centre) + turns * (width_m / 2, length_m / 2) @ axes_of(yaw_rad)
    return corner


def gap_between(one: Float64, other: Float64) -> float:
    """Compute a lower bound (m) of two rectangles' distance by separating axes; 0 where they overlap."""
    widest = 0.0
    for corner in (one, other):
        for side in (corner[1] - corner[0], corner[2] - corner[1]):
            length = float(np.linalg.norm(side))
            if length == 0:
                continue
            a, b = one @ side / length, other @ side / length
            widest = max(widest, float(a.min() - b.max()), float(b.min() - a.max()))
    return widest
