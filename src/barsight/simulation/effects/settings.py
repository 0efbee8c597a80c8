"""Define the settings of the hall's light and of what spoils pictures."""

from __future__ import annotations

from dataclasses import dataclass

from barsight.core.errors import ConfigError
from barsight.core.settings.values import OVER_0, SHARE, UNDER_1, expect_ranges


@dataclass(frozen=True)
class LightSettings:
    """Light of the hall, and a patch of sun."""

    lamp_ratio: float = 1.0
    """Strength of the lamps over the ordinary."""
    ambient: float = 0.34
    """Light from the hall itself on an open level surface; 1 is white paper under the lamps."""
    bounce_ratio: float = 0.05
    """Share of the hall's light that reaches every surface, however hidden, from surfaces around it."""
    lamp_length_m: float = 1.0
    """Length of a lamp, across the travel."""
    sun_ratio: float = 0.0
    """Strength of the sun on a level surface; 0 leaves it out."""
    sun_elevation_deg: float = 45.0
    """Height of the sun."""
    sun_azimuth_deg: float = 30.0
    """Direction of the sun, from X towards Y."""
    sun_patch_m: tuple[float, float, float, float] = (0.0, 2.0, -1.0, 1.0)
    """Patch that the sun would light on the open floor: x from, x to, y from, y to."""

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
    """Faults of the pictures; with zeros there are none."""

    exposure_s: float = 0.0
    """Time that the shutter is open: what moves is blurred."""
    haze_ratio: float = 0.0
    """Share of the light that haze on the way replaces by its own, at the floor."""
    dirt_spots: int = 0
    """Spots of dirt on each lens."""
    dirt_px: float = 25.0
    """Radius of a spot, drawn about this."""
    drops: int = 0
    """Drops of water or oil on each lens: places without focus."""
    dead_pixels: int = 0
    """Pixels of each camera that are black or white always."""
    exposure_step_ratio: float = 0.0
    """Standard deviation of the exposure from one pair to the next, as a ratio."""
    flicker_ratio: float = 0.0
    """Amplitude of the lamps' flicker from picture to picture, each camera for itself."""
    glare_ratio: float = 0.0
    """Stray light in the middle of a wide blot on each lens; 1 is white."""

    def __post_init__(self) -> None:
        expect_ranges(
            self, "faults.", exposure_s=(0, 0.2), haze_ratio=(0, UNDER_1), exposure_step_ratio=SHARE,
            flicker_ratio=(0, 0.5), glare_ratio=(0, 2), dirt_px=(1, 500), dirt_spots=(0, 10_000),
            drops=(0, 10_000), dead_pixels=(0, 10_000),
        )  # fmt: skip
