"""Define the encoders' travel and scales."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from barsight.core.arrays import Float64


@dataclass(frozen=True, eq=False)
class EncoderTravel:
    """Encoders' positions (3,) m so far: the first, the lowest and the highest on each axis."""

    first_m: Float64
    low_m: Float64
    high_m: Float64

    @classmethod
    def of(cls, position_m: Sequence[Float64], before: EncoderTravel | None = None) -> EncoderTravel | None:
        """Extend the travel `before` by positions; None without either."""
        place = np.array(position_m).reshape(-1, 3)
        if before is not None:
            place = np.vstack([before.first_m, before.low_m, before.high_m, place])
        return cls(place[0], place.min(axis=0), place.max(axis=0)) if len(place) else None

    def shifts(self, axes: Sequence[int], scales: Float64, place_m: Float64) -> Float64:
        """Compute by how much (F, 3) encoders with these scales (S,) on some axes shift positions (F, 3)."""
        shift = np.zeros_like(place_m)
        shift[:, list(axes)] = scales * (place_m - self.first_m)[:, list(axes)]
        return shift


@dataclass(frozen=True, eq=False)
class Scales:
    """Values (S,) of the encoders' scales, as ratios, and their covariance (S, S)."""

    value: Float64
    covariance: Float64

    @property
    def sigma(self) -> Float64:
        """Return the standard deviations (S,)."""
        return np.sqrt(np.diag(self.covariance))

    def chosen(self, at: Any) -> Scales:
        """Select some of the scales."""
        return Scales(self.value[at], self.covariance[np.ix_(at, at)])


def widen_positions(covariance: Float64, shift_m: Float64) -> Float64:
    """Add the squares of shifts (..., 3), each as one error along its direction, to the positions' part of
    pose covariances (..., 6, 6).
    """
    wider = covariance.copy()
    wider[..., 3:, 3:] += shift_m[..., :, None] * shift_m[..., None, :]
    return wider
