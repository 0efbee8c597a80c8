"""Define the records of what IMU, encoders and laser have read."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from barsight.core.arrays import Float64, Int64


@dataclass(frozen=True, eq=False)
class ImuSamples:
    """stamp_ns: (N,) int64 increasing. gyro_radps, accel_mps2: (N, 3) in `body`."""

    stamp_ns: Int64
    gyro_radps: Float64
    accel_mps2: Float64


@dataclass(frozen=True)
class EncoderJump:
    """A jump of one encoder's readings, from `stamp_ns` on: bridge, trolley or hoist (axis 0, 1, 2).

    size_m: by how much the readings are taken to have jumped; sigma_m: of that. kind: whether it is sure, may
    be one, or might be since the readings stood still before.
    """

    stamp_ns: int
    axis: int
    size_m: float
    sigma_m: float
    kind: Literal["sure", "maybe", "freeze"] = "sure"

    def share(self, stamp_ns: Int64) -> Float64:
        """Return (N,) by how many times its size readings of these stamps are off: 0 or, from it on, 1."""
        return np.where(stamp_ns >= self.stamp_ns, 1.0, 0.0)


@dataclass(frozen=True, eq=False)
class CraneSamples:
    """The encoders' place of the crane's reference point.

    stamp_ns: (N,) int64 increasing. position_m: (N, 3) in `yard`: bridge x, trolley y, hoist z.
    crane_to_body_m: (3,) the body's origin minus the crane point, yard axes.
    yard_from_body_nominal: (3, 3) attitude of the body as mounted. position_std_m: one reading's sigma.
    jumps: found in the readings and taken off them, in time's order; no fit may reach across one.
    """

    stamp_ns: Int64
    position_m: Float64
    crane_to_body_m: Float64
    yard_from_body_nominal: Float64
    position_std_m: float
    jumps: tuple[EncoderJump, ...] = ()


@dataclass(frozen=True, eq=False)
class LaserProfile:
    """A reference contour along X. x_m, y_m, z_m: (N,) in `yard`, x increasing. range_std_m: its sigma."""

    profile: int
    x_m: Float64
    y_m: Float64
    z_m: Float64
    range_std_m: float
