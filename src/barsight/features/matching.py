"""Matching of binary descriptors."""

from __future__ import annotations

import cv2
import numpy as np

from barsight.core.arrays import Int64
from barsight.features.orb import Features


def match_mutual(first: Features, second: Features, ratio: float = 0.9) -> Int64:
    """(M, 2) index pairs that are each other's nearest in Hamming distance [paper Eq. 6].

    Pairs whose second best is nearly as good (Lowe's ratio test) are left out.
    """
    if len(first) < 2 or len(second) < 2:
        return np.empty((0, 2), dtype=np.int64)
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING)
    forward = matcher.knnMatch(first.descriptors, second.descriptors, k=2)
    best = np.array([(m.trainIdx, m.distance, n.distance) for m, n in forward], dtype=np.float64)
    backward = matcher.match(second.descriptors, first.descriptors)
    back = np.array([m.trainIdx for m in backward], dtype=np.int64)
    target = best[:, 0].astype(np.int64)
    index = np.arange(len(first))
    kept = (back[target] == index) & (best[:, 1] < ratio * best[:, 2])
    return np.column_stack([index[kept], target[kept]])
