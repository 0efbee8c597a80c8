"""Load the magnet's description: poles, beam, pull against air gap, limits, the crane's tolerance."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from importlib import resources
from pathlib import Path

import numpy as np

from barsight.core.arrays import Float64
from barsight.core.errors import ConfigError
from barsight.core.settings.file import read_settings
from barsight.core.settings.numbers import expect_numbers

_EXAMPLE = resources.files("barsight.yard.lifting").joinpath("example_magnet.toml")


@dataclass(frozen=True)
class Pole:
    """A pole's face: its centre from the magnet's, along the beam and across it, and its size."""

    along_m: float
    across_m: float
    length_m: float
    width_m: float

    def __post_init__(self) -> None:
        _expect(min(self.length_m, self.width_m) >= 0.01, "a pole must be at least 10 mm long and wide")
        _expect(max(self.length_m, self.width_m) <= 10, "a pole can't be longer than 10 m")
        _expect(max(abs(self.along_m), abs(self.across_m)) <= 20, "a pole lies within 20 m of the centre")


@dataclass(frozen=True)
class Beam:
    """Beam above the faces: length along, width across, height of its underside over the faces."""

    length_m: float
    width_m: float
    above_faces_m: float

    def __post_init__(self) -> None:
        _expect(min(self.length_m, self.width_m) > 0, "the beam's length and width must be over 0")
        _expect(self.above_faces_m >= 0, "the beam can't hang below the poles' faces")


@dataclass(frozen=True)
class Pull:
    """Pull per area of pole at each air gap; linear between, 0 at the last and beyond."""

    gap_m: tuple[float, ...]
    kilopascal: tuple[float, ...]

    def __post_init__(self) -> None:
        same = len(self.gap_m) == len(self.kilopascal) >= 2
        _expect(same, "pull gap_m and kilopascal must be lists of the same length, two or more")
        rising = all(b > a for a, b in zip(self.gap_m, self.gap_m[1:], strict=False))
        _expect(self.gap_m[0] == 0 and rising, "pull gap_m must begin at 0 and rise")
        falling = all(b <= a for a, b in zip(self.kilopascal, self.kilopascal[1:], strict=False))
        _expect(falling and self.kilopascal[-1] == 0, "pull kilopascal must fall with the gap and end at 0")
        _expect(0 < self.kilopascal[0] <= 4000, "pull kilopascal must lie between 0 and 4000 without a gap")


@dataclass(frozen=True)
class Tolerance:
    """Accuracy of the crane when it sets the magnet down, to either side, in yard axes."""

    x_m: float
    y_m: float
    yaw_deg: float

    def __post_init__(self) -> None:
        within = min(self.x_m, self.y_m) >= 0 and max(self.x_m, self.y_m) <= 1 and 0 <= self.yaw_deg <= 20
        _expect(within, "tolerance x_m and y_m lie between 0 and 1, yaw_deg between 0 and 20")


@dataclass(frozen=True)
class Limits:
    """Limits of a lift with the magnet; docs/how-to/describe-a-magnet.md explains each."""

    pitch_deg: float
    roll_deg: float
    offset_along_m: float
    offset_across_m: float
    overhang_m: float
    gap_m: float
    contact_share: float

    def __post_init__(self) -> None:
        angles = min(self.pitch_deg, self.roll_deg) > 0 and max(self.pitch_deg, self.roll_deg) <= 45
        _expect(angles, "limits pitch_deg and roll_deg lie between 0 and 45")
        lengths = min(self.offset_along_m, self.offset_across_m, self.overhang_m, self.gap_m)
        _expect(lengths > 0, "limits offset_along_m, offset_across_m, overhang_m and gap_m must be over 0")
        _expect(0 <= self.contact_share < 1, "limits contact_share lies between 0 and 1")


@dataclass(frozen=True)
class Magnet:
    """A magnet, or several on a beam whose faces lie in one plane. Masses in kg."""

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

    def __post_init__(self) -> None:
        expect_numbers(asdict(self))
        _expect(len(self.poles) >= 1, "there must be at least one pole")
        _expect(min(self.own_mass_kg, self.capacity_kg) > 0, "own_mass_kg and capacity_kg must be over 0")
        _expect(
            self.crane_capacity_kg > self.own_mass_kg,
            f"crane_capacity_kg {self.crane_capacity_kg:g} leaves nothing beside own_mass_kg "
            f"{self.own_mass_kg:g}",
        )
        _expect(2 <= self.safety_factor <= 20, "safety_factor lies between 2 and 20")

    @property
    def reach_m(self) -> float:
        """Return the air gap from which on nothing is lifted."""
        return self.pull.gap_m[-1]

    @property
    def pole_table(self) -> Float64:
        """Return along, across, length, width (P, 4)."""
        return np.array([(p.along_m, p.across_m, p.length_m, p.width_m) for p in self.poles])

    @property
    def half_span_m(self) -> float:
        """Return the way from the centre to the outermost pole's outer edge, along the beam."""
        return max(abs(p.along_m) + p.length_m / 2 for p in self.poles)


def example_magnet() -> str:
    """Return the package's documented example, as TOML."""
    return _EXAMPLE.read_text("utf-8")


def load_magnet(path: Path | None) -> Magnet:
    """Load the magnet of a TOML file; the package's documented example where there is none.

    Raises InputError for a file that can't be read, ConfigError for a value that can't be.
    """
    help_at = "docs/how-to/describe-a-magnet.md says how"
    if path is not None:
        return read_settings(path, Magnet, help_at, "--magnet")
    with resources.as_file(_EXAMPLE) as example:
        return read_settings(example, Magnet, help_at, "--magnet")


def _expect(holds: bool, sentence: str) -> None:
    if not holds:
        raise ConfigError(f"magnet: {sentence}")
