"""Check the pictures for dirt and drops on a lens, which stay fixed in the picture while the yard passes
by.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import median_filter

from barsight.core.arrays import Float32, UInt8
from barsight.core.errors import Failed
from barsight.core.records.pairs import StereoFrame

BLOCKS = 80
"""Number of blocks across a picture."""
AROUND = 11
"""Width, in blocks, of the median filter that gives a block's surroundings."""
FRAMES = 12
FEWEST = 4
DARKER = 0.12
"""Minimum fraction by which a spot is darker than its surroundings in almost every picture; or its contrast
falls below the fraction BLURRED of theirs.
"""
BLURRED = 0.55
EXCEPTIONS = 8
"""One in this many pictures may hide a spot, where something bright happens to be behind it."""


@dataclass(frozen=True)
class PictureHealth:
    """Health of one camera. dirt_pct: percentage of the picture that dirt darkens or drops blur.

    sharpness: median contrast of neighbouring pixels over brightness. gray: median gray level.
    """

    camera: str
    dirt_pct: float
    sharpness: float
    gray: float


def check_pictures(frames: Iterable[StereoFrame]) -> tuple[PictureHealth, ...] | Failed:
    """Check both cameras on some frames of a travel. Failed `few-pictures` for fewer than four."""
    pictures: list[tuple[UInt8, UInt8]] = [(frame.left, frame.right) for frame in frames]
    if len(pictures) < FEWEST:
        return Failed("few-pictures", f"{len(pictures)} pictures; {FEWEST} are the least to tell dirt by")
    return tuple(_health(f"cam{side}", [pair[side] for pair in pictures]) for side in range(2))


def _health(camera: str, images: list[UInt8]) -> PictureHealth:
    dark, blurred, sharp, gray = [], [], [], []
    for image in images:
        level, contrast = _blocks(image)
        dark.append(_over_surroundings(level))
        blurred.append(_over_surroundings(contrast))
        sharp.append(float(np.median(contrast)))
        gray.append(float(np.median(image)))
    last = len(images) - 1 - len(images) // EXCEPTIONS
    spoiled = np.sort(dark, axis=0)[last] < np.log(1 - DARKER)
    spoiled |= np.sort(blurred, axis=0)[last] < np.log(BLURRED)
    return PictureHealth(camera, 100 * float(spoiled.mean()), float(np.median(sharp)), float(np.median(gray)))


def _blocks(image: UInt8) -> tuple[Float32, Float32]:
    """Compute each block's gray level and its contrast of neighbouring pixels relative to that level."""
    side = max(image.shape[1] // BLOCKS, 4)
    rows, columns = image.shape[0] // side, image.shape[1] // side
    cut = image[: rows * side, : columns * side].astype(np.float32)
    fine = np.abs(cut - cv2.GaussianBlur(cut, (0, 0), 1.0))
    level, contrast = (
        one.reshape(rows, side, columns, side).mean(axis=(1, 3), dtype=np.float32) for one in (cut, fine)
    )
    return level + 1, contrast / (level + 1) + np.float32(1e-4)


def _over_surroundings(values: Float32) -> Float32:
    over: Float32 = np.log(values / median_filter(values, AROUND, mode="nearest"))
    return over
