"""Match descriptors, with one function per step: nearest, mutual, ratio test, homography, motion."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from barsight.core.arrays import Bool, Float32, Float64, Int64, UInt8
from barsight.core.records.pairs import RectifiedCamera
from barsight.features.guided_matching import project_stereo
from barsight.features.orb import Features

MIN_FOR_PLANE = 4


@dataclass(frozen=True, eq=False)
class NearestNeighbours:
    """Nearest neighbours of N first descriptors: index (N,) of the nearest second one, its distance and that
    of the second nearest.

    The distance is Hamming's [paper Eq. 6] for bits, else L2.
    """

    index: Int64
    distance: Float64
    next_distance: Float64


def nearest_neighbours(first: UInt8 | Float32, second: UInt8 | Float32) -> NearestNeighbours:
    """Find nearest neighbours by brute force.

    next_distance is infinite where there is only one second descriptor.
    """
    count = len(first)
    index, distance = np.full(count, -1, np.int64), np.full((count, 2), np.inf)
    if count and len(second):
        bits = first.dtype == np.uint8
        kind, norm = (cv2.CV_32S, cv2.NORM_HAMMING) if bits else (cv2.CV_32F, cv2.NORM_L2)
        sides = min(2, len(second))
        found, which = cv2.batchDistance(first, second, kind, normType=norm, K=sides)
        index, distance[:, :sides] = which[:, 0].astype(np.int64), found
    return NearestNeighbours(index, distance[:, 0], distance[:, 1])


def ratio_test(found: NearestNeighbours, ratio: float = 0.9) -> Bool:
    """Select the neighbours (N,) that pass the ratio test [Lowe 2004]."""
    kept: Bool = (found.index >= 0) & (found.distance < ratio * found.next_distance)
    return kept


def is_mutual(forward: NearestNeighbours, backward: NearestNeighbours) -> Bool:
    """Select the mutual nearest neighbours (N,)."""
    kept: Bool = forward.index >= 0
    kept[kept] = backward.index[forward.index[kept]] == np.flatnonzero(kept)
    return kept


def hamming_distances(first: UInt8, second: UInt8) -> Int64:
    """Count the bits in which descriptors (N, D) differ, pair by pair: (N,) [paper Eq. 6]."""
    differing: Int64 = np.unpackbits(first ^ second, axis=1).sum(axis=1, dtype=np.int64)
    return differing


def match_mutual(first: Features, second: Features, ratio: float = 0.9) -> Int64:
    """Match mutual nearest neighbours that pass the ratio test; return index pairs (M, 2)."""
    if len(first) < 2 or len(second) < 2:
        return np.empty((0, 2), dtype=np.int64)
    forward = nearest_neighbours(first.descriptors, second.descriptors)
    clear = np.flatnonzero(ratio_test(forward, ratio))
    backward = nearest_neighbours(second.descriptors[forward.index[clear]], first.descriptors)
    kept = clear[backward.index == clear]
    return np.column_stack([kept, forward.index[kept]])


def homography_inliers(first: Float64, second: Float64, reach_px: float = 3.0) -> Bool:
    """Select the matches (N,) that fit the best homography [paper Eq. 7], by MAGSAC++; this also removes true
    matches off the plane.
    """
    if len(first) < MIN_FOR_PLANE:
        return np.zeros(len(first), np.bool_)
    cv2.setRNGSeed(1)
    _, inside = cv2.findHomography(first, second, cv2.USAC_MAGSAC, reach_px, maxIters=5000, confidence=0.999)
    return np.zeros(len(first), np.bool_) if inside is None else inside.ravel().astype(np.bool_)


def motion_inliers(
    points: Float64, second: Float64, rotation: Float64, translation: Float64, camera: RectifiedCamera,
    reach_px: float,
) -> Bool:  # fmt: skip
    """Select the matches (N,) within `reach_px` of their points as moved and projected [paper Eq. 12].

    points: (N, 3) in the first `rect0`; rotation and translation: new_from_old, from Eq. 11.
    """
    expected = project_stereo(points @ rotation.T + translation, camera)[:, :2]
    with np.errstate(invalid="ignore"):
        kept: Bool = np.linalg.norm(second - expected, axis=1) < reach_px
    return kept
