"""Load the magnet's description: poles, beam, pull by air gap, limits, the crane's tolerance."""

from __future__ import annotations

import math
from dataclasses import dataclass
from importlib import resources
from itertools import combinations
from pathlib import Path
from typing import Literal

import numpy as np

from barsight.core.arrays import Float64
from barsight.core.settings.file import read_settings
from barsight.core.settings.values import expect_values
from barsight.yard.axes import axes_of
from barsight.yard.magnet.pull import MAX_GAP_M, Pull, expect

MagnetType = Literal["electro", "permanent", "electro-permanent"]
MIN_SAFETY_FACTOR = 3.0
"""Minimum safety factor of permanent, electro-permanent and unknown types of magnet [EN 13155]."""
MIN_SAFETY_FACTOR_BACKED = 2.0
"""Minimum safety factor of an electromagnet that a battery backs up when the mains fail [EN 13155]."""
MAX_REACH_RATIO = 2.0
"""Maximum air gap with a pull, in widths of the widest face: the field ends there; a larger one is in cm."""
MIN_OWN_RATIO = 0.005
"""Minimum mass of a magnet, as a fraction of what it may carry; with less, the mass is in tonnes."""
MAX_OFFSET_M = 0.2
"""Maximum offset (m): a larger one isn't how the magnet hangs, but a wrong lever arm of the rig."""
MAX_TURN_DEG = 10.0
"""Maximum angle (degrees) of a lift's yaw to that of the touch-downs, where all of them have one."""
UNKNOWN_TURN_M = 0.02
"""Sigma (m) of the part of an offset that turns with the beam, where that part isn't known."""
_EXAMPLE = resources.files("barsight.yard.magnet").joinpath("example_magnet.toml")


@dataclass(frozen=True)
class Pole:
    """A pole's face: its centre relative to the magnet's, along the beam and across it, and its size."""

    along_m: float
    across_m: float
    length_m: float
    width_m: float

    def __post_init__(self) -> None:
        expect(min(self.length_m, self.width_m) >= 0.01, "a pole must be at least 10 mm long and wide")
        expect(max(self.length_m, self.width_m) <= 10, "a pole can't be longer than 10 m")
        expect(max(abs(self.along_m), abs(self.across_m)) <= 20, "a pole lies within 20 m of the centre")

    def is_beside(self, other: Pole) -> bool:
        """Check that another pole's face doesn't overlap this one's, or both would count as pulling there."""
        along = abs(self.along_m - other.along_m) - (self.length_m + other.length_m) / 2
        across = abs(self.across_m - other.across_m) - (self.width_m + other.width_m) / 2
        return max(along, across) > -1e-6


@dataclass(frozen=True)
class Beam:
    """Beam above the faces: length along, width across, height of its underside over the faces."""

    length_m: float
    width_m: float
    above_faces_m: float

    def __post_init__(self) -> None:
        expect(min(self.length_m, self.width_m) > 0, "the beam's length and width must be over 0")
        expect(max(self.length_m, self.width_m) <= 40, "the beam can't be longer than 40 m")
        expect(self.above_faces_m >= 0, "the beam can't hang below the poles' faces")


@dataclass(frozen=True)
class Tolerance:
    """Accuracy of the crane when it sets the magnet down, to either side, in yard axes."""

    x_m: float
    y_m: float
    yaw_deg: float

    def __post_init__(self) -> None:
        within = min(self.x_m, self.y_m) >= 0 and max(self.x_m, self.y_m) <= 1 and 0 <= self.yaw_deg <= 20
        expect(within, "tolerance x_m and y_m lie between 0 and 1, yaw_deg between 0 and 20")

    def along(self, axes: Float64) -> Float64:
        """Return the maximum error (...), m, along horizontal unit vectors (..., 2), without the yaw's."""
        return np.asarray(np.abs(axes) @ (self.x_m, self.y_m), np.float64)


@dataclass(frozen=True)
class Limits:
    """Limits of a lift with the magnet; docs/how-to/describe-a-magnet.md explains each one."""

    pitch_deg: float
    roll_deg: float
    offset_along_m: float
    offset_across_m: float
    overhang_m: float
    gap_m: float
    contact_share: float

    def __post_init__(self) -> None:
        angles = min(self.pitch_deg, self.roll_deg) > 0 and max(self.pitch_deg, self.roll_deg) <= 45
        expect(angles, "limits pitch_deg and roll_deg lie between 0 and 45")
        lengths = min(self.offset_along_m, self.offset_across_m, self.overhang_m, self.gap_m)
        expect(lengths > 0, "limits offset_along_m, offset_across_m, overhang_m and gap_m must be over 0")
        longest = max(self.offset_along_m, self.offset_across_m, self.overhang_m)
        expect(longest <= 20, "limits offset_along_m, offset_across_m and overhang_m are in m, at most 20")
        expect(self.gap_m <= MAX_GAP_M, f"limits gap_m is in m, at most {MAX_GAP_M:g}")
        expect(0 <= self.contact_share < 1, "limits contact_share lies between 0 and 1")


