"""Mask what no map takes: guesses, and gaps between bars, so dark that nothing in them is matched itself.

A gully whose floor neither camera sees is a black stripe between two edges of the same surface. It matches
perfectly at that surface's disparity, since both edges do, but nothing lies there.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from barsight.core.arrays import Bool, UInt8
from barsight.core.types import Disparity

_AROUND_PX = 41


def gap_mask(image: UInt8, darkness: float) -> Bool:
    """Mark pixels (H, W) (3 x 3 mean) darker than `darkness` times the mean of the 41 x 41 around them."""
    own = cv2.blur(image, (3, 3))
    around = cv2.blur(image, (_AROUND_PX, _AROUND_PX))
    dark: Bool = own < darkness * around.astype(np.float32)
    return dark


def mask_gaps(disparity: Disparity, image: UInt8, darkness: float) -> Disparity:
    """Mask gaps; darkness 0 leaves the disparity as it is."""
    if darkness <= 0:
        return disparity
    return mask_disparity(disparity, ~gap_mask(image, darkness))


def mask_unsure(disparity: Disparity, max_sigma_px: float) -> Disparity:
    """Mask what is less sure than this, guesses among it."""
    return mask_disparity(disparity, disparity.sigma_px <= max_sigma_px)


def mask_disparity(disparity: Disparity, kept: Bool) -> Disparity:
    """Mask all that is not `kept` (H, W)."""
    nan = np.float32(np.nan)
    return replace(
        disparity,
        disparity_px=np.where(kept, disparity.disparity_px, nan),
        sigma_px=np.where(kept, disparity.sigma_px, nan),
    )
