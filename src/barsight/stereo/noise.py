"""Check texture and compute the Cramer-Rao bound of a match from the images' noise."""

from __future__ import annotations

import cv2
import numpy as np

from barsight.core.arrays import Bool, Float32, UInt8
from barsight.core.records.pairs import RectifiedPair

_VISIBLE_STEP = 4
_MIN_RATIO = 1e-3
_FEWEST_ROWS = 3


def has_texture(pair: RectifiedPair) -> bool:
    """Check that in each image at least one pixel in a thousand differs by more than 4 gray levels from
    the pixel two columns away: black, burnt-out and uniformly gray images have no texture, nor have images
    of fewer than 3 rows.
    """
    if pair.left.shape[0] < _FEWEST_ROWS:
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
    response = _bends(_bends(image).T)
    spread = float(np.median(np.abs(response))) / 0.6745
    return max(spread / 6.0, 0.5)


def _bends(image: UInt8 | Float32) -> Float32:
    """Compute second differences down the columns at every third row."""
    bends: Float32 = np.asarray(image[:-2:3] - np.float32(2) * image[1:-1:3] + image[2::3], np.float32)
    return bends
