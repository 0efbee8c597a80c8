"""Define the settings of the simulated crane: its travel, its girder, its passes, its magnet."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import Literal

from barsight.core.settings.values import NOT_NEGATIVE, POSITIVE, SHARE, expect, expect_ranges


@dataclass(frozen=True)
class TravelSettings:
    """Travel of the crane along X."""

    speed_mps: float = 0.6
    """Speed of the bridge between accelerating and braking."""
    acceleration_mps2: float = 0.35
    """Maximum acceleration and deceleration."""
    standstill_s: float = 2.0
    """Time at rest before the start and after the end."""
    overrun_m: float = 0.6
    """Travel beyond each end of the stack."""
    sway_deg: float = 0.15
    """Amplitude of the body's sway."""
    sway_hz: float = 0.4
    """Frequency of the sway."""
    vibration_m: float = 0.00004
    """Amplitude of the body's vibration."""
    vibration_hz: float = 9.0
    """Frequency of the vibration."""
    stops: int = 0
    """Number of stops on the way, at positions drawn from the seed."""
    stop_s: float = 2.0
    """Duration of a stop."""
    trolley_m: float = 0.0
    """Travel of the trolley during the pass."""
    backward: bool = False
    """Make the bridge travel from high X to low X."""
    begin_s: float = 0.0
    """Beginning of the recording, after the simulation's epoch."""
    oscillation_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Amplitudes of the oscillation of bridge, trolley and hoist, which their encoders don't see."""
    oscillation_hz: tuple[float, float, float] = (0.7, 1.1, 1.9)
    """Frequencies of these oscillations."""
    rail_m: float = 0.0
    """Amplitude of the rails' height and straightness errors, which have wavelengths of a few metres."""
    skew_deg: float = 0.0
    """Amplitude of the bridge's skew as it travels."""

    def __post_init__(self) -> None:
        expect_ranges(
            self, "motion.", speed_mps=(0.01, 5), acceleration_mps2=(0.01, 10), standstill_s=(1, 120),
            overrun_m=(0, 5), sway_deg=(0, 5), vibration_m=(0, 0.01), sway_hz=POSITIVE,
            vibration_hz=POSITIVE, oscillation_hz=POSITIVE, stops=(0, 20), stop_s=(0, 600),
            trolley_m=(-20, 20), begin_s=(0, 1e8), oscillation_m=(0, 0.1), rail_m=(0, 0.05), skew_deg=(0, 2),
        )  # fmt: skip


@dataclass(frozen=True)
class GirderSettings:
    """Bending of girder and rails, and skew of the girder, none of which the encoders see."""

    deflection_m: float = 0.0
    """Deflection of the girder with the trolley at its centre; a parabola that is 0 at the girder's ends."""
    ends_y_m: tuple[float, float] = (-10.0, 10.0)
    """The crane point's Y with the trolley at each end of the girder."""
    skew_mm_per_m: float = 0.0
    """Deviation of the girder from square to the rails: shift along X per metre of trolley travel."""
    rail_m: float = 0.0
    """Sag of the rails at their centre relative to their ends; a parabola."""
    rail_ends_x_m: tuple[float, float] = (-10.0, 30.0)
    """The crane point's X with the bridge at each end of the rails."""

    def __post_init__(self) -> None:
        expect_ranges(
            self, "girder.", deflection_m=(-0.1, 0.1), skew_mm_per_m=(-10, 10), rail_m=(-0.1, 0.1),
            ends_y_m=(-200, 200), rail_ends_x_m=(-1000, 1000),
        )  # fmt: skip
        spans = [high - low for low, high in (self.ends_y_m, self.rail_ends_x_m)]
        expect(
            min(spans) >= 1, "girder.ends_y_m and rail_ends_x_m must be 1 m or more apart, the lower first"
        )


@dataclass(frozen=True)
class PassesSettings:
    """Several passes over one yard, in chronological order; OUT then holds a recording of each: pass_1,
    pass_2.
    """

    trolley_y_m: tuple[float, ...] = ()
    """Position of the body across the travel in each pass; with none OUT is a single recording."""
    alternate: bool = True
    """Reverse every second pass, so that it travels from high X to low X."""
    pause_s: float = 120.0
    """Time from the end of one pass to the beginning of the next."""
    changes: tuple[Literal["taken", "added", "moved"], ...] = ()
    """Changes before the last pass, each to one bundle on top: it is taken away, is added only then, or is
    moved half a metre along its axis.
    """

    def __post_init__(self) -> None:
        expect_ranges(self, "passes.", trolley_y_m=(-50, 50), pause_s=(0, 1e6))
        expect(not self.changes or len(self.trolley_y_m) > 1, "passes.changes needs two passes or more")


@dataclass(frozen=True)
class MagnetSettings:
    """A magnet's plate that hangs from the crane into the images during part of the travel."""

    size_m: tuple[float, float] = (0.0, 0.0)
    """Size of the plate along the travel and across; 0 0 leaves it out."""
    below_body_m: float = 3.0
    """Distance of the plate below the body."""
    offset_m: tuple[float, float] = (0.6, 0.3)
    """Offset of the plate's centre from the body, along the travel and across."""
    first_ratio: float = 0.3
    """Share of the frames after which the plate appears."""
    last_ratio: float = 0.6
    """Share of the frames after which the plate disappears."""

    def __post_init__(self) -> None:
        expect_ranges(
            self, "magnet.", size_m=NOT_NEGATIVE, below_body_m=(0.2, inf), first_ratio=SHARE, last_ratio=SHARE
        )
        expect(self.first_ratio <= self.last_ratio, "magnet.first_ratio can't be over magnet.last_ratio")
