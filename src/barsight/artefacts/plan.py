"""Define the plan of an acceptance: artefacts with their calibrated values, and the error limits."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, fields, is_dataclass
from math import inf
from pathlib import Path
from typing import Any

from barsight.core.errors import ConfigError
from barsight.core.settings.file import read_settings
from barsight.core.settings.values import NOT_NEGATIVE, POSITIVE, expect_ranges, expect_values

HELP = "docs/how-to/accept.md says how a plan is written"


@dataclass(frozen=True)
class Plate:
    """A level plate. x_m, y_m, z_m: centre of its top in the yard. size_m: its sides, the first along X where
    yaw_deg is 0. sigma_m: of its calibrated height; flatness_sigma_m: of its flatness error, which is taken
    as 0.
    """

    name: str
    x_m: float
    y_m: float
    z_m: float
    size_m: tuple[float, float]
    yaw_deg: float = 0.0
    sigma_m: float = 0.0005
    flatness_sigma_m: float = 0.0002

    def __post_init__(self) -> None:
        expect_ranges(
            self, "plate.", size_m=(0.2, 10), sigma_m=NOT_NEGATIVE, flatness_sigma_m=NOT_NEGATIVE,
            z_m=(-1, 20),
        )  # fmt: skip


@dataclass(frozen=True)
class Sphere:
    """A matt sphere. x_m, y_m, z_m: its centre in the yard. place_sigma_m: sigma of each coordinate of a
    surveyed sphere, such as a monument; without it, the place only says where to look. diameter_sigma_m: of
    the calibrated diameter. probing: judge its form and size too, which takes a diameter of at least a tenth
    of the field of view.
    """

    name: str
    x_m: float
    y_m: float
    z_m: float
    diameter_m: float
    diameter_sigma_m: float = 0.0001
    place_sigma_m: float | None = None
    probing: bool = False

    def __post_init__(self) -> None:
        expect_ranges(self, "sphere.", diameter_m=(0.05, 2), diameter_sigma_m=NOT_NEGATIVE, z_m=(-1, 20))
        if self.place_sigma_m is not None:
            expect_ranges(self, "sphere.", place_sigma_m=NOT_NEGATIVE)


@dataclass(frozen=True)
class SphereBar:
    """Two spheres, by name, with a calibrated distance (m) between their centres."""

    name: str
    spheres: tuple[str, str]
    length_m: float
    sigma_m: float = 0.0002

    def __post_init__(self) -> None:
        expect_ranges(self, "sphere_bar.", length_m=(0.1, 100), sigma_m=NOT_NEGATIVE)


@dataclass(frozen=True)
class HeightStep:
    """Two plates, by name, with the height (m) of the upper one's top above the lower one's."""

    name: str
    lower: str
    upper: str
    height_m: float
    sigma_m: float = 0.0002

    def __post_init__(self) -> None:
        expect_ranges(self, "step.", height_m=(0.01, 20), sigma_m=NOT_NEGATIVE)


@dataclass(frozen=True)
class DummyBundle:
    """A strapped bundle that was measured by hand. x_m, y_m: middle of its axis. yaw_deg: from +Y, as for
    bundles. width_m: diameter of the circle around all bars. top_z_m: height of its highest line. sigma_m: of
    each length.

    bars, bar_diameter_m: of a hexagonal packing. mass_kg: leave it out if the bundle wasn't weighed; the mass
    is then not judged.
    """

    name: str
    x_m: float
    y_m: float
    yaw_deg: float
    length_m: float
    width_m: float
    top_z_m: float
    bars: int
    bar_diameter_m: float
    mass_kg: float | None = None
    sigma_m: float = 0.001
    yaw_sigma_deg: float = 0.02
    mass_sigma_kg: float = 1.0

    def __post_init__(self) -> None:
        expect_ranges(
            self, "dummy_bundle.", length_m=(0.5, 30), width_m=(0.02, 3), top_z_m=(0, 20), mass_kg=POSITIVE,
            bars=(1, 1000), bar_diameter_m=(0.005, 1), sigma_m=NOT_NEGATIVE, yaw_sigma_deg=NOT_NEGATIVE,
            mass_sigma_kg=NOT_NEGATIVE,
        )  # fmt: skip


@dataclass(frozen=True)
class TouchDown:
    """A touch-down of the magnet on an artefact, over the centre of a plate or the middle of a dummy bundle's
    axis. x_m, y_m, z_m: centre of the magnet's faces according to the crane's own readings. sigma_m: of each.
    yaw_deg: of the magnet's beam, from +Y, as for bundles.

    A sphere is touched at its highest point.
    """

    name: str
    on: str
    x_m: float
    y_m: float
    z_m: float
    sigma_m: float = 0.002
    yaw_deg: float = 0.0

    def __post_init__(self) -> None:
        expect_ranges(self, "touch_down.", sigma_m=NOT_NEGATIVE, yaw_deg=(-360, 360))

    @property
    def digest(self) -> str:
        """Form a digest of the crane's readings, by which this touch-down is known again in another plan."""
        readings = (self.x_m, self.y_m, self.z_m, self.yaw_deg % 360)
        return hashlib.sha256(" ".join(f"{value:.4f}" for value in readings).encode()).hexdigest()[:16]


