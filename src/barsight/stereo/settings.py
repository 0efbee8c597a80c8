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
    """Stereo method that matches the pairs."""
    min_disparity_px: int | None = None
    """Lowest candidate disparity; found from the images when not given."""
    max_disparity_px: int | None = None
    """End of the candidate disparities, itself not included; found from the images when not given."""
    calibration_sigma_px: float = 0.05
    """Disparity error due to the calibration, the same everywhere (1 sigma); used where no rig file's
    covariance gives it. A known travel that agrees with the calibration reduces it.
    """
    max_depth_m: float = 40.0
    """Maximum depth; points further away are left out."""
    max_sigma_px: float = 0.99
    """Maximum sigma of a disparity used in a map; guesses have 1 px or more."""
    confirmed_pairs: int = 5
    """Number of pairs, after one matched without a prediction, that start from the previous pair's
    disparity, moved by the encoders' and pictures' motion, where their own pictures confirm it; 0 matches
    every pair without a prediction. Only with method `barsight`, preset `best`, encoders and map.min_shift
    0.
    """
    binned_row_m: float = 0.0
    """Maximum width on the surface of two rows that are averaged, for a map, where the picture is alike
    along its columns, as bars across the baseline are: a third less work for errors up to a tenth larger;
    0.016 suits, 0 never averages. Only with method `barsight`.
    """
    gap_darkness: float = 0.55
    """Brightness relative to the surroundings below which a pixel is a gap between bars and unknown; 0
    keeps them.
    """
    sgbm: SgbmSettings = field(default_factory=SgbmSettings)
    csca: CscaSettings = field(default_factory=CscaSettings)
    nonlocal_tree: NonlocalSettings = field(default_factory=NonlocalSettings)
    """Settings of the method `nonlocal`."""
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
    """Create the method that the settings name, for a map.

    It makes no guesses, which no map accepts, and ignores the risk of the wrong side at depth edges in its
    sigma, because a map compares the views' sides with each other. Rows may be binned.
    """
    if settings.method != "barsight":
        return make_method(settings)
    own = replace(settings.barsight, fill_occlusions=False, other_side_error_ratio=0.0)
    return BarsightStereo(own, settings.binned_row_m)


def make_method(settings: StereoSettings) -> StereoMethod:
    """Create the method that the settings name."""
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
