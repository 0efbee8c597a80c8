"""The disparity range found from the images, and left and right swapped found on the way.

A coarse match at a quarter of the size over every disparity that could be; its consistent part gives the
range. A swapped pair has disparities of the wrong sign: the coarse match of the exchanged images is then far
more consistent than that of the images as given.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from barsight.core.arrays import Float32, UInt8
from barsight.core.errors import Failed
from barsight.core.types import DisparityRange, RectifiedPair

_SCALE = 4
_WIDEST_SHARE = 0.4
_MARGIN_SHARE = 0.12
_MARGIN_PX = 6
_LEAST_CONSISTENT = 0.03


@dataclass(frozen=True)
class CoarseMatch:
    """disparity_px: consistent coarse disparities in full-size px (N,). share: of the compared pixels."""

    disparity_px: Float32
    share: float


def find_range(pair: RectifiedPair) -> DisparityRange | Failed:
    """The range of disparities that a pair shows, widened by a margin.

    Failed `no-texture` where too little matches either way, `swapped` where left and right are exchanged.
    """
    given = coarse_match(pair.left, pair.right)
    if given.share < 0.25:
        exchanged = coarse_match(pair.right, pair.left)
        if exchanged.share > 2 * given.share and exchanged.share > 0.1:
            return Failed(
                "swapped",
                f"left and right images are swapped: {100 * exchanged.share:.0f} % of the pixels match "
                f"when they are exchanged, {100 * given.share:.0f} % as given",
            )
    if given.share < _LEAST_CONSISTENT:
        return Failed("no-texture", f"only {100 * given.share:.1f} % of the pixels match between the images")
    low, high = np.percentile(given.disparity_px, (0.1, 99.9))
    margin = _MARGIN_PX + _MARGIN_SHARE * (high - low)
    ceiling = int(pair.camera.width * 0.9)
    lowest = int(np.floor(min(max(low - margin, -pair.camera.doffs_px), ceiling - 16)))
    highest = int(np.ceil(min(high + margin, ceiling)))
    return DisparityRange(lowest, lowest + max(16, -(-(highest - lowest) // 16) * 16))


def coarse_match(left: UInt8, right: UInt8) -> CoarseMatch:
    """Left-right consistent disparities at a quarter of the size, from 1 px to 40 % of the width."""
    size = (max(left.shape[1] // _SCALE, 32), max(left.shape[0] // _SCALE, 32))
    small_left = cv2.resize(left, size, interpolation=cv2.INTER_AREA)
    small_right = cv2.resize(right, size, interpolation=cv2.INTER_AREA)
    count = max(16, int(size[0] * _WIDEST_SHARE) // 16 * 16)
    matcher = cv2.StereoSGBM.create(
        minDisparity=0,
        numDisparities=count,
        blockSize=5,
        P1=200,
        P2=2400,
        uniquenessRatio=10,
        speckleWindowSize=40,
        speckleRange=1,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )
    padded = [cv2.copyMakeBorder(i, 0, 0, count, 0, cv2.BORDER_REPLICATE) for i in (small_left, small_right)]
    forward = matcher.compute(*padded)[:, count:].astype(np.float32) / 16
    # The right image's disparity: the same match with both images mirrored and exchanged.
    mirrored = [
        cv2.copyMakeBorder(cv2.flip(i, 1), 0, 0, count, 0, cv2.BORDER_REPLICATE)
        for i in (small_right, small_left)
    ]
    backward = cv2.flip(matcher.compute(*mirrored)[:, count:], 1).astype(np.float32) / 16
    column = np.arange(size[0], dtype=np.float32)[None, :]
    target = np.rint(column - forward).astype(np.int32)
    inside = (forward > 0.25) & (target >= 0)
    there = np.take_along_axis(backward, target.clip(0, size[0] - 1), axis=1)
    consistent = inside & (np.abs(there - forward) <= 1)
    scale = left.shape[1] / size[0]
    return CoarseMatch(forward[consistent] * np.float32(scale), float(consistent.mean()))
