"""Assemble a `Disparity` from whole winners: the common last step of the baseline methods."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from barsight.core.arrays import Bool, Float32, Int32, UInt8
from barsight.core.records.disparity import Disparity, DisparityRange
from barsight.core.records.pairs import RectifiedPair
from barsight.core.settings.values import NOT_NEGATIVE, expect_ranges
from barsight.stereo.baselines.winner_takes_all import Winners, subpixel_winners
from barsight.stereo.noise import has_texture, noise_sigma

_MIN_RELIABLE = 0.01
"""Minimum share of pixels whose match holds in both images; with fewer, the pair has no match at all."""
_SUPPORT_RADIUS_PX = 4
"""Radius of the window that is taken as a match's support for the noise bound, whatever the method."""


@dataclass(frozen=True)
class OutputSettings:
    """Settings of a method's output and its sigma.

    Each method has its own sigmas, measured on Middlebury's motorcycle as the 68 % quantile of the errors.
    """

    fill: bool = True
    """Fill pixels that only one image sees with a guess from their surroundings, as the methods' authors
    do; otherwise they are NaN.
    """
    subpixel_sigma_px: float = 0.3
    """Error of a match that image noise doesn't explain (1 sigma)."""
    filled_sigma_px: float = 2.0
    """Error of a filled pixel (1 sigma)."""

    def __post_init__(self) -> None:
        expect_ranges(self, "output.", subpixel_sigma_px=NOT_NEGATIVE, filled_sigma_px=NOT_NEGATIVE)


def assemble_disparity(
    pair: RectifiedPair,
    winners: Winners,
    chosen_px: Int32,
    matched: Bool,
    settings: OutputSettings,
) -> Disparity:
    """Assemble the disparity. chosen_px: (H, W) whole disparities after post-processing. matched: where left
    and right agree.

    Matched pixels that kept their winner get the parabola's disparity; the rest stays whole or NaN. sigma
    combines the noise bound over the support with the settings' constant.
    """
    matched = matched & hits_valid_pixel(chosen_px, pair)
    if matched.sum() < _MIN_RELIABLE * matched.size:
        return no_match(pair)
    kept = matched & (chosen_px == winners.candidate_px)
    disparity = np.where(kept, subpixel_winners(winners), chosen_px.astype(np.float32))
    return with_sigma(pair, disparity.astype(np.float32), matched, settings)


def with_sigma(
    pair: RectifiedPair, disparity_px: Float32, matched: Bool, settings: OutputSettings
) -> Disparity:
    """Combine the noise bound over the support with the settings' constants."""
    sigma = np.hypot(noise_sigma(pair.left, _SUPPORT_RADIUS_PX), np.float32(settings.subpixel_sigma_px))
    sigma = np.where(matched, sigma, np.float32(settings.filled_sigma_px)).astype(np.float32)
    known = pair.left_valid & ~np.isnan(disparity_px)
    if not settings.fill:
        known &= matched
    return Disparity(
        np.where(known, disparity_px, np.float32(np.nan)), np.where(known, sigma, np.float32(np.nan))
    )


def no_match(pair: RectifiedPair) -> Disparity:
    """Return a disparity without any match."""
    empty: Float32 = np.full(pair.left.shape, np.nan, dtype=np.float32)
    return Disparity(empty, empty.copy())


def hits_valid_pixel(disparity_px: Int32, pair: RectifiedPair) -> Bool:
    """Check (H, W) whether x - d is a valid pixel of the right image."""
    width = disparity_px.shape[1]
    there = np.arange(width, dtype=np.int32)[None, :] - disparity_px
    inside = (there >= 0) & (there < width)
    landed: Bool = inside & np.take_along_axis(pair.right_valid, there.clip(0, width - 1), axis=1)
    return landed


def mirror_pair(pair: RectifiedPair) -> RectifiedPair:
    """Swap and mirror the pair: its left disparities are the pair's right ones, mirrored."""

    def mirrored(image: UInt8) -> UInt8:
        return np.ascontiguousarray(image[:, ::-1])

    return RectifiedPair(
        stamp_ns=pair.stamp_ns,
        left=mirrored(pair.right),
        right=mirrored(pair.left),
        left_valid=np.ascontiguousarray(pair.right_valid[:, ::-1]),
        right_valid=np.ascontiguousarray(pair.left_valid[:, ::-1]),
        camera=pair.camera,
        left_colour=None if pair.right_colour is None else mirrored(pair.right_colour),
        right_colour=None if pair.left_colour is None else mirrored(pair.left_colour),
    )


def is_matchable(pair: RectifiedPair, candidates: DisparityRange) -> bool:
    """Check that both images have texture and that some candidate leaves them an overlap."""
    width = pair.left.shape[1]
    return has_texture(pair) and candidates.lowest_px < width and candidates.highest_px > -width
