"""Define the plan of an acceptance: artefacts with their calibrated values, and what errors may be."""

from __future__ import annotations

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
    """A level plate. x_m, y_m, z_m: middle of its top in the yard. size_m: its sides, the first along X where
    yaw_deg is 0. sigma_m: of its calibrated height; flatness_sigma_m: of its flatness, which is taken as 0.
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
    """A matt sphere. x_m, y_m, z_m: its centre in the yard. place_sigma_m: of each coordinate where it was
    surveyed, as a monument is; without it the place only says where to look. diameter_sigma_m: of the
    calibrated diameter. probing: judge its form and size too; wants a diameter of a tenth of the field of
    view or more.
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
    """Two spheres, by name, at a calibrated distance between their centres, m."""

    name: str
    spheres: tuple[str, str]
    length_m: float
    sigma_m: float = 0.0002

    def __post_init__(self) -> None:
        expect_ranges(self, "sphere_bar.", length_m=(0.1, 100), sigma_m=NOT_NEGATIVE)


@dataclass(frozen=True)
class HeightStep:
    """Two plates, by name, and how much the upper one's top lies above the lower one's, m."""

    name: str
    lower: str
    upper: str
    height_m: float
    sigma_m: float = 0.0002

    def __post_init__(self) -> None:
        expect_ranges(self, "step.", height_m=(0.01, 20), sigma_m=NOT_NEGATIVE)


@dataclass(frozen=True)
class DummyBundle:
    """A strapped bundle that was measured by hand. x_m, y_m: middle of its axis; yaw_deg: from +Y, as
    bundles have it; width_m: circle around all bars; top_z_m: its highest line. sigma_m: of each length.

    bars and bar_diameter_m: of a hexagonal packing. mass_kg: isn't judged where nobody weighed it.
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
    """The magnet stood on an artefact: x_m, y_m, z_m of its faces' middle as the crane's own readings have it
    then, over the middle of a plate, or the axis' middle of a dummy bundle. sigma_m: of each.

    For a sphere it touched the highest point.
    """

    name: str
    on: str
    x_m: float
    y_m: float
    z_m: float
    sigma_m: float = 0.002

    def __post_init__(self) -> None:
        expect_ranges(self, "touch_down.", sigma_m=NOT_NEGATIVE)


@dataclass(frozen=True)
class ErrorLimits:
    """Largest errors that are accepted (MPE), either side; each as the certificate names it."""

    height_mm: float = 5.0
    """Heights of plates and surveyed spheres."""
    position_mm: float = 5.0
    """X and Y of surveyed spheres."""
    length_mm: float = 5.0
    """Distances between spheres."""
    step_mm: float = 4.0
    """Steps between plates."""
    flatness_mm: float = 8.0
    """Span of a plate's heights about its plane, 95 % of the cells."""
    form_mm: float = 12.0
    """Span of a sphere's radii, 95 % of the cells (probing error, form)."""
    size_mm: float = 6.0
    """Diameter of a sphere (probing error, size)."""
    lift_mm: float = 10.0
    """Place of a dummy bundle across its axis, and its height, as a lift would take it."""
    lift_along_mm: float = 50.0
    """Place of a dummy bundle along its axis: ends are seen less well than flanks."""
    yaw_deg: float = 0.5
    """Yaw of a dummy bundle."""
    width_mm: float = 20.0
    """Width of a dummy bundle."""
    bundle_length_mm: float = 30.0
    """Length of a dummy bundle."""
    mass_pct: float = 20.0
    """Mass of a dummy bundle."""
    touch_mm: float = 10.0
    """X, Y and Z between camera and magnet."""
    repeat_mm: float = 4.0
    """Twice the standard deviation of a length over the recordings."""
    laser_mm: float = 5.0
    """Margin within which vision and laser must be equivalent (TOST)."""
    dirt_pct: float = 1.0
    """Share of a camera's picture that dirt or drops may spoil."""

    def __post_init__(self) -> None:
        expect_ranges(self, "limits.", **{one.name: POSITIVE for one in fields(self)})


@dataclass(frozen=True)
class AmbientConditions:
    """Conditions of the whole test. temperature_c: of the artefacts; sigma of it; expansion_per_k: of what
    they are made of. Calibrated values are of 20 degrees. degrees_of_freedom: of the artefacts' sigmas.
    """

    temperature_c: float = 20.0
    temperature_sigma_c: float = 1.0
    expansion_per_k: float = 11.5e-6
    degrees_of_freedom: float = 50.0
    search_m: float = 0.25
    """Radius about its planned place in which an artefact is sought."""

    def __post_init__(self) -> None:
        expect_ranges(
            self, "conditions.", temperature_c=(-40, 80), temperature_sigma_c=(0, 40),
            expansion_per_k=(0, 1e-3), degrees_of_freedom=(1, inf), search_m=(0.02, 2),
        )  # fmt: skip

    @property
    def expansion(self) -> float:
        """Return an artefact's length over its calibrated one: 1 + expansion_per_k (T - 20)."""
        return 1 + self.expansion_per_k * (self.temperature_c - 20)


Artefact = Plate | Sphere | DummyBundle


@dataclass(frozen=True)
class AcceptancePlan:
    """Artefacts, where they stand, and the limits. yard: which yard or crane it is for."""

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

    def kinds(
        self,
    ) -> tuple[tuple[Plate | Sphere | SphereBar | HeightStep | DummyBundle | TouchDown, ...], ...]:
        """Return all that is named, kind by kind."""
        return self.plate, self.sphere, self.sphere_bar, self.step, self.dummy_bundle, self.touch_down

    @property
    def artefacts(self) -> tuple[Artefact, ...]:
        """Return what stands in the yard."""
        return (*self.plate, *self.sphere, *self.dummy_bundle)

    def _expect_known(self, name: str, wanted: tuple[str, ...], kind: Iterable[Artefact]) -> None:
        known = {one.name for one in kind}
        lost = next((one for one in wanted if one not in known), None)
        if lost is not None:
            raise ConfigError(f"plan: {name} names {lost!r}, which isn't among {', '.join(sorted(known))}")


def read_plan(path: Path) -> AcceptancePlan:
    """Read a plan (TOML). Raises InputError where it can't be read and ConfigError for what can't be."""
    return read_settings(path, AcceptancePlan, HELP, "plan")


def plan_text(plan: AcceptancePlan) -> str:
    """Write a plan as TOML that `read_plan` reads to the same."""
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
    """Write the fields that are given; numbers, texts and lists look in TOML as in JSON."""
    values = {one.name: getattr(record, one.name) for one in fields(record)}
    return [f"{name} = {json.dumps(value)}" for name, value in values.items() if value is not None]
