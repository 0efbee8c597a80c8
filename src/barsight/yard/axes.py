"""Compute with axes in plan view: bundles, loads and the beam lie along them. An axis has no direction."""

from __future__ import annotations

import math

import numpy as np

from barsight.core.arrays import Float64


def axes_of(yaw_rad: float) -> Float64:
    """Return unit vectors (2, 2): across an axis and along it."""
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    return np.array([[cos, sin], [-sin, cos]])


def high_side(yaw_rad: float) -> Float64:
    """Return the unit vector (2,) across an axis, towards high x, or high y if the axis is closer to X."""
    across, _ = axes_of(yaw_rad)
    larger = 0 if abs(across[0]) > abs(across[1]) else 1
    return -across if across[larger] < 0 else across


def turn_between(yaw_rad: float, other_rad: float) -> float:
    """Compute the angle in [-pi/2, pi/2) from one axis to another."""
    return (other_rad - yaw_rad + math.pi / 2) % math.pi - math.pi / 2
