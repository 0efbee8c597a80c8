"""Define the settings of a whole simulated recording."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated, Literal

import tyro

from barsight.core.settings.values import NOT_NEGATIVE, expect, expect_ranges, expect_values
from barsight.simulation.effects.settings import FaultSettings, LightSettings
from barsight.simulation.settings.rig import CameraSettings, SensorSettings
from barsight.simulation.settings.travel import GirderSettings, MagnetSettings, PassesSettings, TravelSettings
from barsight.simulation.settings.yard import BarKind, YardSettings, parse_bars


@dataclass(frozen=True)
class SimulationSettings:
    """A simulated recording of a bar yard. The same settings give the same bytes."""

    length_m: Annotated[float, tyro.conf.arg(aliases=("--length",))] = 7.0
    """Length of the stack along the travel."""
    frames: int = 20
    """Number of stereo pairs, evenly spaced over the travel."""
    seed: int = 0
    """Random seed."""
    bars: str = "90mm:7"
    """Kinds of bundles as bar diameter and number of bars: 90mm:7,40mm:37; each section of the stack takes
    one.
    """
    depth_views: int = 2
    """Number of pairs whose true depth is stored."""
    renderer: Literal["barsight", "mitsuba"] = "barsight"
    """Renderer of the pictures: `barsight`, or path tracing by Mitsuba 3, which is much slower and draws
    neither ribbed bars, dust, codes, spheres nor the sun.
    """
    paths: int = 36
    """Number of paths per ray in Mitsuba, a square; 36 add a third of the camera's noise."""
    camera: CameraSettings = field(default_factory=CameraSettings)
    yard: YardSettings = field(default_factory=YardSettings)
    motion: TravelSettings = field(default_factory=TravelSettings)
    girder: GirderSettings = field(default_factory=GirderSettings)
    sensors: SensorSettings = field(default_factory=SensorSettings)
    passes: PassesSettings = field(default_factory=PassesSettings)
    magnet: MagnetSettings = field(default_factory=MagnetSettings)
    light: LightSettings = field(default_factory=LightSettings)
    faults: FaultSettings = field(default_factory=FaultSettings)

    def __post_init__(self) -> None:
        expect_values(self)
        expect_ranges(
            self, "", length_m=(1, 500), frames=(2, 100_000), seed=NOT_NEGATIVE,
            depth_views=(0, self.frames), paths=(1, 4096),
        )  # fmt: skip
        expect(math.isqrt(self.paths) ** 2 == self.paths, "paths must be a square number, such as 16 or 64")
        layers = self.yard.max_layers + (self.yard.crossed_ratio > 0)
        tallest = max(2 * k.diameter_m * (k.rings + 0.5) for k in self.kinds) + self.yard.dunnage_m
        expect(
            self.camera.above_floor_m > layers * tallest + 1,
            "camera.above_floor_m must be at least 1 m over the highest possible stack",
        )

    @property
    def kinds(self) -> tuple[BarKind, ...]:
        """Parse the kinds of bundles that `bars` names."""
        return parse_bars(self.bars)

    @classmethod
    def demo(cls) -> SimulationSettings:
        """Create the settings of the small yard of `barsight demo`: 3 m of stack, 11 pairs of 960x768.

        The bars reach beyond the example magnet, and the pictures beyond the bars even if one is moved.
        """
        camera = CameraSettings(
            width_px=960, height_px=768, focal_px=850.0, above_floor_m=8.5, trolley_y_m=0.0
        )
        yard = YardSettings(max_layers=3, bar_length_m=5.4)
        return cls(length_m=3.0, frames=11, seed=1, bars="60mm:19", camera=camera, yard=yard)