@dataclass(frozen=True)
class MagnetOffset:
    """Offset of the faces' middle, as the cameras see it, from its place by the crane's readings.

    Mean of touch-downs in yard axes, with the sigma of each mean. calibration_id, yard_frame_id: the rig and
    the frame in which they were made; an offset of another rig or frame forbids every lift.

    along_m, across_m: the part that turns with the beam, in its own axes, in addition to x_m and y_m; known
    where the magnet was turned between the touch-downs, with the sigma turn_sigma_m of each. Without that
    sigma the touch-downs were made at yaw_deg, and the offset holds near it only.

    touch_downs: digest of each of them; they can't verify their own mean.
    """

    x_m: float
    y_m: float
    z_m: float
    x_sigma_m: float
    y_sigma_m: float
    z_sigma_m: float
    calibration_id: str
    yard_frame_id: str
    yaw_deg: float
    along_m: float = 0.0
    across_m: float = 0.0
    turn_sigma_m: float | None = None
    touch_downs: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        most = max(abs(value) for value in (self.x_m, self.y_m, self.z_m, self.along_m, self.across_m))
        names = "x_m, y_m, z_m, along_m and across_m"
        expect(most <= MAX_OFFSET_M, f"offset {names} lie within {MAX_OFFSET_M:g} m")
        sigmas = (self.x_sigma_m, self.y_sigma_m, self.z_sigma_m, self.turn_sigma_m)
        stated = [sigma for sigma in sigmas if sigma is not None]
        expect(min(stated) > 0 and max(stated) <= 0.1, "offset's sigmas lie between 0 and 0.1 m")
        expect(abs(self.yaw_deg) <= 360, "offset yaw_deg lies between -360 and 360")
        is_turned = self.turn_sigma_m is not None or (self.along_m, self.across_m) == (0, 0)
        expect(is_turned, "offset along_m and across_m need turn_sigma_m")

    @property
    def words(self) -> str:
        """Describe the offset with its sigmas in mm, and where it is known."""
        rows = [
            ("x", self.x_m, self.x_sigma_m),
            ("y", self.y_m, self.y_sigma_m),
            ("z", self.z_m, self.z_sigma_m),
        ]
        end = f"at yaw {self.yaw_deg:.1f} deg, within {MAX_TURN_DEG:g} deg of which it is used"
        if self.turn_sigma_m is not None:
            rows += [("along", self.along_m, self.turn_sigma_m), ("across", self.across_m, self.turn_sigma_m)]
            end = "at any yaw, along and across turning with the beam"
        return (
            ", ".join(f"{name} {1e3 * m:+.1f} ± {1e3 * sigma:.1f}" for name, m, sigma in rows) + f" mm {end}"
        )

    def place_m(self, yaw_rad: float) -> Float64:
        """Return the offset along x, y and z (3,) at the beam's yaw."""
        turning = np.array([self.across_m, self.along_m]) @ axes_of(yaw_rad)
        return np.array([self.x_m + turning[0], self.y_m + turning[1], self.z_m])

    def sigma_m(self, yaw_rad: float) -> Float64:
        """Return the offset's sigma along x, y and z (3,) at the beam's yaw.

        Where the part that turns isn't known, it may be as large as the whole offset, or `UNKNOWN_TURN_M`.
        """
        turn_m = self.turn_sigma_m
        if turn_m is None:
            unknown_m = max(UNKNOWN_TURN_M, float(np.hypot(self.x_m, self.y_m)))
            turn_m = 2 * abs(np.sin(np.radians(self.turn_deg(yaw_rad)) / 2)) * unknown_m
        return np.hypot([self.x_sigma_m, self.y_sigma_m, self.z_sigma_m], [turn_m, turn_m, 0.0])

    def turn_deg(self, yaw_rad: float) -> float:
        """Return how far a yaw is from where the offset is known, in degrees."""
        if self.turn_sigma_m is not None:
            return 0.0
        return abs((math.degrees(yaw_rad) - self.yaw_deg + 180) % 360 - 180)

    def beam_yaw(self, yaw_rad: float) -> float:
        """Return the beam's yaw along an axis: of the two, the nearer to where the offset is known."""
        is_near = self.turn_deg(yaw_rad) <= 90
        return yaw_rad if is_near else yaw_rad - math.copysign(math.pi, yaw_rad)


