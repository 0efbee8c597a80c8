"""Matching of binary descriptors, and sub-pixel correction of the matches on the images themselves."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from barsight.core.arrays import Bool, Float32, Int64, UInt8
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


def track(
    source: UInt8, target: UInt8, places: Float32, guesses: Float32, window_px: int = 11
) -> tuple[Float32, Bool]:
    """Places of `source` (N, 2) found in `target` to a fraction of a pixel, from guesses (N, 2).

    Lucas-Kanade there and back; returns the places (N, 2) and which came back to within half a pixel (N,).
    """
    if len(places) == 0:
        return guesses, np.zeros(0, dtype=np.bool_)
    options: dict[str, Any] = {
        "winSize": (window_px, window_px),
        "maxLevel": 1,
        "criteria": (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.003),
        "flags": cv2.OPTFLOW_USE_INITIAL_FLOW,
    }
    found, there, _ = cv2.calcOpticalFlowPyrLK(source, target, places, guesses.copy(), **options)
    returned, back, _ = cv2.calcOpticalFlowPyrLK(target, source, found, places.copy(), **options)
    kept: Bool = (there.ravel() == 1) & (back.ravel() == 1)
    kept &= np.linalg.norm(returned - places, axis=1) < 0.5
    return found, kept
