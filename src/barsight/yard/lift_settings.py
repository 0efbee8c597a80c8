"""Define the settings for lift targets and for the pile's stability."""

from __future__ import annotations

import math
from dataclasses import dataclass

from barsight.core.errors import ConfigError
from barsight.core.settings.values import OVER_0, POSITIVE, SHARE, expect_ranges


@dataclass(frozen=True)
class LiftSettings:
    """Limits of a lift, besides the magnet's own."""

    bundles: int = 1
    """Number of bundles that one lift takes."""
    min_count_probability: float = 0.999
    """Minimum probability that the bundles under the magnet's poles are counted correctly."""
    max_unknown_ratio: float = 0.25
    """Maximum share of the cells under a pole that were not seen; filled cells count as not seen."""
    max_unexplained_ratio: float = 0.03
    """Maximum share of the poles' area that is over something that belongs to no bundle."""
    min_confidence: float = 0.5
    """Minimum confidence in a bundle that is lifted."""
    contact_gap_m: float = 0.003
    """Maximum gap between a face and the steel for the face to lie on it."""
    strap_m: float = 0.0012
    """Maximum thickness of a strap, which may hold a face off the bars."""
    label_m: float = 0.003
    """Maximum thickness of a label on the bars, which may lie on a strap; 0 if no label holds a face off."""
    max_hidden_bar_m: float = 0.022
    """Maximum diameter of a bar across a load that the pictures may be too coarse to show."""
    max_refused_ratio: float = 0.5
    """Maximum share of refused frames among those that see the place of the lift."""
    max_age_s: float = 600.0
    """Maximum time since a place was last seen for a lift from it."""
    disturbed_reach_m: float = 1.0
    """Minimum distance of a lift from any event (lift, set-down, magnet) since its place was first seen."""
    max_overhang_ratio: float = 0.25
    """Maximum overhang of a bundle over the edge of what carries it, as a share of its width."""
    max_lean_deg: float = 5.0
    """Maximum outward lean of a side of the pile."""
    max_turn_deg: float = 5.0
    """Maximum angle by which the crane turns a load before setting it down; from 90 on, also across."""
    set_down_clear_m: float = 0.1
    """Minimum distance between a load that is set down and anything higher, beyond the crane's tolerance."""
    dunnage_m: float = 0.0
    """Thickness of the dunnage laid across under every load that is set down; 0 where none is laid."""
    travel_clear_m: float = 0.5
    """Minimum clearance of a travelling load's underside over everything on its way."""
    swing_m: float = 0.5
    """Maximum distance by which a travelling load may swing out to any side."""
    max_stack_m: float | None = None
    """Maximum height that may stand where nothing was seen; without it no load travels over such a place."""
    stanchions: tuple[tuple[float, float, float], ...] = ()
    """Position x, y and height (m) of each stanchion, where there are any."""
    no_lift_areas: tuple[tuple[float, float, float, float], ...] = ()
    """Rectangles x_min, y_min, x_max, y_max (m) where nothing is lifted or put down: walls, walkways,
    permanent objects.
    """
    min_freeboard_m: float = 0.05
    """Minimum height of a stanchion above the bundles beside it."""
    beside_stanchion_m: float = 1.0
    """Maximum distance between a stanchion and a bundle that it holds."""

    def __post_init__(self) -> None:
        expect_ranges(
            self, "lift.", bundles=(1, 10), max_unknown_ratio=SHARE, max_unexplained_ratio=SHARE,
            min_confidence=SHARE, max_overhang_ratio=SHARE, min_count_probability=SHARE,
            max_refused_ratio=SHARE, strap_m=(0, 0.05), label_m=(0, 0.012), max_hidden_bar_m=(OVER_0, 0.1),
            contact_gap_m=POSITIVE, max_age_s=POSITIVE, beside_stanchion_m=POSITIVE,
            disturbed_reach_m=(0, 100), set_down_clear_m=POSITIVE, travel_clear_m=POSITIVE,
            swing_m=POSITIVE, dunnage_m=(0, 0.5), max_turn_deg=(0, 180), max_stack_m=(OVER_0, 50),
            max_lean_deg=(OVER_0, 45),
        )  # fmt: skip
        for stanchion in self.stanchions:
            if not (all(map(math.isfinite, stanchion)) and stanchion[2] > 0):
                told = ", ".join(f"{value:g}" for value in stanchion)
                raise ConfigError(f"lift.stanchions: give x, y and a height over 0, not {told}")
        for area in self.no_lift_areas:
            if not (all(map(math.isfinite, area)) and area[0] < area[2] and area[1] < area[3]):
                told = ", ".join(f"{value:g}" for value in area)
                raise ConfigError(f"lift.no_lift_areas: give x_min, y_min, x_max, y_max, not {told}")


UPPER = 1.645
"""Number of sigmas to a one-sided bound that holds in 95 % of cases."""
