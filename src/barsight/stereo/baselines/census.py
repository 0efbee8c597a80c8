"""Match with improved Census and outlier elimination, after [Peng, Han, Tang, Shang, Yu 2017].

The steps are a noise-tolerant Census against a weighted mean, aggregation over cross-shaped regions, winner
takes all, left-right check, region voting for pixels that fail it, filling with a weighted median, and a
subpixel parabola. Memory: two blocks of 16 candidates, whatever their number.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import inf

import numpy as np

from barsight.core.arrays import Float32
from barsight.core.errors import ConfigError
from barsight.core.records.disparity import Disparity, DisparityRange
from barsight.core.records.pairs import RectifiedPair
from barsight.core.settings.values import NOT_NEGATIVE, SHARE, expect_ranges
from barsight.stereo.baselines.census_transform import census_codes, census_cost
from barsight.stereo.baselines.cross_aggregation import CrossRegions, cross_filter, cross_regions
from barsight.stereo.baselines.left_right_check import (
    fill_from_background,
    left_right_agreement,
    weighted_median,
)
from barsight.stereo.baselines.postprocessing import (
    OutputSettings,
    assemble_disparity,
    is_matchable,
    mirror_pair,
    no_match,
)
from barsight.stereo.baselines.region_voting import region_vote
from barsight.stereo.baselines.winner_takes_all import Winners, sweep
from barsight.stereo.noise import image_noise

_MEDIAN_RADIUS_PX = 9
_MEDIAN_SIGMA_PX = 9.0
_MEDIAN_SIGMA_GRAY = 14.7


@dataclass(frozen=True)
class CensusSettings:
    """Improved Census."""

    tolerance_sigmas: float = 1.0
    """Maximum difference, in sigmas of the image's noise, of gray values that count as equal."""
    long_arm_px: int = 11
    """Maximum length of a region's arms."""
    short_arm_px: int = 5
    """Length of an arm up to which loose_gray applies instead of tight_gray."""
    loose_gray: int = 12
    """Maximum gray difference along an arm up to short_arm_px."""
    tight_gray: int = 6
    """Maximum gray difference along an arm beyond short_arm_px."""
    rounds: int = 2
    """Number of aggregation rounds."""
    min_votes: int = 20
    """Number of reliable pixels that an outlier's region must exceed to vote."""
    min_vote_ratio: float = 0.4
    """Share of the votes that the winning disparity must exceed."""
    vote_rounds: int = 5
    """Number of voting rounds."""
    output: OutputSettings = field(
        default_factory=lambda: OutputSettings(subpixel_sigma_px=0.26, filled_sigma_px=2.7)
    )

    def __post_init__(self) -> None:
        expect_ranges(
            self, "census.", tolerance_sigmas=NOT_NEGATIVE, rounds=(1, inf), vote_rounds=NOT_NEGATIVE,
            short_arm_px=(1, 1000), long_arm_px=(1, 1000), loose_gray=NOT_NEGATIVE, tight_gray=NOT_NEGATIVE,
            min_vote_ratio=SHARE,
        )  # fmt: skip
        if self.short_arm_px > self.long_arm_px:
            raise ConfigError("census.short_arm_px can't be over census.long_arm_px")


@dataclass(frozen=True)
class Census:
    """`StereoMethod`: improved Census over cross-shaped regions."""

    settings: CensusSettings

    def __call__(self, pair: RectifiedPair, candidates: DisparityRange) -> Disparity:
        """Match; see `StereoMethod`."""
        settings = self.settings
        if not is_matchable(pair, candidates):
            return no_match(pair)
        tolerance = settings.tolerance_sigmas * image_noise(pair.left)
        regions = _regions(pair, settings)
        winners = census_winners(pair, regions, candidates, tolerance, settings.rounds)
        mirror = mirror_pair(pair)
        mirrored = census_winners(mirror, _regions(mirror, settings), candidates, tolerance, settings.rounds)
        right = np.ascontiguousarray(mirrored.candidate_px[:, ::-1])
        matched = left_right_agreement(winners.candidate_px, right, tolerance_px=1)
        voted, reliable = region_vote(
            winners.candidate_px,
            matched,
            regions,
            settings.min_votes,
            settings.min_vote_ratio,
            settings.vote_rounds,
        )
        chosen = weighted_median(
            fill_from_background(voted, reliable),
            pair.left,
            ~reliable,
            _MEDIAN_RADIUS_PX,
            _MEDIAN_SIGMA_PX,
            _MEDIAN_SIGMA_GRAY,
        )
        return assemble_disparity(pair, winners, chosen, matched, settings.output)


def census_winners(
    pair: RectifiedPair, regions: CrossRegions, candidates: DisparityRange, tolerance: float, rounds: int
) -> Winners:
    """Select the left image's winners. tolerance: gray levels."""
    left, right = census_codes(pair.left, tolerance), census_codes(pair.right, tolerance)
    aggregate = cross_filter(regions, rounds)

    def fill(lowest_px: int, slices: Float32) -> None:
        census_cost(left, right, pair.left_valid, pair.right_valid, lowest_px, slices)
        aggregate(slices)

    return sweep(pair.left.shape, candidates, fill)


def _regions(pair: RectifiedPair, settings: CensusSettings) -> CrossRegions:
    return cross_regions(
        pair.left, settings.long_arm_px, settings.short_arm_px, settings.loose_gray, settings.tight_gray
    )
