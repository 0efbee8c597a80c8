"""Widen the poses that were given out before a fault of the encoders was known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from barsight.core.arrays import Float64, Int64
from barsight.core.records.sensor_samples import CraneSamples
from barsight.core.records.trajectory import PosedFrame
from barsight.core.stamps import NS_PER_S


def widened(frames: Sequence[PosedFrame], off_m: Float64) -> tuple[PosedFrame, ...]:
    """Add the squares of errors (F, 3), each as one along its direction, to the positions' covariances."""
    found = []
    for frame, off in zip(frames, off_m, strict=True):
        covariance = frame.covariance.copy()
        covariance[3:, 3:] += np.outer(off, off)
        found.append(replace(frame, covariance=covariance))
    return tuple(found)


def way_of_delay(crane: CraneSamples, stamp_ns: Int64, late_ns: int, found_ns: int) -> Float64:
    """Compute by how much (F, 3) readings are off that are late by `late_ns`; nothing from `found_ns` on."""
    if not (late_ns and len(crane.stamp_ns)):
        return np.zeros((len(stamp_ns), 3))
    begin_ns = crane.stamp_ns[0]

    def place_at(stamps: Int64) -> Float64:
        time, at = (crane.stamp_ns - begin_ns) / NS_PER_S, (stamps - begin_ns) / NS_PER_S
        return np.column_stack([np.interp(at, time, axis) for axis in crane.position_m.T])

    off = place_at(stamp_ns + late_ns) - place_at(stamp_ns)
    return np.where((stamp_ns < found_ns)[:, None], off, 0.0)
