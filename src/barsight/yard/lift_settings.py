"""Define the settings of lift targets and of the pile's stability."""

from __future__ import annotations

from dataclasses import dataclass

from barsight.core.errors import ConfigError


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
    min_freeboard_m: float = 0.05
    """How far a stanchion must stand above the bundles beside it."""
    beside_stanchion_m: float = 1.0
    """A bundle nearer than this to a stanchion is held by it."""

    def __post_init__(self) -> None:
        if not 1 <= self.bundles <= 10:
            raise ConfigError(f"lift.bundles must lie in 1...10, not {self.bundles}")
        shares = (
            self.max_unknown_ratio, self.max_unexplained_ratio, self.min_confidence,
            self.max_overhang_ratio, self.min_count_probability, self.max_refused_ratio,
        )  # fmt: skip
        if not all(0 <= share <= 1 for share in shares):
            raise ConfigError("lift: shares, min_confidence and min_count_probability lie in 0...1")
        if not 0 <= self.strap_m <= 0.05:
            raise ConfigError(f"lift.strap_m must lie in 0...0.05, not {self.strap_m}")
        if not 0 < self.max_hidden_bar_m <= 0.1:
            raise ConfigError(f"lift.max_hidden_bar_m must lie in 0...0.1, not {self.max_hidden_bar_m}")
        if self.contact_gap_m <= 0 or self.max_age_s <= 0 or self.beside_stanchion_m <= 0:
            raise ConfigError("lift.contact_gap_m, max_age_s and beside_stanchion_m must be over 0")
        if not 0 <= self.disturbed_reach_m <= 100:
            raise ConfigError(f"lift.disturbed_reach_m must lie in 0...100, not {self.disturbed_reach_m}")
        if min(self.set_down_clear_m, self.travel_clear_m, self.swing_m) <= 0:
            raise ConfigError("lift.set_down_clear_m, travel_clear_m and swing_m must be over 0")
        if not 0 <= self.dunnage_m <= 0.5:
            raise ConfigError(f"lift.dunnage_m must lie in 0...0.5, not {self.dunnage_m}")
        if not 0 <= self.max_turn_deg <= 180:
            raise ConfigError(f"lift.max_turn_deg must lie in 0...180, not {self.max_turn_deg}")
        if self.max_stack_m is not None and not 0 < self.max_stack_m <= 50:
            raise ConfigError(f"lift.max_stack_m must lie between 0 and 50, not {self.max_stack_m}")
        if not 0 < self.max_lean_deg <= 45:
            raise ConfigError(f"lift.max_lean_deg must lie in 0...45, not {self.max_lean_deg}")


UPPER = 1.645
"""Sigmas to a bound that holds in 95 % of cases."""