@dataclass(frozen=True)
class ErrorLimits:
    """Maximum permissible errors (MPE), in either direction, by the names that the certificate uses."""

    height_mm: float = 5.0
    """Error of the heights of plates and surveyed spheres."""
    position_mm: float = 5.0
    """Error of X and Y of surveyed spheres."""
    length_mm: float = 5.0
    """Error of the distances between spheres."""
    step_mm: float = 4.0
    """Error of the height steps between plates."""
    flatness_mm: float = 8.0
    """Flatness of a plate: span of its heights about its plane, over 95 % of the cells."""
    form_mm: float = 12.0
    """Form of a sphere (probing error): span of its radii, over 95 % of the cells."""
    size_mm: float = 6.0
    """Error of a sphere's diameter (probing error of size)."""
    lift_mm: float = 10.0
    """Error of a dummy bundle's lift point: its height and its position across the axis."""
    lift_along_mm: float = 50.0
    """Error of a dummy bundle's lift point along the axis. Ends are measured less accurately than flanks."""
    yaw_deg: float = 0.5
    """Error of a dummy bundle's yaw."""
    width_mm: float = 20.0
    """Error of a dummy bundle's width."""
    bundle_length_mm: float = 30.0
    """Error of a dummy bundle's length."""
    mass_pct: float = 20.0
    """Error of a dummy bundle's mass, in percent."""
    touch_mm: float = 10.0
    """Error of X, Y and Z between camera and magnet, from touch-downs."""
    repeat_mm: float = 4.0
    """Repeatability: twice the standard deviation of lengths over the recordings."""
    laser_mm: float = 5.0
    """Margin within which vision and laser must be equivalent (TOST)."""
    dirt_pct: float = 1.0
    """Percentage of a camera's picture that dirt or drops may spoil."""

    def __post_init__(self) -> None:
        expect_ranges(self, "limits.", **{one.name: POSITIVE for one in fields(self)})


@dataclass(frozen=True)
class AmbientConditions:
    """Conditions of the whole test. temperature_c, temperature_sigma_c: temperature of the artefacts and its
    sigma. expansion_per_k: their thermal expansion; calibrated values refer to 20 degrees.
    degrees_of_freedom: of the artefacts' sigmas.
    """

    temperature_c: float = 20.0
    temperature_sigma_c: float = 1.0
    expansion_per_k: float = 11.5e-6
    degrees_of_freedom: float = 50.0
    search_m: float = 0.25
    """Radius, in metres, around its planned place within which an artefact is searched for."""

    def __post_init__(self) -> None:
        expect_ranges(
            self, "conditions.", temperature_c=(-40, 80), temperature_sigma_c=(0, 40),
            expansion_per_k=(0, 1e-3), degrees_of_freedom=(1, inf), search_m=(0.02, 2),
        )  # fmt: skip

    @property
    def expansion(self) -> float:
        """Return the ratio of an artefact's length to its calibrated length: 1 + expansion_per_k (T - 20)."""
        return 1 + self.expansion_per_k * (self.temperature_c - 20)


