"""Define the settings of the hall's light and of the image faults."""

from __future__ import annotations

from dataclasses import dataclass

from barsight.core.errors import ConfigError
from barsight.core.settings.values import OVER_0, SHARE, UNDER_1, expect_ranges


@dataclass(frozen=True)
class LightSettings:
    """Light of the hall, and optionally a patch of sunlight."""

    lamp_ratio: float = 1.0
    """Strength of the lamps relative to the ordinary hall."""
    ambient: float = 0.34
    """Ambient light of the hall on an open level surface, where 1 is white paper under the lamps."""
    bounce_ratio: float = 0.05
    """Share of the ambient light that reaches every surface, however hidden, by reflection from its
    surroundings.
    """
    lamp_length_m: float = 1.0
    """Length of each lamp, across the travel."""
    sun_ratio: float = 0.0
    """Strength of the sunlight on a level surface, where 1 is about that of the lamps; 0 switches it off."""
    sun_elevation_deg: float = 45.0
    """Elevation of the sun above the horizon."""
    sun_azimuth_deg: float = 30.0
    """Azimuth of the sun, from X towards Y."""
    sun_patch_m: tuple[float, float, float, float] = (0.0, 2.0, -1.0, 1.0)
    """Patch of the open floor that the sun lights: x from, x to, y from, y to."""

    def __post_init__(self) -> None:
        expect_ranges(
            self, "light.", lamp_ratio=(OVER_0, 10), ambient=(0, 5), bounce_ratio=SHARE,
            lamp_length_m=(OVER_0, 10), sun_ratio=(0, 20), sun_elevation_deg=(10, 90),
        )  # fmt: skip
        low_x, high_x, low_y, high_y = self.sun_patch_m
        if low_x >= high_x or low_y >= high_y:
            raise ConfigError("light.sun_patch_m must name from before to")


@dataclass(frozen=True)
class FaultSettings:
    """Faults of the images; all zeros switch them off."""

    exposure_s: float = 0.0
    """Exposure time: what moves during it is blurred."""
    haze_ratio: float = 0.0
    """Share of the light that haze between floor and camera replaces by its own gray light."""
    dirt_spots: int = 0
    """Number of dirt spots on each lens."""
    dirt_px: float = 25.0
    """Median radius of a dirt spot; drops are somewhat larger."""
    drops: int = 0
    """Number of drops of water or oil on each lens, which defocus the image there."""
    dead_pixels: int = 0
    """Number of pixels in each camera that are always black or white."""
    exposure_step_ratio: float = 0.0
    """Standard deviation of the exposure from one pair to the next, relative to the nominal exposure."""
    flicker_ratio: float = 0.0
    """Amplitude of the lamps' flicker from image to image, relative to their light; independent in each
    camera.
    """
    glare_ratio: float = 0.0
    """Strength of the stray light at the centre of a wide blot on each lens, where 1 is white."""

    def __post_init__(self) -> None:
        expect_ranges(
            self, "faults.", exposure_s=(0, 0.2), haze_ratio=(0, UNDER_1), exposure_step_ratio=SHARE,
            flicker_ratio=(0, 0.5), glare_ratio=(0, 2), dirt_px=(1, 500), dirt_spots=(0, 10_000),
            drops=(0, 10_000), dead_pixels=(0, 10_000),
        )  # fmt: skip
