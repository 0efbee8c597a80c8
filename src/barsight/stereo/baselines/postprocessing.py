"""From whole winners to `Disparity`: what the peers' pipelines have in common at their end."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from barsight.core.arrays import Bool, Float32, Int32, UInt8
from barsight.core.errors import ConfigError
from barsight.core.types import Disparity, DisparityRange, RectifiedPair
from barsight.stereo.baselines.winner_takes_all import Winners, between_candidates
from barsight.stereo.noise import noise_sigma

_LEAST_RELIABLE = 0.01


@dataclass(frozen=True)
class OutputSettings:
    """What comes out of a method, and how sure it says to be.

    Each method has its own sigmas, measured on Middlebury's motorcycle as what 68 % of the errors stay below.
    """

    fill: bool = True
    """Give pixels that only one image sees a guess from their surroundings, as the methods' authors do;
    otherwise they are NaN."""
    subpixel_sigma_px: float = 0.3
    """The part of a match's error that image noise doesn't explain (1 sigma)."""
    filled_sigma_px: float = 2.0
    """The error of a filled pixel (1 sigma)."""

    def __post_init__(self) -> None:
        if self.subpixel_sigma_px < 0 or self.filled_sigma_px < 0:
            raise ConfigError("sigmas can't be negative")


def assemble(
    pair: RectifiedPair,
    winners: Winners,
    chosen_px: Int32,
    matched: Bool,
    radius_px: int,
    settings: OutputSettings,
) -> Disparity:
    """chosen_px: (H, W) whole disparities after post-processing. matched: where left and right agree.

    Matched pixels that kept their winner get the parabola's disparity, the rest stays whole or NaN. sigma is
    the noise's bound over a window of radius_px together with the settings' constant.
    """
    matched = matched & lands_on_valid(chosen_px, pair)
    if matched.sum() < _LEAST_RELIABLE * matched.size:
        return nothing(pair)
    kept = matched & (chosen_px == winners.candidate_px)
    disparity = np.where(kept, between_candidates(winners), chosen_px.astype(np.float32))
    sigma = np.hypot(noise_sigma(pair.left, radius_px), np.float32(settings.subpixel_sigma_px))
    sigma = np.where(matched, sigma, np.float32(settings.filled_sigma_px)).astype(np.float32)
    missing = ~pair.left_valid if settings.fill else ~(pair.left_valid & matched)
    disparity[missing] = np.nan
    sigma[missing] = np.nan
    return Disparity(disparity.astype(np.float32), sigma)


def nothing(pair: RectifiedPair) -> Disparity:
    """No match anywhere."""
    empty: Float32 = np.full(pair.left.shape, np.nan, dtype=np.float32)
    return Disparity(empty, empty.copy())


def lands_on_valid(disparity_px: Int32, pair: RectifiedPair) -> Bool:
    """(H, W) True where x - d is a valid pixel of the right image."""
    width = disparity_px.shape[1]
    there = np.arange(width, dtype=np.int32)[None, :] - disparity_px
    inside = (there >= 0) & (there < width)
    landed: Bool = inside & np.take_along_axis(pair.right_valid, there.clip(0, width - 1), axis=1)
    return landed


def mirrored_pair(pair: RectifiedPair) -> RectifiedPair:
    """Right for left as in a mirror: its left disparities are the pair's right ones, mirrored."""

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


def fits(candidates: DisparityRange, width: int) -> bool:
    """Whether any candidate leaves an overlap of the two images."""
    return candidates.lowest_px < width and candidates.highest_px > -width
