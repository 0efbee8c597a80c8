"""Define the settings of the simulated stack and the kinds of its bundles."""

from __future__ import annotations

import re
from dataclasses import dataclass

from barsight.core.errors import ConfigError
from barsight.core.settings.values import NOT_NEGATIVE, SHARE, expect, expect_ranges

BARS_OF_RINGS = (1, 7, 19, 37, 61)


@dataclass(frozen=True)
class BarKind:
    """One kind of bundle: bar diameter (m) and number of bars in a bundle (1, 7, 19, 37 or 61)."""

    diameter_m: float
    count: int

    @property
    def rings(self) -> int:
        """Return the number of rings of bars around the central one."""
        return BARS_OF_RINGS.index(self.count)


def parse_bars(text: str) -> tuple[BarKind, ...]:
    """Parse `"90mm:7,40mm:37"` to kinds of bundles. Raises ConfigError if it can't be read."""
    kinds = []
    for part in text.split(","):
        match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*mm\s*:\s*(\d+)\s*", part)
        if match is None:
            raise ConfigError(
                f"bars {text!r}: {part!r} is not like 90mm:7; give diameter and bars per bundle"
            )
        kind = BarKind(float(match[1]) / 1000, int(match[2]))
        if kind.count not in BARS_OF_RINGS:
            raise ConfigError(f"bars {text!r}: a bundle packs 1, 7, 19, 37 or 61 bars, not {kind.count}")
        if not 0.01 <= kind.diameter_m <= 0.5:
            raise ConfigError(f"bars {text!r}: the diameter must lie between 10 and 500 mm")
        kinds.append(kind)
    return tuple(kinds)


@dataclass(frozen=True)
class YardSettings:
    """The stack: bundles side by side along X, with their bars along Y."""

    max_layers: int = 4
    """Maximum number of layers of bundles."""
    bar_length_m: float = 7.5
    """Length of the bars; some sections hold shorter ones."""
    gap_m: float = 0.02
    """Mean clearance between neighbouring bundles, beyond what their skew requires."""
    skew_deg: float = 0.3
    """Standard deviation of the bundles' yaw, which is limited to 1 degree or to twice this, whichever is
    larger.
    """
    uneven_ends_m: float = 0.03
    """Largest shift of a bar along its bundle, in either direction."""
    missing_ratio: float = 0.08
    """Probability that a place on the lowest layer is empty (a gully)."""
    crossed_ratio: float = 0.0
    """Probability that a section has a bundle on top that lies across the others or is rotated by 6 to 20
    degrees.
    """
    dunnage_m: float = 0.09
    """Height and width of the dunnage, wooden beams between the layers."""
    strap_spacing_m: float = 1.7
    """Distance between a bundle's straps; 0 leaves them out."""
    label_m: tuple[float, float] = (0.0, 0.0)
    """Length and width of the label on each strapped bundle, which carries the bundle's own QR code and
    lies over the middle strap; 0 0 makes it small and plain.
    """
    ribbed_ratio: float = 0.25
    """Probability that a section holds ribbed bars."""
    gloss: float = 1.0
    """Strength of the highlights; 0 makes the steel matt."""
    texture_ratio: float = 1.0
    """Contrast of the texture on steel and floor, relative to the ordinary."""

    def __post_init__(self) -> None:
        expect_ranges(
            self, "yard.", max_layers=(1, 5), bar_length_m=(1, 20), skew_deg=(0, 2), missing_ratio=(0, 0.6),
            crossed_ratio=SHARE, dunnage_m=(0.02, 0.3), ribbed_ratio=SHARE, gap_m=(0, 1),
            uneven_ends_m=(0, 0.5), label_m=(0, 0.6), gloss=NOT_NEGATIVE, texture_ratio=(0, 2),
        )  # fmt: skip
        expect((min(self.label_m) == 0) == (max(self.label_m) == 0), "yard.label_m needs both sizes, or 0 0")
        expect(
            self.strap_spacing_m == 0 or self.strap_spacing_m >= 0.3,
            "yard.strap_spacing_m must be 0 or at least 0.3",
        )
