"""Define the settings for finding bundles."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from barsight.core.errors import ConfigError
from barsight.core.settings.values import NOT_NEGATIVE, OVER_0, POSITIVE, expect_ranges
from barsight.yard.bundles.fitting.outline import BARS_OF_RINGS, TRIANGLE, TRIANGLE_BARS_M, bundle_width


@dataclass(frozen=True)
class BundleSettings:
    """Settings for finding bundles of round bars, or single heavy bars, in the height map."""

    catalogue_mm: tuple[float, ...] = ()
    """All bar diameters (mm) that may lie in the yard; any diameter if not given. Lifts rely on this list."""
    stock_list: Path | None = None
    """CSV or JSON file of the bundles that should be in the yard, to be compared with those found."""
    min_length_m: float = 0.5
    """Minimum length of a bundle; shorter pieces aren't reported."""
    min_bar_diameter_m: float = 0.014
    """Minimum diameter of the bars in a bundle."""
    min_single_diameter_m: float = 0.06
    """Minimum diameter of a single bar that counts as a bundle of its own."""
    min_width_m: float = 0.09
    """Minimum width of a bundle of several bars."""
    max_width_m: float = 0.6
    """Maximum width of a bundle."""
    slice_step_m: float = 1.0
    """Distance between the cross-sections in which bundles are first searched for."""
    slice_m: float = 0.2
    """Length along the bars over which one cross-section is averaged."""
    max_skew_deg: float = 4.0
    """Maximum angle between bundles of one heading; bundles turned further are searched for separately."""
    agreement_m: float = 0.015
    """Maximum distance between a measured height and the bundle's outline for the two to agree."""
    smoothing_m: float = 0.006
    """Standard deviation of the map's smoothing across the bars."""
    placing_m: float = 0.004
    """Lateral uncertainty of a height's position, which lowers its weight where the outline is steep."""
    correlated_along_m: float = 0.5
    """Distance along the bars over which errors of heights are correlated."""
    correlated_across_m: float = 0.03
    """Distance across the bars over which errors of heights are correlated."""
    shared_lateral_m: float = 0.0018
    """Standard deviation of the lateral error that all heights of a bundle share, mostly the trajectory's."""
    shared_yaw_deg: float = 0.03
    """Standard deviation of the heading error that the whole map shares: over a short distance, encoders
    can't distinguish a wavy rail from a turn.
    """
    shared_height_m: float = 0.001
    """Standard deviation of the height error that the whole map shares, without the calibration's part."""
    packing_error_ratio: float = 0.025
    """Error of a bundle's width due to the map's smoothing, as a fraction of the width."""
    single_error_ratio: float = 0.05
    """The same for a single bar, whose flanks look too wide in a map."""
    max_cell_m: float = 0.025
    """Maximum cell size of a map in which bundles are searched for."""
    min_rise_m: float = 0.03
    """Height over the floor up to which a surface counts as floor."""

    def __post_init__(self) -> None:
        expect_ranges(
            self, "bundles.", catalogue_mm=(5, 500), min_length_m=POSITIVE, min_bar_diameter_m=POSITIVE,
            min_single_diameter_m=POSITIVE, min_width_m=POSITIVE, slice_step_m=POSITIVE, slice_m=POSITIVE,
            agreement_m=POSITIVE, correlated_along_m=POSITIVE, correlated_across_m=POSITIVE,
            max_cell_m=POSITIVE, smoothing_m=NOT_NEGATIVE, placing_m=NOT_NEGATIVE,
            shared_lateral_m=NOT_NEGATIVE, shared_yaw_deg=NOT_NEGATIVE, shared_height_m=NOT_NEGATIVE,
            max_skew_deg=(OVER_0, 15),
        )  # fmt: skip
        if self.max_width_m <= self.min_width_m:
            raise ConfigError("bundles.max_width_m must be over bundles.min_width_m")
        if self.catalogue_mm and not any(
            self.allows(rings, d / 1000) for rings in range(len(BARS_OF_RINGS)) for d in self.catalogue_mm
        ):
            raise ConfigError(
                "bundles.catalogue_mm lists no diameter of which a bundle may consist: list one, or change "
                "bundles.min_bar_diameter_m, bundles.min_single_diameter_m or the bounds of the width"
            )

    def allows(self, rings: int, diameter_m: float) -> bool:
        """Check whether bars of a diameter may form a bundle of so many rings."""
        low, high = self.diameters_m(rings)
        return low <= diameter_m <= high

    def diameters_m(self, rings: int) -> tuple[float, float]:
        """Return the minimum and maximum diameter of bars that form a bundle of so many rings."""
        narrowest = self.min_width_m if rings else self.min_single_diameter_m
        low = max(narrowest / bundle_width(rings, 1.0), self.min_bar_diameter_m)
        high = self.max_width_m / bundle_width(rings, 1.0)
        if rings == TRIANGLE:
            return max(low, TRIANGLE_BARS_M[0]), min(high, TRIANGLE_BARS_M[1])
        return low, high
