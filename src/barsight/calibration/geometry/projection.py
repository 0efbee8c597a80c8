"""Project points with analytic Jacobians with respect to point and lens parameters.

Pixels come from the same models as in `Camera.project` (OpenCV's radial-tangential with 4, 5 or 8
coefficients, equidistant [Kannala 2006]); a test compares the two.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from barsight.calibration.geometry.camera import Camera, Distortion
from barsight.core.arrays import Float64

INTRINSIC_NAMES = ("fx_px", "fy_px", "cx_px", "cy_px")


class Lens(StrEnum):
    """Lens models that a calibration can estimate."""

    RADTAN4 = "radtan4"
    RADTAN5 = "radtan5"
    RADTAN8 = "radtan8"
    EQUIDISTANT = "equidistant"

    @property
    def coefficient_names(self) -> tuple[str, ...]:
        """Return k1, k2, ... in the order of `Camera.coefficients`."""
        if self is Lens.EQUIDISTANT:
            return ("k1", "k2", "k3", "k4")
        return ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")[: int(self[-1])]

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Return fx, fy, cx, cy and the names of the coefficients."""
        return INTRINSIC_NAMES + self.coefficient_names

    def camera(self, parameters: Float64, width: int, height: int) -> Camera:
        """Build the camera from a parameter vector. Raises ValueError for invalid parameters."""
        fx, fy, cx, cy, *rest = (float(value) for value in parameters)
        kind = Distortion.EQUIDISTANT if self is Lens.EQUIDISTANT else Distortion.RADTAN
        return Camera(width, height, fx, fy, cx, cy, kind, tuple(rest))


@dataclass(frozen=True, eq=False)
class Projected:
    """Projected points. pixels (N, 2); derivatives with respect to the point, by_point (N, 2, 3), and to the
    lens parameters, by_lens (N, 2, P).
    """

    pixels: Float64
    by_point: Float64
    by_lens: Float64


def project_lens(lens: Lens, parameters: Float64, points: Float64) -> Projected:
    """Project points (N, 3) in the camera's frame, z > 0; parameters (4 + coefficients,)."""
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    bend = _equidistant if lens is Lens.EQUIDISTANT else _radial_tangential
    bent, by_plane, by_coefficients = bend(x, y, parameters[4:])
    focal = parameters[:2]
    zero = np.zeros_like(x)
    plane_by_point = np.stack([
        np.stack([1 / points[:, 2], zero, -x / points[:, 2]], axis=1),
        np.stack([zero, 1 / points[:, 2], -y / points[:, 2]], axis=1),
    ], axis=1)  # fmt: skip
    by_point = focal[:, None] * (by_plane @ plane_by_point)
    by_lens = np.zeros((len(points), 2, parameters.size))
    by_lens[:, 0, 0], by_lens[:, 1, 1] = bent[:, 0], bent[:, 1]
    by_lens[:, 0, 2] = by_lens[:, 1, 3] = 1.0
    by_lens[:, :, 4:] = focal[:, None] * by_coefficients
    return Projected(bent * focal + parameters[2:4], by_point, by_lens)


def _radial_tangential(x: Float64, y: Float64, k: Float64) -> tuple[Float64, Float64, Float64]:
    k1, k2, p1, p2, k3, k4, k5, k6 = np.concatenate([k, np.zeros(8 - k.size)])
    s = x * x + y * y
    above = 1 + s * (k1 + s * (k2 + s * k3))
    below = 1 + s * (k4 + s * (k5 + s * k6))
    radial = above / below
    slope = ((k1 + s * (2 * k2 + 3 * s * k3)) - radial * (k4 + s * (2 * k5 + 3 * s * k6))) / below
    bent = np.stack([
        x * radial + 2 * p1 * x * y + p2 * (s + 2 * x * x),
        y * radial + p1 * (s + 2 * y * y) + 2 * p2 * x * y,
    ], axis=1)  # fmt: skip
    cross = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
    by_plane = np.empty((x.size, 2, 2))
    by_plane[:, 0, 0] = radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
    by_plane[:, 0, 1] = by_plane[:, 1, 0] = cross
    by_plane[:, 1, 1] = radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
    plane = np.stack([x, y], axis=1)[:, :, None]
    powers = np.stack([s, s**2, s**3], axis=1)[:, None, :] / below[:, None, None]
    up, down = plane * powers, -plane * powers * radial[:, None, None]
    tangential = np.stack([
        np.stack([2 * x * y, s + 2 * x * x], axis=1),
        np.stack([s + 2 * y * y, 2 * x * y], axis=1),
    ], axis=1)  # fmt: skip
    whole = np.concatenate([up[:, :, :2], tangential, up[:, :, 2:], down], axis=2)
    return bent, by_plane, whole[:, :, : k.size]


def _equidistant(x: Float64, y: Float64, k: Float64) -> tuple[Float64, Float64, Float64]:
    radius = np.maximum(np.hypot(x, y), 1e-9)
    theta = np.arctan(radius)
    t2 = theta * theta
    powers = np.stack([t2, t2**2, t2**3, t2**4], axis=1)
    bent_theta = theta * (1 + powers @ k)
    scale = bent_theta / radius
    slope = (1 + powers @ (k * np.array([3.0, 5.0, 7.0, 9.0]))) / (1 + radius**2)
    plane = np.stack([x, y], axis=1)
    scale_slope = (slope - scale) / radius**2
    by_plane = scale[:, None, None] * np.eye(2) + (
        scale_slope[:, None, None] * plane[:, :, None] * plane[:, None, :]
    )
    by_k = plane[:, :, None] * (theta[:, None] * powers / radius[:, None])[:, None, :]
    return plane * scale[:, None], by_plane, by_k
