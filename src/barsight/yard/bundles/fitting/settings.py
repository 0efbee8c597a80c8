"""Define the settings of finding bundles."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from barsight.core.errors import ConfigError
from barsight.core.settings.values import NOT_NEGATIVE, OVER_0, POSITIVE, expect_ranges


@dataclass(frozen=True)
class BundleSettings:
    """Settings of finding bundles of round bars, or single heavy bars, in the height map."""

    catalogue_mm: tuple[float, ...] = ()
    """All diameters of bars that may lie here; any diameter when not given. Lifts count on that."""
    stock_list: Path | None = None
    """CSV or JSON of the bundles that should lie here, to be held against those found."""
    min_length_m: float = 0.5
    """Shorter pieces aren't reported."""
    min_bar_diameter_m: float = 0.014
    """Thinnest bars in a bundle."""
    min_single_diameter_m: float = 0.06
    """Thinnest bar that counts as a bundle of its own."""
    min_width_m: float = 0.09
    """Narrowest bundle of several bars."""
    max_width_m: float = 0.6
    """Widest bundle."""
    slice_step_m: float = 1.0
    """Bundles are first looked for in cross-sections this far apart."""
    slice_m: float = 0.2
    """Length of the bundle that one cross-section averages."""
    max_skew_deg: float = 4.0
    """Bundles turned further from their neighbours are looked for as a heading of their own."""
    agreement_m: float = 0.015
    """A height within this of the bundle's outline agrees with it."""
    smoothing_m: float = 0.006
    """Standard deviation of the map's smoothing across the bars."""
    placing_m: float = 0.004
    """How far a height may lie beside its place: it counts the less the steeper the outline is there."""
    correlated_along_m: float = 0.5
    """Errors of heights along a bar are alike over this distance."""
    correlated_across_m: float = 0.03
    """Errors of heights across the bars are alike over this distance."""
    shared_lateral_m: float = 0.0018
    """Error of place that all heights of a bundle share, mostly the trajectory's (one standard deviation)."""
    shared_yaw_deg: float = 0.03
    """Error of direction that all of the map shares (one standard deviation): over a short way encoders can't
    tell a rail's wave from a turn."""
    shared_height_m: float = 0.001
    """The same of height, but for the calibration's part, which moves the whole map."""
    packing_error_ratio: float = 0.025
    """Error of a bundle's width that the map's smoothing leaves, as a share."""
    single_error_ratio: float = 0.05
    """The same for a single bar, whose flanks a map shows too wide."""
    max_cell_m: float = 0.025
    """In a map of larger cells no bundles are looked for."""
    min_rise_m: float = 0.03
    """Heights nearer to the floor than this are floor."""

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
