"""What no map takes: guesses, and gaps between bars, so dark that nothing in them is matched itself.

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


def in_gap(image: UInt8, darkness: float) -> Bool:
    """(H, W): pixels (3 x 3 mean) darker than `darkness` times the mean of the 41 x 41 around them."""
    own = cv2.blur(image, (3, 3))
    around = cv2.blur(image, (_AROUND_PX, _AROUND_PX))
    dark: Bool = own < darkness * around.astype(np.float32)
    return dark


def without_gaps(disparity: Disparity, image: UInt8, darkness: float) -> Disparity:
    """The disparity with gaps made unknown; darkness 0 leaves it as it is."""
    if darkness <= 0:
        return disparity
    return keep(disparity, ~in_gap(image, darkness))


def surer_than(disparity: Disparity, max_sigma_px: float) -> Disparity:
    """The disparity without what is less sure than this, guesses among it."""
    return keep(disparity, disparity.sigma_px <= max_sigma_px)


def keep(disparity: Disparity, kept: Bool) -> Disparity:
    """The disparity with all made unknown that is not `kept` (H, W)."""
    nan = np.float32(np.nan)
    return replace(
        disparity,
        disparity_px=np.where(kept, disparity.disparity_px, nan),
        sigma_px=np.where(kept, disparity.sigma_px, nan),
    )