Artefact = Plate | Sphere | DummyBundle


@dataclass(frozen=True)
class AcceptancePlan:
    """The artefacts, their places, and the limits. yard: name of the yard or crane that the plan is for."""

    yard: str = ""
    plate: tuple[Plate, ...] = ()
    sphere: tuple[Sphere, ...] = ()
    sphere_bar: tuple[SphereBar, ...] = ()
    step: tuple[HeightStep, ...] = ()
    dummy_bundle: tuple[DummyBundle, ...] = ()
    touch_down: tuple[TouchDown, ...] = ()
    limits: ErrorLimits = ErrorLimits()
    conditions: AmbientConditions = AmbientConditions()

    def __post_init__(self) -> None:
        expect_values(self)
        names = [one.name for kind in self.kinds() for one in kind]
        twice = next((name for name, count in Counter(names).items() if count > 1), None)
        if twice is not None:
            raise ConfigError(f"plan: {twice!r} is there twice")
        if not self.artefacts:
            raise ConfigError("plan: names no plate, sphere or dummy_bundle")
        for bar in self.sphere_bar:
            self._expect_known(bar.name, bar.spheres, self.sphere)
        for step in self.step:
            self._expect_known(step.name, (step.lower, step.upper), self.plate)
        for touch in self.touch_down:
            self._expect_known(touch.name, (touch.on,), self.artefacts)
        read = {(one.on, one.x_m, one.y_m, one.z_m, one.yaw_deg): one.name for one in self.touch_down}
        again = next((one for one in self.touch_down if one.name not in read.values()), None)
        if again is not None:
            problem = f"{again.name} has the readings of another touch-down on {again.on}"
            raise ConfigError(f"plan: {problem}; list each touch-down once")

    def kinds(
        self,
    ) -> tuple[tuple[Plate | Sphere | SphereBar | HeightStep | DummyBundle | TouchDown, ...], ...]:
        """Return all named entries, grouped by kind."""
        return self.plate, self.sphere, self.sphere_bar, self.step, self.dummy_bundle, self.touch_down

    @property
    def artefacts(self) -> tuple[Artefact, ...]:
        """Return the artefacts that stand in the yard."""
        return (*self.plate, *self.sphere, *self.dummy_bundle)

    def _expect_known(self, name: str, wanted: tuple[str, ...], kind: Iterable[Artefact]) -> None:
        known = {one.name for one in kind}
        lost = next((one for one in wanted if one not in known), None)
        if lost is not None:
            raise ConfigError(f"plan: {name} names {lost!r}, which isn't among {', '.join(sorted(known))}")


def read_plan(path: Path) -> AcceptancePlan:
    """Read a plan (TOML). Raises InputError where it can't be read and ConfigError where it is invalid."""
    return read_settings(path, AcceptancePlan, HELP, "plan")


def plan_text(plan: AcceptancePlan) -> str:
    """Write a plan as TOML from which `read_plan` reads the same plan."""
    lines = [f"yard = {json.dumps(plan.yard)}", ""]
    for one in fields(plan):
        value = getattr(plan, one.name)
        if is_dataclass(value):
            lines += [f"[{one.name}]", *_settings(value), ""]
        elif isinstance(value, tuple):
            for item in value:
                lines += [f"[[{one.name}]]", *_settings(item), ""]
    return "\n".join(lines)


def _settings(record: Any) -> list[str]:
    """Write the fields that are set; numbers, texts and lists look the same in TOML as in JSON."""
    values = {one.name: getattr(record, one.name) for one in fields(record)}
    return [f"{name} = {json.dumps(value)}" for name, value in values.items() if value is not None]
