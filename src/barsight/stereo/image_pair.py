"""Build a rectified pair from two images whose rig is unknown."""

from __future__ import annotations

import numpy as np

from barsight.core.arrays import UInt8
from barsight.core.records.pairs import RectifiedCamera, RectifiedPair


def pair_from_images(
    left: UInt8, right: UInt8, left_colour: UInt8 | None = None, right_colour: UInt8 | None = None
) -> RectifiedPair:
    """Build a pair without a known rig: its focal length is the width, its baseline 1 m, and all pixels
    are valid.
    """
    height, width = left.shape
    everywhere = np.ones((height, width), dtype=np.bool_)
    camera = RectifiedCamera(float(width), (width - 1) / 2, (height - 1) / 2, 1.0, 0.0, width, height)
    return RectifiedPair(0, left, right, everywhere, everywhere, camera, left_colour, right_colour)
