"""Detect ORB features [Rublee 2011], evenly spread over the picture."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from barsight.core.arrays import Bool, Float32, Int64, UInt8

_PATCH_PX = 31

CELLS = (6, 8)


@dataclass(frozen=True, eq=False)
class Features:
    """pixels: (N, 2) float32, x and y. descriptors: (N, 32) uint8. scale: (N,) size in px of a pixel of the
    feature's pyramid level.
    """

    pixels: Float32
    descriptors: UInt8
    scale: Float32

    def __len__(self) -> int:
        return len(self.pixels)

    def chosen(self, kept: Bool) -> Features:
        """Select the features for which `kept` (N,) is true."""
        return Features(self.pixels[kept], self.descriptors[kept], self.scale[kept])


def detect_orb(image: UInt8, count: int, cells: tuple[int, int] = CELLS) -> Features:
    """Detect at most `count` ORB features, the strongest of each cell of a (rows, columns) grid.

    Detection uses a low FAST threshold so that dark, dull steel yields features too; the grid keeps a bright
    label from taking all of them.
    """
    orb = cv2.ORB.create(nfeatures=4 * count, fastThreshold=7, edgeThreshold=_PATCH_PX, patchSize=_PATCH_PX)
    keypoints = orb.detect(image, None)
    if not keypoints:
        return _no_features()
    places = np.array([k.pt for k in keypoints], dtype=np.float32)
    strength = np.array([k.response for k in keypoints], dtype=np.float32)
    kept = spread(places, strength, image.shape, count, cells)
    described, descriptors = orb.compute(image, [keypoints[i] for i in kept])
    if descriptors is None or not described:
        return _no_features()
    return Features(
        np.array([k.pt for k in described], dtype=np.float32),
        descriptors,
        (np.array([k.size for k in described]) / _PATCH_PX).astype(np.float32),
    )


def spread(
    pixels: Float32, strength: Float32, shape: tuple[int, ...], count: int, cells: tuple[int, int] = CELLS
) -> Int64:
    """Select the strongest features in each of (rows, columns) cells; return their indices, ascending."""
    height, width = shape
    row = (pixels[:, 1] * cells[0] / height).astype(int).clip(0, cells[0] - 1)
    column = (pixels[:, 0] * cells[1] / width).astype(int).clip(0, cells[1] - 1)
    cell = row * cells[1] + column
    order = np.lexsort((-strength, cell))
    first = np.searchsorted(cell[order], cell[order], side="left")
    kept: Bool = np.arange(len(order)) - first < max(1, count // (cells[0] * cells[1]))
    return np.sort(order[kept])


def describe_upright(image: UInt8, places: Float32) -> Features:
    """Describe given positions (N, 2) by upright ORB descriptors in the picture at half size.

    For pictures that hardly rotate or change scale from one to the next. Positions too near the border are
    left out.
    """
    keypoints = [cv2.KeyPoint(float(x), float(y), _PATCH_PX, 0.0) for x, y in places / 2]
    described, descriptors = cv2.ORB.create(nlevels=1).compute(cv2.pyrDown(image), keypoints)
    if not described:
        return _no_features()
    pixels = np.array([k.pt for k in described], dtype=np.float32)
    return Features(2 * pixels, descriptors, np.full(len(described), 2, dtype=np.float32))


def _no_features() -> Features:
    return Features(np.empty((0, 2), np.float32), np.empty((0, 32), np.uint8), np.empty(0, np.float32))
