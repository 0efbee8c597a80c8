"""Detect SIFT, ORB and SURF features behind one Protocol, spread over the picture, each with a sigma."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, Protocol, get_args

import cv2
import numpy as np

from barsight.core.arrays import Float32, UInt8
from barsight.core.extras import extra
from barsight.features.orb import detect_orb, spread

DetectorName = Literal["sift", "surf", "orb"]
DETECTORS: tuple[DetectorName, ...] = get_args(DetectorName)
WHOLE_PIXEL_SIGMA = 12**-0.5
"""Sigma of a position known to one pixel of its pyramid level, in such pixels."""
SIFT_SIGMA = 0.015
SURF_SIGMA = 0.3
"""Sigma of a position as a ratio to the feature's scale; a test compares these sigmas with known shifts."""
SURF_FEWEST = 4


@dataclass(frozen=True, eq=False)
class Keypoints:
    """pixels: (N, 2) float32 x, y. sigma_px: (N,) each. descriptors: (N, D), uint8 bits (ORB) or float32."""

    pixels: Float32
    sigma_px: Float32
    descriptors: UInt8 | Float32

    def __len__(self) -> int:
        return len(self.pixels)


class Detector(Protocol):
    """Detects at most `count` features of an (H, W) picture, the strongest of each cell of a grid."""

    def __call__(self, image: UInt8, count: int) -> Keypoints: ...


def make_detector(name: DetectorName) -> Detector:
    """Make the detector with that name."""
    return {"sift": _sift, "surf": _surf, "orb": _orb}[name]


def _orb(image: UInt8, count: int) -> Keypoints:
    found = detect_orb(image, count)
    sigma = WHOLE_PIXEL_SIGMA * found.scale
    return Keypoints(found.pixels, sigma.astype(np.float32), found.descriptors)


def _sift(image: UInt8, count: int) -> Keypoints:
    sift = cv2.SIFT.create(nfeatures=4 * count, contrastThreshold=0.02)
    points = sift.detect(image, None)
    if not points:
        return _none(128)
    pixels = np.array([p.pt for p in points], np.float32)
    kept = spread(pixels, np.array([p.response for p in points], np.float32), image.shape, count)
    described, descriptors = sift.compute(image, [points[i] for i in kept])
    scale = np.array([p.size for p in described], np.float32) / 2
    places = np.array([p.pt for p in described], np.float32)
    return Keypoints(places, (SIFT_SIGMA * scale).astype(np.float32), np.asarray(descriptors, np.float32))


def _surf(image: UInt8, count: int) -> Keypoints:
    with extra("bench"):
        from mahotas.features import surf  # OpenCV's wheels leave SURF out

    found: Any = surf.surf(
        image, nr_octaves=4, nr_scales=6, initial_step_size=1, threshold=0.05, max_points=4 * count
    )
    if len(found) < SURF_FEWEST:
        return _none(64)
    pixels = found[:, [1, 0]].astype(np.float32)
    kept = spread(pixels, found[:, 3].astype(np.float32), image.shape, count)
    scale = found[kept, 2].astype(np.float32)
    sigma = (SURF_SIGMA * scale).astype(np.float32)
    return Keypoints(pixels[kept], sigma, found[kept, 6:].astype(np.float32))


def _none(width: int) -> Keypoints:
    return Keypoints(np.empty((0, 2), np.float32), np.empty(0, np.float32), np.empty((0, width), np.float32))
