"""Define the settings of the hall's light and of what spoils pictures."""

from __future__ import annotations

from dataclasses import dataclass

from barsight.core.errors import ConfigError


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
        _expect(0 < self.lamp_ratio <= 10, "light lamp_ratio must lie over 0, up to 10")
        _expect(0 <= self.ambient <= 5, "light ambient must lie between 0 and 5")
        _expect(0 <= self.bounce_ratio <= 1, "light bounce_ratio must lie between 0 and 1")
        _expect(0 < self.lamp_length_m <= 10, "light lamp_length_m must lie over 0, up to 10 m")
        _expect(0 <= self.sun_ratio <= 20, "light sun_ratio must lie between 0 and 20")
        _expect(10 <= self.sun_elevation_deg <= 90, "light sun_elevation_deg must lie between 10 and 90")
        low_x, high_x, low_y, high_y = self.sun_patch_m
        _expect(low_x < high_x and low_y < high_y, "light sun_patch_m must name from before to")


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
        _expect(0 <= self.exposure_s <= 0.2, "faults exposure_s must lie between 0 and 0.2 s")
        _expect(0 <= self.haze_ratio < 1, "faults haze_ratio must lie between 0 and 1")
        _expect(0 <= self.exposure_step_ratio <= 1, "faults exposure_step_ratio must lie between 0 and 1")
        _expect(0 <= self.flicker_ratio <= 0.5, "faults flicker_ratio must lie between 0 and 0.5")
        _expect(0 <= self.glare_ratio <= 2, "faults glare_ratio must lie between 0 and 2")
        _expect(1 <= self.dirt_px <= 500, "faults dirt_px must lie between 1 and 500")
        _expect(
            min(self.dirt_spots, self.drops, self.dead_pixels) >= 0
            and max(self.dirt_spots, self.drops, self.dead_pixels) <= 10_000,
            "faults dirt_spots, drops and dead_pixels must lie between 0 and 10000",
        )


def _expect(holds: bool, sentence: str) -> None:
    if not holds:
        raise ConfigError(sentence)
