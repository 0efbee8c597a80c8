"""The disparity range found from the images, and left and right swapped found on the way.

A coarse match at a quarter of the size over every disparity that could be; its consistent part gives the
range. A swapped pair has disparities of the wrong sign: the coarse match of the exchanged images is then far
more consistent than that of the images as given.
"""

from __future__ import annotations

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


def find_range(pair: RectifiedPair) -> DisparityRange | Failed:
    """The range of disparities that a pair shows, widened by a margin.

    Failed `no-texture` where too little matches either way, `swapped` where left and right are exchanged.
    """
    disparity = coarse_disparity(pair.left, pair.right)
    share = _finite_share(disparity)
    if share < 0.6:
        exchanged = _finite_share(coarse_disparity(pair.right, pair.left))
        if exchanged > 1.5 * share and exchanged > 0.1:
            return Failed(
                "swapped",
                f"left and right images are swapped: {100 * exchanged:.0f} % of the pixels match "
                f"when they are exchanged, {100 * share:.0f} % as given",
            )
    if share < _LEAST_CONSISTENT:
        return Failed("no-texture", f"only {100 * share:.1f} % of the pixels match between the images")
    low, high = np.nanpercentile(disparity, (0.1, 99.9))
    margin = _MARGIN_PX + _MARGIN_SHARE * (high - low)
    ceiling = int(pair.camera.width * 0.9)
    lowest = int(np.floor(min(max(low - margin, -pair.camera.doffs_px), ceiling - 16)))
    highest = int(np.ceil(min(high + margin, ceiling)))
    return DisparityRange(lowest, lowest + max(16, -(-(highest - lowest) // 16) * 16))


def coarse_disparity(left: UInt8, right: UInt8) -> Float32:
    """Left-right consistent disparities of a quarter-size match, 1 px to 40 % of the width, else NaN.

    Returns (H / 4, W / 4) float32 in full-size px.
    """
    size = (max(left.shape[1] // _SCALE, 32), max(left.shape[0] // _SCALE, 32))
    small_left = cv2.resize(left, size, interpolation=cv2.INTER_AREA)
    small_right = cv2.resize(right, size, interpolation=cv2.INTER_AREA)
    count = max(16, int(size[0] * _WIDEST_SHARE) // 16 * 16)
    forward = _match(small_left, small_right, count)
    # The right image's disparity: the same match with both images mirrored and exchanged.
    backward = _match(cv2.flip(small_right, 1), cv2.flip(small_left, 1), count)[:, ::-1]
    column = np.arange(size[0], dtype=np.float32)[None, :]
    target = np.rint(column - forward).astype(np.int32)
    inside = (forward > 0.25) & (target >= 0)
    there = np.take_along_axis(backward, target.clip(0, size[0] - 1), axis=1)
    consistent = inside & (np.abs(there - forward) <= 1)
    return np.where(consistent, forward * np.float32(left.shape[1] / size[0]), np.float32(np.nan))


def _match(left: UInt8, right: UInt8, count: int) -> Float32:
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
    padded = [cv2.copyMakeBorder(image, 0, 0, count, 0, cv2.BORDER_REPLICATE) for image in (left, right)]
    matched: Float32 = matcher.compute(*padded)[:, count:].astype(np.float32) / 16
    return matched


def _finite_share(disparity: Float32) -> float:
    return float(np.isfinite(disparity).mean())
