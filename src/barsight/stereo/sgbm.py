"""Match with OpenCV's semi-global block matching [Hirschmueller 2008]."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from barsight.core.arrays import Bool, Float32, UInt8
from barsight.core.errors import ConfigError
from barsight.core.records.disparity import Disparity, DisparityRange
from barsight.core.records.pairs import RectifiedPair
from barsight.core.settings.values import NOT_NEGATIVE, POSITIVE, expect_ranges
from barsight.stereo.noise import image_noise

_MODES = {
    "3way": cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    "5path": cv2.STEREO_SGBM_MODE_SGBM,
    "8path": cv2.STEREO_SGBM_MODE_HH,
    "hh4": cv2.STEREO_SGBM_MODE_HH4,
}
_SUBPIXEL_STEPS = 16
_CANDIDATE_STEP = 16
_MIN_TEXTURE = 1e-3


@dataclass(frozen=True)
class SgbmSettings:
    """Settings of OpenCV's SGBM."""

    mode: Literal["3way", "5path", "8path", "hh4"] = "hh4"
    """Set of paths along which costs are summed; 8path is the slowest and needs the whole cost volume."""
    block_px: int = 5
    """Side of the matching block; must be odd."""
    uniqueness_pct: int = 5
    """Minimum margin, in percent, by which the winner's cost must be better than the second best."""
    speckle_px: int = 100
    """Minimum size of a connected patch, in pixels; smaller ones are dropped."""
    subpixel_sigma_px: float = 0.2
    """Error that image noise doesn't explain, from pixel locking and smoothing (1 sigma)."""

    def __post_init__(self) -> None:
        if self.block_px % 2 == 0:
            raise ConfigError(f"sgbm.block_px must be odd, not {self.block_px}")
        expect_ranges(
            self, "sgbm.", block_px=POSITIVE, uniqueness_pct=(0, 100), speckle_px=NOT_NEGATIVE,
            subpixel_sigma_px=NOT_NEGATIVE,
        )  # fmt: skip


@dataclass(frozen=True)
class Sgbm:
    """`StereoMethod` using OpenCV's SGBM; sigma follows from the measured noise and the gradients in the
    block.

    Where a block has no gradient at all (black, saturated), nothing can be matched and there is no disparity.
    """

    settings: SgbmSettings

    def __call__(self, pair: RectifiedPair, candidates: DisparityRange) -> Disparity:
        """Match; see `StereoMethod`."""
        settings = self.settings
        block = settings.block_px
        count = -(-candidates.count // _CANDIDATE_STEP) * _CANDIDATE_STEP
        matcher = cv2.StereoSGBM.create(
            minDisparity=candidates.lowest_px,
            numDisparities=count,
            blockSize=block,
            P1=8 * block * block,
            P2=32 * block * block,
            disp12MaxDiff=1,
            preFilterCap=31,
            uniquenessRatio=settings.uniqueness_pct,
            speckleWindowSize=settings.speckle_px,
            speckleRange=2,
            mode=_MODES[settings.mode],
        )
        # OpenCV leaves out the columns whose candidates extend past a border; padding restores them.
        before, after = max(candidates.lowest_px + count, 0), max(-candidates.lowest_px, 0)
        left, right = (
            cv2.copyMakeBorder(image, 0, 0, before, after, cv2.BORDER_REPLICATE)
            for image in (pair.left, pair.right)
        )
        fixed_point = matcher.compute(left, right)[:, before : before + pair.left.shape[1]]
        disparity = fixed_point.astype(np.float32) / _SUBPIXEL_STEPS
        within = (disparity >= candidates.lowest_px) & (disparity <= candidates.highest_px - 1)
        disparity[~within] = np.nan
        disparity[~pair.left_valid] = np.nan
        disparity[~_lands_on_valid(disparity, pair)] = np.nan
        texture = _texture(pair.left, block)
        disparity[texture < _MIN_TEXTURE] = np.nan
        noise_sigma = _noise_sigma(texture, image_noise(pair.left))
        sigma = np.hypot(noise_sigma, np.float32(settings.subpixel_sigma_px))
        sigma[np.isnan(disparity)] = np.nan
        return Disparity(disparity, sigma.astype(np.float32), settings.subpixel_sigma_px)


def _lands_on_valid(disparity: Float32, pair: RectifiedPair) -> Bool:
    width = disparity.shape[1]
    column = np.arange(width, dtype=np.float32)[None, :] - disparity
    inside = (column >= 0) & (column <= width - 1)
    target = np.where(inside, column, 0).astype(np.int32)
    landed: Bool = inside & np.take_along_axis(pair.right_valid, target, axis=1)
    return landed


def _texture(image: UInt8, block: int) -> Float32:
    """Sum squared gradients along the row (H, W), gray levels per px, over each block."""
    gradient = cv2.Sobel(image, cv2.CV_32F, 1, 0, ksize=3, scale=1 / 8)
    texture: Float32 = cv2.boxFilter(gradient * gradient, -1, (block, block), normalize=False)
    return texture


def _noise_sigma(texture: Float32, noise: float) -> Float32:
    """Compute the Cramer-Rao bound (H, W) of a block match: sqrt(2) times the image sigma over the root of
    the summed squared gradients.
    """
    sigma: Float32 = np.sqrt(2 * noise**2 / np.maximum(texture, _MIN_TEXTURE), dtype=np.float32)
    return sigma.clip(max=1)
