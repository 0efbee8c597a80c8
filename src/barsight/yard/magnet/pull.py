"""Describe a magnet's pull as a data sheet does: by air gap, thickness, round load, grade, heat, duty."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np

from barsight.core.arrays import Float64, frozen
from barsight.core.errors import ConfigError

SATURATED_TESLA = 1.6
"""Flux density above which bars let little more through; the maximum if the file lists no plates."""
MAX_GAP_M = 0.5
"""Maximum air gap (m) of a lifting magnet; a larger one was given in another unit, and nothing would limit
the gap.
"""
_MU0 = 4e-7 * math.pi
_ACROSS = 201
"""Number of places across a face at which the pull on one round bar is summed."""


@dataclass(frozen=True)
class ThinPlate:
    """Pull per area on a flat plate of this thickness, at each of `Pull.gap_m`."""

    thickness_m: float
    kilopascal: tuple[float, ...]

    def __post_init__(self) -> None:
        expect(0 < self.thickness_m <= 1, "pull thin thickness_m lies between 0 and 1")
        expect(_falls(self.kilopascal), "pull thin kilopascal must fall with the gap and end at 0")


@dataclass(frozen=True)
class Pull:
    """Pull per area of pole at each air gap; linear between, 0 at the last and beyond.

    thickness_m: of the flat plate on which it was measured, None where the data sheet doesn't give it. thin:
    the same for thinner plates. round_diameter_m, round_ratio: ratio of the pull on one round bar in the
    middle of a face to that on a thick plate. grade_ratio, heat_ratio, duty_ratio: fractions that the steel's
    grade, the magnet's heat and its duty leave; the defaults are low (docs/how-to/describe-a-magnet.md
    explains why).
    """

    gap_m: tuple[float, ...]
    kilopascal: tuple[float, ...]
    thickness_m: float | None = None
    thin: tuple[ThinPlate, ...] = ()
    round_diameter_m: tuple[float, ...] = ()
    round_ratio: tuple[float, ...] = ()
    grade_ratio: float = 0.7
    heat_ratio: float = 0.5
    duty_ratio: float = 0.7

    def __post_init__(self) -> None:
        same = len(self.gap_m) == len(self.kilopascal) >= 2
        expect(same, "pull gap_m and kilopascal must be lists of the same length, two or more")
        expect(self.gap_m[0] == 0 and _rises(self.gap_m), "pull gap_m must begin at 0 and rise")
        expect(self.gap_m[-1] <= MAX_GAP_M, f"pull gap_m is in m, at most {MAX_GAP_M:g}")
        expect(_falls(self.kilopascal), "pull kilopascal must fall with the gap and end at 0")
        expect(0 < self.kilopascal[0] <= 4000, "pull kilopascal must lie between 0 and 4000 without a gap")
        ratios = (*self.round_ratio, self.grade_ratio, self.heat_ratio, self.duty_ratio)
        expect(all(0 < ratio <= 1 for ratio in ratios), "pull's ratios must be over 0, at most 1")
        same = len(self.round_diameter_m) == len(self.round_ratio)
        expect(same, "pull round_diameter_m and round_ratio must be lists of the same length")
        grows = all(b >= a for a, b in pairwise(self.round_ratio))
        expect(grows, "pull round_ratio can't fall as round_diameter_m rises")
        within = all(0.005 <= diameter <= 1 for diameter in self.round_diameter_m)
        expect(within and _rises(self.round_diameter_m), "pull round_diameter_m must rise from 0.005 to 1")
        self._check_plates()

    def _check_plates(self) -> None:
        expect(self.thickness_m is None or 0 < self.thickness_m <= 1, "pull thickness_m lies in 0 ... 1")
        if not self.thin:
            return
        expect(
            self.thickness_m is not None, "pull thickness_m is missing: plates in thin are thinner than it"
        )
        plates = (*self.thin, ThinPlate(self.thickness_m or 1.0, self.kilopascal))
        expect(_rises(tuple(plate.thickness_m for plate in plates)), "pull thin must rise up to thickness_m")
        expect(all(len(plate.kilopascal) == len(self.gap_m) for plate in plates),
               "pull thin kilopascal must have a figure for each gap_m")  # fmt: skip
        expect(all(np.all(np.diff([a.kilopascal, b.kilopascal], axis=0) >= 0) for a, b in pairwise(plates)),
               "pull of a thinner plate can't be more than that of a thicker one")  # fmt: skip

    def on_plate(self, thickness_m: float, face_m: float) -> Float64:
        """Compute kPa at each of `gap_m` on a flat plate, including the ratios of grade, heat and duty.

        Below the thinnest plate the pull falls with the square of the flux that passes. Where no plate's
        thickness is given, the flux of a face `face_m` wide leaves on both sides at SATURATED_TESLA.
        """
        thick = np.array(self.kilopascal) * self.grade_ratio * self.heat_ratio * self.duty_ratio
        if self.thickness_m is None:
            needed_tesla = math.sqrt(2e3 * _MU0 * self.kilopascal[0])
            passes = min(2 * thickness_m * SATURATED_TESLA / face_m / needed_tesla, 1.0) ** 2
            return np.asarray(thick * passes)
        plates = np.array([plate.thickness_m for plate in self.thin] + [self.thickness_m])
        curves = np.array([plate.kilopascal for plate in self.thin] + [self.kilopascal])
        passes = min(thickness_m / plates[0], 1.0) ** 2
        found = np.array([np.interp(thickness_m, plates, curve) for curve in curves.T])
        return np.asarray(thick / np.maximum(self.kilopascal, 1e-9) * found * passes)

    def on_bars(self, diameter_m: float, face_m: float) -> tuple[Float64, Float64]:
        """Compute kPa at each of `gap_m` over round bars, and its lower bound.

        Bars offer the cross-section of a plate pi/4 times as thick as they are. Where the maker rates round
        bars, the rating of one bar holds; the lower bound uses it only where it is less than the sum over the
        face.
        """
        return _on_bars(self, diameter_m, face_m)


@lru_cache(maxsize=1024)
def _on_bars(pull: Pull, diameter_m: float, face_m: float) -> tuple[Float64, Float64]:
    likely = pull.on_plate(math.pi / 4 * diameter_m, face_m)
    if not pull.round_diameter_m:
        return frozen(likely), frozen(likely)
    rated = float(np.interp(diameter_m, pull.round_diameter_m, pull.round_ratio))
    rated *= min(diameter_m / pull.round_diameter_m[0], 1.0)
    thick = pull.on_plate(pull.thickness_m or 1.0, face_m)
    summed = float(np.interp(_falls_off(diameter_m, face_m), pull.gap_m, likely).mean())
    ratio = rated * thick[0] / max(summed, 1e-9)
    return frozen(likely * ratio), frozen(likely * min(ratio, 1.0))


@lru_cache(maxsize=256)
def _falls_off(diameter_m: float, face_m: float) -> Float64:
    """Compute the air gaps (N,) between a face and one round bar under its middle; inf beside the bar."""
    u = face_m * ((np.arange(_ACROSS) + 0.5) / _ACROSS - 0.5)
    inside = (diameter_m / 2) ** 2 - u**2
    return frozen(np.where(inside > 0, diameter_m / 2 - np.sqrt(np.maximum(inside, 0)), np.inf))


def expect(holds: bool, sentence: str) -> None:
    """Raise ConfigError with a sentence about the magnet unless a condition holds."""
    if not holds:
        raise ConfigError(f"magnet: {sentence}")


def _rises(figures: tuple[float, ...]) -> bool:
    return all(b > a for a, b in pairwise(figures))


def _falls(figures: tuple[float, ...]) -> bool:
    return len(figures) > 1 and all(b <= a for a, b in pairwise(figures)) and figures[-1] == 0
