"""Barsight's own dense stereo: a semi-global start, then direct refinement along the bars on both images."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from barsight.core.arrays import Float32
from barsight.core.types import Disparity, DisparityRange, RectifiedPair
from barsight.stereo.refinement import RefinementSettings, refine
from barsight.stereo.sgbm import Sgbm, SgbmSettings, image_noise


@dataclass(frozen=True)
class BarsightSettings:
    """Barsight's own stereo."""

    refinement: RefinementSettings = field(default_factory=RefinementSettings)
    model_sigma_px: float = 0.03
    """The part of the error that image noise doesn't explain."""


@dataclass(frozen=True)
class BarsightStereo:
    """`StereoMethod` of our own."""

    settings: BarsightSettings
    uses_all_cores: ClassVar[bool] = True

    def __call__(self, pair: RectifiedPair, candidates: DisparityRange) -> Disparity:
        """See `StereoMethod`."""
        start = Sgbm(replace(SgbmSettings(), mode="3way"))(pair, candidates).disparity_px
        matched = np.isfinite(start)
        refined = refine(pair.left, pair.right, _without_holes(start), matched, self.settings.refinement)
        noise = np.hypot(image_noise(pair.left), image_noise(pair.right))
        sigma = np.sqrt(
            noise * noise / np.maximum(refined.information, 1e-3) + self.settings.model_sigma_px**2
        )
        kept = matched & (np.abs(refined.disparity_px - start) < 2)
        disparity = np.where(kept, refined.disparity_px, np.float32(np.nan))
        return Disparity(
            disparity.astype(np.float32), np.where(kept, sigma, np.float32(np.nan)).astype(np.float32)
        )


def _without_holes(disparity: Float32) -> Float32:
    """Holes take the smaller, farther, neighbour in their row: what is hidden lies behind."""
    height, width = disparity.shape
    known = np.isfinite(disparity)
    if not known.any():
        return np.zeros_like(disparity)
    column = np.arange(width)[None, :]
    before = np.maximum.accumulate(np.where(known, column, -1), axis=1)
    after = np.minimum.accumulate(np.where(known, column, width)[:, ::-1], axis=1)[:, ::-1]
    rows = np.arange(height)[:, None]
    left = np.where(before >= 0, disparity[rows, before.clip(0)], np.float32(np.inf))
    right = np.where(after < width, disparity[rows, after.clip(max=width - 1)], np.float32(np.inf))
    filled = np.minimum(left, right)
    return np.where(np.isfinite(filled), filled, np.nanmedian(disparity)).astype(np.float32)