@dataclass(frozen=True)
class Magnet:
    """A magnet, or several on a beam whose faces lie in one plane. Masses in kg.

    type: None where the file doesn't name one, which counts as the worst. battery_backup: it holds the load
    when the mains fail. offset: None where it wasn't measured by touch-downs; `tolerance` must then include
    it.
    """

    name: str
    own_mass_kg: float
    capacity_kg: float
    crane_capacity_kg: float
    safety_factor: float
    poles: tuple[Pole, ...]
    beam: Beam
    pull: Pull
    tolerance: Tolerance
    limits: Limits
    type: MagnetType | None = None
    battery_backup: bool = False
    offset: MagnetOffset | None = None

    def __post_init__(self) -> None:
        expect_values(self)
        expect(len(self.poles) >= 1, "there must be at least one pole")
        for one, other in combinations(self.poles, 2):
            apart = one.is_beside(other)
            expect(apart, f"two poles, at along_m {one.along_m:g} and {other.along_m:g}, lie over each other")
        widest = max(min(pole.length_m, pole.width_m) for pole in self.poles)
        expect(
            self.reach_m <= MAX_REACH_RATIO * widest,
            f"pull gap_m goes to {self.reach_m:g}, further than a face {widest:g} wide pulls: give gaps in m",
        )
        expect(min(self.own_mass_kg, self.capacity_kg) > 0, "own_mass_kg and capacity_kg must be over 0")
        expect(
            self.own_mass_kg >= MIN_OWN_RATIO * self.capacity_kg,
            f"own_mass_kg {self.own_mass_kg:g} is too little for a magnet that carries {self.capacity_kg:g}: "
            "give masses in kg",
        )
        expect(
            self.crane_capacity_kg > self.own_mass_kg,
            f"crane_capacity_kg {self.crane_capacity_kg:g} leaves nothing beside own_mass_kg "
            f"{self.own_mass_kg:g}",
        )
        expect(2 <= self.safety_factor <= 20, "safety_factor lies between 2 and 20")
        kind = f"{self.type} magnet" + (" without battery_backup" if self.type == "electro" else "")
        expect(
            self.type is None or self.safety_factor >= self.min_safety_factor,
            f"safety_factor {self.safety_factor:g} is less than {self.min_safety_factor:g}, the least of "
            f"{'an' if kind[0] == 'e' else 'a'} {kind}",
        )

    @property
    def min_safety_factor(self) -> float:
        """Return the minimum safety factor for the magnet's type."""
        backed = self.type == "electro" and self.battery_backup
        return MIN_SAFETY_FACTOR_BACKED if backed else MIN_SAFETY_FACTOR

    @property
    def needed_factor(self) -> float:
        """Return the safety factor that lifts must meet: at least that of the worst type if none is named."""
        return max(self.safety_factor, self.min_safety_factor)

    @property
    def reach_m(self) -> float:
        """Return the air gap (m) from which on nothing is lifted."""
        return self.pull.gap_m[-1]

    @property
    def pole_table(self) -> Float64:
        """Return along, across, length, width (P, 4)."""
        return np.array([(p.along_m, p.across_m, p.length_m, p.width_m) for p in self.poles])

    @property
    def size_m(self) -> tuple[float, float]:
        """Return width and length (m) of beam and poles together, about the centre."""
        wide = max(abs(p.across_m) + p.width_m / 2 for p in self.poles)
        return max(self.beam.width_m, 2 * wide), max(self.beam.length_m, 2 * self.half_span_m)

    @property
    def half_span_m(self) -> float:
        """Return the distance (m) along the beam from the centre to the outer edge of the outermost pole."""
        return max(abs(p.along_m) + p.length_m / 2 for p in self.poles)


def example_magnet() -> str:
    """Return the package's documented example, as TOML."""
    return _EXAMPLE.read_text("utf-8")


def load_magnet(path: Path | None) -> Magnet:
    """Load the magnet from a TOML file; the package's documented example where no file is given.

    Raises InputError for an unreadable file, ConfigError for an invalid value.
    """
    help_at = "docs/how-to/describe-a-magnet.md says how"
    if path is not None:
        return read_settings(path, Magnet, help_at, "magnet")
    with resources.as_file(_EXAMPLE) as example:
        return read_settings(example, Magnet, help_at, "magnet")
