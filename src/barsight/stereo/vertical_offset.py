"""Measure the vertical offset between a pair's rows at corner points."""

from __future__ import annotations

import cv2
import numpy as np

from barsight.core.arrays import UInt8
from barsight.core.errors import Failed
from barsight.stereo.search_range import coarse_disparity

MAX_OFFSET_PX = 1.8
_MIN_MATCHES = 20
_REACH_RATIO = 0.1
_COARSE_RATIO = 0.3
_COARSE_TOLERANCE_PX = 6.0


def vertical_offset(left: UInt8, right: UInt8) -> float | Failed:
    """Compute the 75th percentile of |y_left - y_right| over matched corners, px: below about 1 in a
    rectified pair.

    Corners are matched by mutual nearest ORB descriptors whose rows differ by at most a tenth of the height;
    the percentile also detects rotated images, whose offsets average out. Where a coarse dense match
    succeeds, corners that contradict it are left out. Returns Failed `no-texture` where too few match.
    """
    orb = cv2.ORB.create(nfeatures=3000, nlevels=2, fastThreshold=8)
    places, descriptors = [], []
    for image in (left, right):
        keypoints, described = orb.detectAndCompute(image, None)
        if described is None:
            return Failed("no-texture", "the image has no corners")
        places.append(np.array([k.pt for k in keypoints], dtype=np.float64))
        descriptors.append(described)
    matches = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(*descriptors)
    near = [(m.queryIdx, m.trainIdx) for m in matches if m.distance <= 50]
    if not near:
        return Failed("no-texture", "no corner matches between the images")
    pairs = np.array(near)
    found, partner = places[0][pairs[:, 0]], places[1][pairs[:, 1]]
    offset = np.abs(found[:, 1] - partner[:, 1])
    kept = offset <= _REACH_RATIO * left.shape[0]
    coarse = coarse_disparity(left, right)
    if np.isfinite(coarse).mean() > _COARSE_RATIO:
        row = (found[:, 1] * coarse.shape[0] / left.shape[0]).astype(int)
        column = (found[:, 0] * coarse.shape[1] / left.shape[1]).astype(int)
        kept &= np.abs(found[:, 0] - partner[:, 0] - coarse[row, column]) <= _COARSE_TOLERANCE_PX
    offset = offset[kept]
    if offset.size < _MIN_MATCHES:
        return Failed("no-texture", f"only {offset.size} corners match between the images")
    return float(np.percentile(offset, 75))
