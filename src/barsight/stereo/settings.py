"""Define the choice of a stereo method and its settings."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal, get_args

from barsight.core.errors import ConfigError
from barsight.core.settings.values import NOT_NEGATIVE, POSITIVE, UNDER_1, expect_ranges
from barsight.stereo.baselines.census import Census, CensusSettings
from barsight.stereo.baselines.csca import Csca, CscaSettings
from barsight.stereo.baselines.nonlocal_aggregation import Nonlocal, NonlocalSettings
from barsight.stereo.baselines.paper import Paper, PaperSettings
from barsight.stereo.direct.pipeline import BarsightSettings, BarsightStereo
from barsight.stereo.method import StereoMethod
from barsight.stereo.sgbm import Sgbm, SgbmSettings

MethodName = Literal["sgbm", "csca", "nonlocal", "census", "paper", "barsight"]
METHODS: tuple[MethodName, ...] = get_args(MethodName)


@dataclass(frozen=True)
class StereoSettings:
    """Settings of dense stereo."""

    method: MethodName = "barsight"
    """Which method matches the pairs."""
    min_disparity_px: int | None = None
    """First candidate; found from the images when not given."""
    max_disparity_px: int | None = None
    """End of the candidates; found from the images when not given."""
    calibration_sigma_px: float = 0.05
    """Disparity error that the calibration may cause everywhere alike (1 sigma), where no rig file's
    covariance says it. A known travel that agrees with the calibration narrows it."""
    max_depth_m: float = 40.0
    """Points further away are left out."""
    max_sigma_px: float = 0.99
    """A map takes no disparity less sure than this; what a method guesses says 1 px or more."""
    confirmed_pairs: int = 5
    """So many pairs after one that is matched from nothing are started from the disparity of the pair before,
    moved as encoders and pictures say, where their own pictures confirm it; 0 matches each from nothing. Only
    with method `barsight`, preset `best`, encoders and map.min_shift 0."""
    binned_row_m: float = 0.016
    """For a map, pairs of rows are averaged where the picture is alike along its columns, as bars across the
    baseline are, and two rows are no wider than this on the surface: half the work; 0 never. Only with method
    `barsight`."""
    gap_darkness: float = 0.55
    """Places darker than this share of their surroundings are gaps between bars: unknown; 0 keeps them."""
    sgbm: SgbmSettings = field(default_factory=SgbmSettings)
    csca: CscaSettings = field(default_factory=CscaSettings)
    nonlocal_tree: NonlocalSettings = field(default_factory=NonlocalSettings)
    """The method `nonlocal`."""
    census: CensusSettings = field(default_factory=CensusSettings)
    paper: PaperSettings = field(default_factory=PaperSettings)
    barsight: BarsightSettings = field(default_factory=BarsightSettings)

    def __post_init__(self) -> None:
        low, high = self.min_disparity_px, self.max_disparity_px
        if low is not None and high is not None and high <= low:
            raise ConfigError(f"the disparity range {low}:{high} is empty")
        expect_ranges(
            self, "stereo.", calibration_sigma_px=NOT_NEGATIVE, max_depth_m=POSITIVE, max_sigma_px=POSITIVE,
            confirmed_pairs=NOT_NEGATIVE, binned_row_m=NOT_NEGATIVE,
            gap_darkness=(0, UNDER_1),
        )  # fmt: skip


def make_map_method(settings: StereoSettings) -> StereoMethod:
    """Make the method that the settings name, for a map.

    It makes no guesses, which no map takes, and is as sure of a pixel's side as if there were no edge: a map
    holds the views' sides against each other. Rows may be binned.
    """
    if settings.method != "barsight":
        return make_method(settings)
    own = replace(settings.barsight, fill_occlusions=False, other_side_error_ratio=0.0)
    return BarsightStereo(own, settings.binned_row_m)


def make_method(settings: StereoSettings) -> StereoMethod:
    """Make the method that the settings name."""
    match settings.method:
        case "barsight":
            return BarsightStereo(settings.barsight)
        case "csca":
            return Csca(settings.csca)
        case "nonlocal":
            return Nonlocal(settings.nonlocal_tree)
        case "census":
            return Census(settings.census)
        case "paper":
            return Paper(settings.paper)
        case "sgbm":
            return Sgbm(settings.sgbm)
