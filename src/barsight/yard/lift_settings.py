"""Define the settings of lift targets and of the pile's stability."""

from __future__ import annotations

from dataclasses import dataclass

from barsight.core.errors import ConfigError
from barsight.core.settings.values import OVER_0, POSITIVE, SHARE, expect_ranges


@dataclass(frozen=True)
class LiftSettings:
    """Limits of a lift, beside the magnet's own."""

    bundles: int = 1
    """Bundles to be taken by one lift."""
    min_count_probability: float = 0.999
    """How sure the count under the footprint must be."""
    max_unknown_ratio: float = 0.25
    """Of the cells under a pole that were not seen; filled ones count as not seen."""
    max_unexplained_ratio: float = 0.03
    """Of the poles' area over something that belongs to no bundle."""
    min_confidence: float = 0.5
    """A bundle less sure than this is not lifted."""
    contact_gap_m: float = 0.003
    """A face nearer than this to steel lies on it."""
    strap_m: float = 0.0012
    """Thickest strap, which may hold a face off the bars."""
    max_hidden_bar_m: float = 0.022
    """Thickest bar across a load that the pictures may be too coarse to show."""
    max_refused_ratio: float = 0.5
    """Of the frames that see the place of the lift."""
    max_age_s: float = 600.0
    """A place that was last seen longer ago than this is not lifted from."""
    disturbed_reach_m: float = 1.0
    """A lift, set-down or magnet since a place was last seen, nearer than this to its lift, forbids that."""
    max_overhang_ratio: float = 0.25
    """Of its width that a bundle may stand over the edge of what carries it."""
    max_lean_deg: float = 5.0
    """How far a side of the pile may lean outwards."""
    max_turn_deg: float = 5.0
    """Largest turn of a load by the crane before it is set down; from 90 on places across count."""
    set_down_clear_m: float = 0.1
    """What stands higher must be this far from a load that is set down, beyond the crane's tolerance."""
    dunnage_m: float = 0.0
    """Thickness of what men lay across under every load that is set down; 0 where nothing is laid."""
    travel_clear_m: float = 0.5
    """Height of a travelling load's underside over all that stands on its way."""
    swing_m: float = 0.5
    """How far a travelling load may swing out to any side."""
    max_stack_m: float | None = None
    """The most that may stand where nothing was seen; without it no load travels over such a place."""
    stanchions: tuple[tuple[float, float, float], ...] = ()
    """x, y and height (m) of the stanchions, where there are any."""
    no_lift_areas: tuple[tuple[float, float, float, float], ...] = ()
    """x_min, y_min, x_max, y_max (m) of rectangles where nothing is lifted or put down: walls, walkways, what
    stands there for good."""
    min_freeboard_m: float = 0.05
    """How far a stanchion must stand above the bundles beside it."""
    beside_stanchion_m: float = 1.0
    """A bundle nearer than this to a stanchion is held by it."""

    def __post_init__(self) -> None:
        expect_ranges(
            self, "lift.", bundles=(1, 10), max_unknown_ratio=SHARE, max_unexplained_ratio=SHARE,
            min_confidence=SHARE, max_overhang_ratio=SHARE, min_count_probability=SHARE,
            max_refused_ratio=SHARE, strap_m=(0, 0.05), max_hidden_bar_m=(OVER_0, 0.1),
            contact_gap_m=POSITIVE, max_age_s=POSITIVE, beside_stanchion_m=POSITIVE,
            disturbed_reach_m=(0, 100), set_down_clear_m=POSITIVE, travel_clear_m=POSITIVE,
            swing_m=POSITIVE, dunnage_m=(0, 0.5), max_turn_deg=(0, 180), max_stack_m=(OVER_0, 50),
            max_lean_deg=(OVER_0, 45),
        )  # fmt: skip
        for area in self.no_lift_areas:
            if not (area[0] < area[2] and area[1] < area[3]):
                told = ", ".join(f"{value:g}" for value in area)
                raise ConfigError(f"lift.no_lift_areas: give x_min, y_min, x_max, y_max, not {told}")


UPPER = 1.645
"""Sigmas to a bound that holds in 95 % of cases."""
