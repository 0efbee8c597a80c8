"""Check texture and compute the Cramer-Rao bound of a match from the images' noise."""

from __future__ import annotations

from typing import cast

import cv2
import numpy as np

from barsight.core.arrays import Bool, Float32, Int64, UInt8, kernel
from barsight.core.records.pairs import RectifiedPair

_VISIBLE_STEP = 4
_MIN_RATIO = 1e-3
_MIN_ROWS = 3
_MAX_BEND_GRAY = 8 * 255


def has_texture(pair: RectifiedPair) -> bool:
    """Check that in each image at least one pixel in a thousand differs by more than 4 gray levels from
    the pixel two columns away: black, burnt-out and uniformly gray images have no texture, nor have images
    of fewer than 3 rows.
    """
    if pair.left.shape[0] < _MIN_ROWS:
        return False
    return _is_textured(pair.left, pair.left_valid) and _is_textured(pair.right, pair.right_valid)


def noise_sigma(image: UInt8, radius_px: int) -> Float32:
    """Compute the Cramer-Rao bound (H, W) float32 px of a match over a window of side 2 r + 1: sqrt(2)
    times the image sigma over the root of the window's summed squared gradients; at most 1 px.
    """
    gradient = cv2.Sobel(image, cv2.CV_32F, 1, 0, ksize=3, scale=1 / 8)
    side = 2 * radius_px + 1
    energy = cv2.boxFilter(gradient * gradient, -1, (side, side), normalize=False)
    noise = image_noise(image)
    sigma: Float32 = np.sqrt(2 * noise * noise / np.maximum(energy, 1e-3), dtype=np.float32).clip(max=1)
    return sigma


def _is_textured(image: UInt8, valid: Bool) -> bool:
    steps = np.abs(image[:, 2:].astype(np.int16) - image[:, :-2]) > _VISIBLE_STEP
    usable = valid[:, 2:] & valid[:, :-2]
    return int(np.count_nonzero(steps & usable)) > _MIN_RATIO * image.size


def image_noise(image: UInt8 | Float32) -> float:
    """Estimate the image's noise, one sigma in gray levels, robustly from a Laplacian that ignores planes
    [Immerkaer 1996], with the median instead of the mean to reduce the effect of texture.
    """
    spread = _median_bend(image) / 0.6745
    return max(spread / 6.0, 0.5)


def _median_bend(image: UInt8 | Float32) -> float:
    """Compute the median of the sizes of second differences along rows and columns, at every third of both;
    those of whole gray levels are counted, not sorted.
    """
    if image.dtype != np.uint8 or min(image.shape) < _MIN_ROWS:
        return float(np.median(np.abs(_bends(_bends(image).T))))
    sizes = np.zeros(_MAX_BEND_GRAY + 1, dtype=np.int64)
    _count_bends(cast(UInt8, image), sizes)
    below, count = np.cumsum(sizes), int(sizes.sum())
    middle = np.searchsorted(below, [(count - 1) // 2, count // 2], side="right")
    return float(middle.mean())


@kernel()
def _count_bends(image: UInt8, sizes: Int64) -> None:
    """Count the second differences of the second differences of an image (H, W), at every third row and
    column from the second on, by their size; adds to sizes (N,), one for each gray level up to the largest
    possible.
    """
    height, width = image.shape
    down = np.empty(width, dtype=np.int32)
    two = np.int32(2)
    for y in range(1, height - 1, 3):
        above, here, below = image[y - 1], image[y], image[y + 1]
        for x in range(width):
            down[x] = np.int32(above[x]) - two * np.int32(here[x]) + np.int32(below[x])
        for x in range(1, width - 1, 3):
            sizes[abs(down[x - 1] - two * down[x] + down[x + 1])] += 1


def _bends(image: UInt8 | Float32) -> Float32:
    """Compute second differences down the columns at every third row."""
    bends: Float32 = np.asarray(image[:-2:3] - np.float32(2) * image[1:-1:3] + image[2::3], np.float32)
    return bends
